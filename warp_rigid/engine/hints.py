"""Hints on scenes that are legal, but probably not meant, such as numbers in other units than metres and radians."""

import math
from collections.abc import Sequence

import numpy as np

from warp_rigid.kernels.enums import Coordinate
from warp_rigid.scene.body_columns import column, extents, is_dynamic, shapes_of
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import Mesh

FULL_TURN = 2.0 * math.pi
LONGEST_STEP = 1.0
"""Largest way of a body in a step, relative to its largest extent."""
LARGEST_RATIO = 100.0
"""Of the size of a mesh to the median size of the other bodies, and the other way round."""
LARGEST_TURN = 0.5 * math.pi
"""Largest turn of a body in a step [rad]."""


def hints_on(scenes: Sequence[Scene], dt: float) -> list[str]:
    """Hints on scenes that are simulated with a time step, one line each.

    Args:
        scenes: the scenes at their start.
        dt: the time step [s].
    """
    found = []
    for scene in scenes:
        if scene.import_report is None:  # files state their units
            found += [*_angles_in_degrees(scene), *_meshes_of_another_unit(scene)]
        found += [*_images_without_coordinates(scene), *_long_steps(scene, dt)]
    return list(dict.fromkeys(found))


def _angles_in_degrees(scene: Scene) -> list[str]:
    """Limits of hinges beyond a full turn, and positions beyond one to which drives turn hinges."""
    limits, targets = [], []
    for entry in scene.joints:
        drive, ends = entry.drive, entry.joint.range
        if entry.joint.coordinate != Coordinate.ANGLE:
            continue
        if any(FULL_TURN < abs(limit) < math.inf for limit in ends):
            both = f"({', '.join(f'{limit:g}' for limit in ends)})"
            text = f"joint {entry.name}: limits of {both} rad are beyond a full turn; if they are degrees"
            limits.append(f"{text}, use limits=np.radians({both})")
        if drive is not None and drive.stiffness > 0.0 and abs(drive.target_position) > FULL_TURN:
            angle = f"{drive.target_position:g}"
            text = f"joint {entry.name}: target_position of {angle} rad is beyond a full turn; if it is in degrees"
            targets.append(f"{text}, use np.radians({angle})")
    return [*limits[:1], *targets[:1]]


def _meshes_of_another_unit(scene: Scene) -> list[str]:
    """Movable meshes that are far larger or smaller than the other movable bodies."""
    moving = [body for body in scene.bodies if body.motion != Motion.STATIC]
    shapes, shape_of = shapes_of(moving)
    size = extents(shapes).max(axis=1)[shape_of]
    for index, shape in enumerate(shapes):
        others = size[(shape_of != index) & np.isfinite(size)]
        if not isinstance(shape, Mesh) or not len(others):
            continue
        first = int(np.argmax(shape_of == index))
        ratio = size[first] / float(np.median(others))
        if not 1.0 / LARGEST_RATIO <= ratio <= LARGEST_RATIO:
            times = f"{ratio:.3g} times" if ratio > 1.0 else f"1/{1.0 / ratio:.3g} of"
            text = f"its mesh is {size[first]:.3g} m long, {times} the size of the other bodies"
            remedy = "if its file is not in metres, use Mesh.from_file(..., scale=), 0.001 for mm"
            return [f"body {moving[first].name}: {text}; {remedy}"]
    return []


def _images_without_coordinates(scene: Scene) -> list[str]:
    """Images of bodies that cannot show them."""
    for body, look in sorted(scene.looks.items()):
        if look.image is not None and scene.bodies[body].shape.surface_uv() is None:
            text = f"body {scene.bodies[body].name}: the image of its look is not shown"
            return [f"{text}: its shape has no texture coordinates, which meshes have with wr.Mesh(..., uv=)"]
    return []


def _long_steps(scene: Scene, dt: float) -> list[str]:
    """Steps in which a body moves by more than its size, also along its path, or turns by more than a quarter turn."""
    moving = [body for body in scene.bodies if body.motion != Motion.STATIC and body.active]
    if not moving:
        return []
    shapes, shape_of = shapes_of(moving)
    size = extents(shapes).max(axis=1)[shape_of]
    gained = dt * np.linalg.norm(scene.gravity) * is_dynamic(moving)
    speed = np.linalg.norm(column(moving, "linear_velocity"), axis=1) + gained
    for index, body in enumerate(moving):
        if body.path is not None:
            ways = np.linalg.norm(np.diff(body.path.positions, axis=0), axis=1)
            speed[index] = (ways / np.maximum(np.diff(body.path.times), dt)).max()
    spin = np.linalg.norm(column(moving, "angular_velocity"), axis=1)
    found = []
    for rate, most, text in (
        (speed / size, LONGEST_STEP, "moves by {:.2g} times its size"),
        (spin, LARGEST_TURN, "turns by {:.2g} rad"),
    ):
        worst = int(np.argmax(rate))
        if rate[worst] * dt > most:
            way = text.format(rate[worst] * dt)
            found.append(f"dt: body {moving[worst].name} {way} in a step of {dt:.3g} s; a shorter dt is more accurate")
    return found
