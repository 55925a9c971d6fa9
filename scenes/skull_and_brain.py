"""An open skull and then a brain fall on a platform, collide, bounce and settle."""

import math
import os
from typing import Any

import numpy as np

from warp_rigid.files import mesh_files
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Mesh
from warp_rigid.scenes.builders import grounds, meshes
from warp_rigid.scenes.demo import ONE_PASS_2003, SOUND, OverlapOutcome, below, clearance, indices, rest_verdict

SKULL_SIZE = 0.25
BRAIN_SIZE = 0.18
PLATFORM_TOP = 0.03
SKULL_DROP = 0.1
BRAIN_DROP = 0.3
PLATFORM_HALF = 0.06
SLOPE = math.radians(35.0)
SIDE = 0.35
THIN = 0.02
TOUCHING = 1e-3


def build(skull: str | None = None, brain: str | None = None) -> Scene:
    """Skull of 0.25 m above a platform and brain of 0.18 m above the skull, 2 cm to the front.

    The platform is the bottom of a dish, which keeps the two together.

    Args:
        skull: mesh file that replaces the skull, scaled to its size.
        brain: mesh file that replaces the brain, scaled to its size.
    """
    lower = meshes.skull_like(SKULL_SIZE) if skull is None else _own("skull", skull, SKULL_SIZE)
    upper = meshes.brain_like(BRAIN_SIZE) if brain is None else _own("brain", brain, BRAIN_SIZE)
    names = ("skull" if skull is None else "skull_own", "brain" if brain is None else "brain_own")
    surface: dict[str, Any] = {"friction": 0.5, "restitution": 0.3}
    scene = grounds.level_scene(name="ground", **surface, camera=Camera.orbit(-75.0, 30.0))
    _add_dish(scene, surface)
    z = PLATFORM_TOP + SKULL_DROP
    for name, mesh, x in zip(names, (lower, upper), (0.0, 0.02), strict=True):
        bottom, top = mesh.bounds
        middle = 0.5 * (bottom + top)
        scene.add_body(mesh, position=(x - middle[0], -middle[1], z - bottom[2]), density=1000.0, name=name, **surface)
        z += top[2] - bottom[2] + BRAIN_DROP
    return scene


def _add_dish(scene, surface):
    """Add the platform and four sides that rise from it, too steep for friction to hold a body."""
    grounds.add_platform(scene, PLATFORM_HALF, PLATFORM_HALF, PLATFORM_TOP, name="platform", **surface)
    width = PLATFORM_HALF + SIDE * math.cos(SLOPE)
    out = PLATFORM_HALF + 0.5 * SIDE * math.cos(SLOPE) + THIN * math.sin(SLOPE)
    up = PLATFORM_TOP + 0.5 * SIDE * math.sin(SLOPE) - THIN * math.cos(SLOPE)
    tilt, level = math.sin(0.5 * SLOPE), math.cos(0.5 * SLOPE)
    side, front = Box((0.5 * SIDE, width, THIN)), Box((width, 0.5 * SIDE, THIN))
    for sign in (-1.0, 1.0):
        for shape, place, turn in (
            (side, (sign * out, 0, up), (0, -sign * tilt, 0, level)),
            (front, (0, sign * out, up), (sign * tilt, 0, 0, level)),
        ):
            scene.add_static(shape, position=place, orientation=turn, name="side", **surface)


def _own(parameter, path, size):
    """A mesh file's shape, its longest side scaled to `size` [m]."""
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"{parameter}: must be the path of a mesh file, got {path!r}")
    try:
        vertices, faces, *_ = mesh_files.load(path)
        return Mesh(vertices * (size / np.ptp(vertices, axis=0).max()), faces)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{parameter}: {error}") from None
    except ValueError as error:
        raise ValueError(f"{parameter}: {error}") from None


class MeetingOutcome(OverlapOutcome):
    """Whether skull and brain come to rest in contact with each other, without overlap."""

    def verdicts(self, sim):
        """Distance between the two at the end, overlap, and speed at the end."""
        (skull,), (brain,) = (indices(sim.scene, name) for name in ("skull", "brain"))
        # Meshes from files may come to rest apart from each other.
        own = indices(sim.scene, "skull_own") or indices(sim.scene, "brain_own")
        gap = clearance(sim, skull, brain)
        text = f"skull and brain touch within {1e3 * TOUCHING:g} mm at the end"
        return [
            below("gap", gap, TOUCHING, text, {} if own else SOUND),
            *self.overlap_verdicts(sim, 1e-4, 2e-3),
            rest_verdict(sim, [skull, brain]),
        ]


outcome = MeetingOutcome
DURATION = 6.0
VARIANTS = {"one_pass": ONE_PASS_2003}
