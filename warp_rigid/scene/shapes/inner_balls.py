"""Inner balls: a few large balls inside a shape, by which a deep overlap of two bodies is found and measured.

The surfaces of bodies that overlap deeply may oppose each other nowhere; a ball in one body still overlaps the other. A
shape of several arms needs several balls.
"""

import numpy as np

MOST_BALLS = 32
"""Maximum number of inner balls of a shape."""

THINNEST = 0.7
"""Smallest ball, as a fraction of the largest one."""

APART = 0.75
"""Distance of two balls from which both are chosen, as a fraction of the radius of the later one."""


def spread_out(candidates: np.ndarray) -> np.ndarray:
    """Choose balls that are large and far from each other, the largest one first.

    A ball is chosen for its radius times the distance of its centre from those of the balls chosen before, until all
    balls that are left are close to one of those.

    Args:
        candidates: (n, 4) centre and radius of balls inside the shape [m], at least one.

    Returns:
        (k, 4), at least 1 and at most MOST_BALLS of them.
    """
    chosen = [int(np.argmax(candidates[:, 3]))]
    candidates = np.concatenate([candidates[chosen], candidates[candidates[:, 3] >= THINNEST * candidates[chosen, 3]]])
    chosen = [0]
    distance = np.full(len(candidates), np.inf)
    while len(chosen) < MOST_BALLS:
        away = np.linalg.norm(candidates[:, :3] - candidates[chosen[-1], :3], axis=1)
        distance = np.minimum(distance, away)
        score = np.where(distance >= APART * candidates[:, 3], distance * candidates[:, 3], 0.0)
        best = int(np.argmax(score))
        if score[best] <= 0.0:
            break
        chosen.append(best)
    return candidates[chosen]


def in_a_row(center: np.ndarray, half_extents: np.ndarray) -> np.ndarray:
    """Balls along the longest axis of a box, capsule or cylinder, each as thick as the shape, the middle one first.

    Args:
        center: (3,) [m].
        half_extents: (3,) of the bounding box around it [m].

    Returns:
        (k, 4) centres and radii [m]; the distance of two neighbours is at most the radius unless there are too many.
    """
    radius = half_extents.min()
    longest = int(np.argmax(half_extents))
    length = half_extents[longest] - radius
    pairs = min(int(np.ceil(length / radius)), (MOST_BALLS - 1) // 2)
    steps = length * np.arange(1, pairs + 1) / max(pairs, 1)
    balls = np.tile([*center, radius], (2 * pairs + 1, 1))
    balls[1:, longest] += np.concatenate([steps, -steps])
    return balls
