"""An open skull and then a brain fall on a platform: two arbitrary polyhedra meet."""

import os

import numpy as np

from warp_rigid import mesh_files, meshes
from warp_rigid.scene import Scene
from warp_rigid.scenes.demo import (
    ONE_PASS_2003,
    Demo,
    Verdict,
    clearance,
    indices,
    overlap_verdict,
    rest_verdict,
)
from warp_rigid.shapes import Box, Mesh, Plane

SKULL_SIZE = 0.25
BRAIN_SIZE = 0.18
PLATFORM_TOP = 0.2
SKULL_DROP = 0.1
BRAIN_DROP = 0.6
MEETING = 5e-3


def build(skull: str | None = None, brain: str | None = None) -> Scene:
    """Skull of 0.25 m above a platform and brain of 0.18 m higher up, a little to the front.

    Args:
        skull: mesh file to take instead of the skull, scaled to its size.
        brain: mesh file to take instead of the brain, scaled to its size.
    """
    lower = meshes.skull_like(SKULL_SIZE) if skull is None else _own("skull", skull, SKULL_SIZE)
    upper = meshes.brain_like(BRAIN_SIZE) if brain is None else _own("brain", brain, BRAIN_SIZE)
    scene = Scene()
    scene.add_static(Plane(normal=(0, 0, 1), offset=0.0), friction=0.5, restitution=0.3)
    scene.add_static(
        Box((0.5, 0.5, 0.5 * PLATFORM_TOP)),
        position=(0, 0, 0.5 * PLATFORM_TOP),
        friction=0.5,
        restitution=0.3,
        name="platform",
    )
    z = PLATFORM_TOP + SKULL_DROP
    for name, mesh, x in (("skull", lower, 0.0), ("brain", upper, 0.02)):
        bottom, top = mesh.bounds
        middle = 0.5 * (bottom + top)
        scene.add_body(
            mesh,
            position=(x - middle[0], -middle[1], z - bottom[2]),
            density=1000.0,
            friction=0.5,
            restitution=0.3,
            name=name,
        )
        z += top[2] - bottom[2] + BRAIN_DROP
    return scene


def _own(parameter, path, size):
    """The user's mesh, its longest side scaled to `size` [m]."""
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"{parameter}: must be the path of a mesh file, got {path!r}")
    try:
        vertices, faces = mesh_files.load(path)
        return Mesh(vertices * (size / np.ptp(vertices, axis=0).max()), faces)
    except ValueError as error:
        raise ValueError(f"{parameter}: {error}") from None


class MeetingOutcome:
    """Whether skull and brain met, and how they came to rest."""

    def __init__(self, scene):
        """Find the two."""
        (self.skull,) = indices(scene, "skull")
        (self.brain,) = indices(scene, "brain")
        self.nearest = None

    def observe(self, sim):
        """Keep the smallest distance between the two."""
        gap = clearance(sim, self.skull, self.brain)
        self.nearest = gap if self.nearest is None else np.minimum(self.nearest, gap)

    def verdicts(self, sim):
        """Meeting, overlap and rest."""
        if self.nearest is None:
            return []
        sound = {"default": True}
        text = f"brain and skull come within {1e3 * MEETING:g} mm"
        return [
            Verdict("nearest", self.nearest, text, self.nearest < MEETING, sound),
            overlap_verdict(sim, 1e-3, sound),
            rest_verdict(sim, [self.skull, self.brain], sound),
        ]


DEMO = Demo(
    name="skull_and_brain",
    summary="an open skull and then a brain fall on a platform, meet, bounce and settle",
    build=build,
    outcome=MeetingOutcome,
    duration=6.0,
    variants={"default": {}, "one_pass": ONE_PASS_2003},
)
