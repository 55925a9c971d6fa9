"""Section G: granular piles, for which order and trend are known."""

import numpy as np

from warp_rigid.scenes.builders import stacks
from warp_rigid.scenes.builders.grounds import level_scene
from warp_rigid.validation.case import AT_LEAST, ReferenceCheck, ValidationCase, at_most
from warp_rigid.validation.common import per_env
from warp_rigid.validation.experiment import Experiment


def cases(quick: bool) -> list[ValidationCase]:
    """All cases of the section; none is quick."""
    return [] if quick else [heap()]


def heap(base=6):
    """Square pyramids of balls collapse without friction; more friction preserves more of the height."""
    radius = 0.05
    friction = np.array([0.0, 0.1, 0.2, 0.6, 0.6, 0.6])
    rolling = np.array([0.0, 0.0, 0.0, 0.0, 2e-3, 1e-2])
    names = tuple(f"mu {mu:g}, rolling {1e3 * c:g} mm" for mu, c in zip(friction, rolling, strict=True))

    def scene():
        made = level_scene()
        stacks.add_ball_pyramid(made, base, radius)
        return made

    def kept(trace, time=3.0):
        height = trace.position[:, :, 1:, 2].mean(axis=2) - radius
        return height[np.searchsorted(trace.time, time - 1e-9)] / height[0]

    count = base * (base + 1) * (2 * base + 1) // 6
    return ValidationCase(
        "V60",
        f"heaps of {count} balls, 3 s from a square pyramid",
        "Zhou 2001 and 2002: order and trend",
        (
            ReferenceCheck("height kept without friction", "", lambda s: kept(s[0])[:1], 0.0, at_most(0.05), names[:1]),
            ReferenceCheck(
                "increase of the height kept after 0.5 s over less friction",
                "",
                lambda s: np.diff(kept(s[0], 0.5)),
                0.02,
                AT_LEAST,
                names[1:],
            ),
            ReferenceCheck("height kept with most friction", "", lambda s: kept(s[0])[-1:], 0.9, AT_LEAST, names[-1:]),
        ),
        (
            Experiment(
                scene, 3.0, names, (per_env("friction", friction), per_env("rolling_friction", rolling)), every=24
            ),
        ),
    )
