"""Structures whose bodies start in contact: stacks, leaning towers, pyramids, crossed layers, card houses."""

from collections.abc import Sequence

import numpy as np

from warp_rigid.scene.shapes import Box
from warp_rigid.scene.shapes.base import Shape
from warp_rigid.scene.shapes.mesh import Mesh

CUBE = Box((0.1, 0.1, 0.1))
"""Cube of 0.2 m, which has a mass of 8 kg at the default density."""
BRICK = (0.0585, 0.0117, 0.0039)
"""Half of the length, width and thickness of a Kapla brick [m], 15 : 3 : 1."""
BRICK_GAP = 0.0003
"""Half of the smallest distance between bricks of the same layer of a tower [m]."""


def column(count: int, shape: Shape = CUBE, *, bottom: float = 0.0, gap: float = 0.0, lean: float = 0.0) -> np.ndarray:
    """Positions of equal bodies on top of one another, lowest first, (count, 3) [m].

    Args:
        count: number of bodies.
        shape: of every body, centred on its frame's origin.
        bottom: height of the support [m].
        gap: vertical distance below every body [m].
        lean: offset of every body along x from the one below [m].
    """
    half = shape.bounds[1][2]
    level = np.arange(count)
    z = bottom + half + gap + level * (2.0 * half + gap)
    return np.stack([lean * level, np.zeros(count), z], axis=1)


def leaning_tower_falls(x: Sequence[float] | np.ndarray, half: float) -> bool:
    """Whether statics demands that a tower of equal cubes on wide ground topples towards +x.

    It topples if the cubes above some joint have their common centre of mass beyond the edge of the joint: of the
    overlap of two cubes, or of the lowest cube's whole face.

    Args:
        x: position of each cube along x, lowest first [m].
        half: half of a cube's width [m].
    """
    x = np.asarray(x, np.float64)
    edge = half + np.minimum(x, np.concatenate([x[:1], x[:-1]]))
    return any(x[k:].mean() > edge[k] + 1e-9 for k in range(len(x)))


def pyramid(rows: int, half: float = 0.1) -> np.ndarray:
    """Positions of rows of cubes in the plane y = 0, each with one cube less than the row below, lowest first [m].

    Args:
        rows: number of rows, which is also the number of cubes in the lowest one.
        half: half of a cube's width [m].

    Returns:
        (rows (rows + 1) / 2, 3), row by row from the ground up.
    """
    width = 2 * half
    positions = [
        (width * (k - 0.5 * (rows - row - 1)), 0, half * (2 * row + 1))
        for row in range(rows)
        for k in range(rows - row)
    ]
    return np.array(positions, np.float64).reshape(-1, 3)


def brick_tower(count: int, sectors: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Poses of flat bricks that form a round, hollow tower, lowest first.

    A storey has two layers. In the lower one, bricks point outwards, one in each sector. In the upper one, two rings of
    bricks bridge the gaps between them, at their inner and at their outer ends. Every brick rests on two others or on
    the ground, so that a tower with an unfinished storey stands too.

    Args:
        count: number of bricks, 3 * sectors in a storey.
        sectors: bricks in a ring, at least 36: with fewer the outer ring is not supported well.

    Returns:
        Positions (count, 3) [m] and orientations (count, 4), (x, y, z, w).
    """
    length, width, thickness = BRICK
    angle = 2.0 * np.pi / sectors
    inner = (length + BRICK_GAP) / np.tan(0.5 * angle)
    k = np.arange(count)
    storey, place = np.divmod(k, 3 * sectors)
    ring, sector = np.divmod(place, sectors)
    bridge = ring > 0
    radius = inner + np.choose(ring, (length, width, 2.0 * length - width))
    about = angle * (sector + 0.5 * bridge)
    height = thickness * (4 * storey + 2 * bridge + 1)
    half = 0.5 * (about + 0.5 * np.pi * bridge)
    flat = np.zeros(count)
    position = np.stack([radius * np.cos(about), radius * np.sin(about), height], axis=1)
    return position, np.stack([flat, flat, np.sin(half), np.cos(half)], axis=1)


def voussoir(stones: int, radius: float, thickness: float, depth: float = 1.0) -> Mesh:
    """A stone of a semicircular arch, about the centre of its middle radius; z points outwards, x along the arch.

    Args:
        stones: number of stones in the arch.
        radius: mean radius of the arch [m].
        thickness: of the arch, radially [m].
        depth: along the axis of the arch [m].
    """
    half = 0.5 * np.pi / stones
    corners = [
        (along * r * np.sin(half), across * 0.5 * depth, r * np.cos(half) - radius)
        for r in (radius - 0.5 * thickness, radius + 0.5 * thickness)
        for across in (-1, 1)
        for along in (-1, 1)
    ]
    faces = [(0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4), (2, 6, 7), (2, 7, 3)]
    faces += [(0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5)]
    return Mesh(np.array(corners), np.array(faces))


def arch(stones: int, radius: float, thickness: float) -> tuple[Mesh, np.ndarray, np.ndarray]:
    """A semicircular arch of equal stones of 1 m along y that stands on the plane z = 0, about the y axis.

    Args:
        stones: number of stones.
        radius: mean radius [m].
        thickness: radial thickness [m].

    Returns:
        The stone, and positions (stones, 3) [m] and orientations (stones, 4), from -x to +x.
    """
    angle = np.pi * ((np.arange(stones) + 0.5) / stones - 0.5)
    flat = np.zeros(stones)
    positions = radius * np.stack([np.sin(angle), flat, np.cos(angle)], axis=1)
    orientations = np.stack([flat, np.sin(0.5 * angle), flat, np.cos(0.5 * angle)], axis=1)
    return voussoir(stones, radius, thickness), positions, orientations


def ball_pyramid(base: int, radius: float) -> np.ndarray:
    """Positions of square layers of touching balls, each in the hollow between four balls below, (balls, 3) [m].

    Args:
        base: balls along a side of the lowest layer, which is the first.
        radius: of the balls [m].
    """
    positions = []
    for layer in range(base):
        middle = 0.5 * (base - layer - 1)
        for x, y in np.ndindex(base - layer, base - layer):
            positions.append(2 * radius * np.array([x - middle, y - middle, layer / 2**0.5 + 0.5]))
    return np.array(positions)


def crossed_layers(layers: int) -> tuple[list[Shape], list[tuple[float, float, float]]]:
    """Layers of two parallel beams of 2 x 0.2 x 0.2 m, each layer at right angles to the one below.

    Returns:
        The beams and their positions [m], layer by layer from the ground up.
    """
    along_x, along_y = Box((1.0, 0.1, 0.1)), Box((0.1, 1.0, 0.1))
    shapes: list[Shape] = []
    positions = []
    for layer in range(layers):
        for side in (-0.9, 0.9):
            shapes.append(along_y if layer % 2 else along_x)
            x, y = (side, 0.0) if layer % 2 else (0.0, side)
            positions.append((x, y, 0.1 + 0.2 * layer))
    return shapes, positions


def card_house(storeys: int, angle: float) -> tuple[Box, list, list]:
    """Pairs of cards of 0.2 x 0.1 x 0.004 m that lean on each other, with level cards between the storeys.

    Args:
        storeys: number of storeys, which is also the number of pairs in the lowest one.
        angle: of the leaning cards to the vertical [rad].

    Returns:
        The card, and positions [m] and orientations, storey by storey from the ground up, leaning cards first.
    """
    length, thickness = 0.2, 0.004
    height = length * np.cos(angle) + thickness * np.sin(angle)
    foot = length * np.sin(angle) + thickness * np.cos(angle)
    flat = (0.0, np.sin(0.25 * np.pi), 0.0, np.cos(0.25 * np.pi))
    positions, orientations = [], []
    for storey in range(storeys):
        base, pairs = storey * (height + thickness), storeys - storey
        for pair in range(pairs):
            middle = 2 * foot * (pair - 0.5 * (pairs - 1))
            for side in (-1, 1):
                positions.append((middle + side * 0.5 * foot, 0, base + 0.5 * height))
                orientations.append((0.0, -side * np.sin(0.5 * angle), 0.0, np.cos(0.5 * angle)))
        for gap in range(pairs - 1):
            positions.append((2 * foot * (gap - 0.5 * (pairs - 2)), 0, base + height + 0.5 * thickness))
            orientations.append(flat)
    return Box((0.5 * thickness, 0.05, 0.5 * length)), positions, orientations
