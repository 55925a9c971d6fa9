"""Bones fall through a funnel into a walled plot.

Friction, restitution and the kinds' shares are those of Guendelman, Bridson and Fedkiw 2003 (300 craniums, 150 pelvises
and 50 femurs); their rolling friction of 0.1 has no unit, ours is a tenth of a femur's thickness [m]. Shapes and places
are our own.
"""

import math
from typing import Any

import numpy as np

from warp_rigid import rotations
from warp_rigid.checks import whole_in
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Mesh, Plane, tessellation
from warp_rigid.scenes.builders import assortment, meshes
from warp_rigid.scenes.demo import (
    ONE_PASS_2003,
    Demo,
    Verdict,
    indices,
    overlap_verdict,
    start_apart,
)

SURFACE: dict[str, Any] = {"friction": 0.4, "restitution": 0.3, "rolling_friction": 0.003}
DENSITY = 1500.0
PITCH = 0.5
JITTER = 0.02
SLOPE = math.radians(55.0)
OPENING = 0.45
"""Radius of the funnel's lower opening [m]: a femur goes through in any direction."""
SHELL = 0.05
WALL_HALF = 0.05
KINDS = ("cranium", "pelvis", "femur")


def build(bones: int = 20, seed: int = 0) -> Scene:
    """Craniums, pelvises and femurs, 6 : 3 : 1, on a jittered lattice above a funnel, turned at random.

    Args:
        bones: how many, 1 to 2000; the paper has 500.
        seed: of jitter, rotations and order.
    """
    bones = whole_in("bones", bones, 1, 2000)
    position, orientation = starts(bones, seed)
    scene = Scene()
    scene.add_static(Plane(normal=(0, 0, 1), offset=0.0), name="floor", **SURFACE)
    for i, (center, half_extents) in enumerate(_walls(bones)):
        scene.add_static(Box(half_extents), position=center, name=f"wall_{i}", **SURFACE)
    scene.add_static(_funnel(bones), position=(0, 0, _opening_height(bones)), name="funnel", **SURFACE)
    shapes = {"cranium": meshes.cranium(), "pelvis": meshes.pelvis(), "femur": meshes.femur()}
    for i, kind in enumerate(_kinds(bones, seed)):
        scene.add_body(
            shapes[kind],
            position=position[i],
            orientation=orientation[i],
            density=DENSITY,
            name=f"bone_{i}_{kind}",
            **SURFACE,
        )
    return scene


def _kinds(bones, seed):
    """The kind of each bone: shares of 6, 3 and 1 tenths in random order."""
    femurs, pelvises = round(0.1 * bones), round(0.3 * bones)
    kinds = np.repeat(KINDS, (bones - pelvises - femurs, pelvises, femurs))
    return np.random.default_rng((seed, 4)).permutation(kinds).tolist()


def starts(bones: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the bones start: centres of mass (bones, 3) [m] and unit quaternions (bones, 4)."""
    rng = np.random.default_rng((whole_in("seed", seed, 0, assortment.MOST_SEEDS), 5))
    side = _side(bones)
    i = np.arange(bones)
    cell = np.stack([i % side, i // side % side, i // side**2], axis=1)
    half = 0.5 * (side - 1) * PITCH
    corner = np.array([-half, -half, _opening_height(bones) + _funnel_rise(bones) + 0.6 * PITCH])
    position = corner + PITCH * cell + rng.uniform(-JITTER, JITTER, (bones, 3))
    return position, rotations.random(rng, bones)


def _side(bones):
    """Bones along each side of the lattice: about as high as wide."""
    return max(2, math.ceil(bones ** (1.0 / 3.0)))


def _plot_half(bones):
    """Half of the plot's inner width [m]."""
    return max(0.6, 0.14 * bones ** (1.0 / 3.0))


def _wall_height(bones):
    """Height of the plot's walls [m]."""
    return 0.5 + 0.1 * _side(bones)


def _opening_height(bones):
    """Height of the funnel's lower opening [m]: above what the pile will reach."""
    return _wall_height(bones) + 0.25


def _funnel_radius(bones):
    """Inner radius of the funnel's upper rim [m]: it holds the whole lattice."""
    return 2.0**0.5 * 0.5 * _side(bones) * PITCH + 0.1


def _funnel_rise(bones):
    """Height of the funnel [m]."""
    return (_funnel_radius(bones) - OPENING) * math.tan(SLOPE)


def _funnel(bones):
    """A cone with an upper and a lower opening, its wall a shell; the lower opening lies at z = 0."""
    radius, rise = _funnel_radius(bones), _funnel_rise(bones)
    out, down = SHELL * math.sin(SLOPE), SHELL * math.cos(SLOPE)
    section = [[OPENING, 0.0], [OPENING + out, -down], [radius + out, rise - down], [radius, rise]]
    return Mesh(*tessellation.wheel(np.array(section), 48), sdf_resolution=128)


def _walls(bones):
    """Centre and half extents of the four walls."""
    inner, thickness, half_height = _plot_half(bones), WALL_HALF, 0.5 * _wall_height(bones)
    away, length = inner + thickness, inner + 2.0 * thickness
    along_y, along_x = (thickness, length, half_height), (length, thickness, half_height)
    return [((sign * away, 0, half_height), along_y) for sign in (-1, 1)] + [
        ((0, sign * away, half_height), along_x) for sign in (-1, 1)
    ]


class BonesOutcome:
    """Whether all bones went through the funnel into the plot, none inside another."""

    def __init__(self, scene):
        """Find the bones."""
        self.bones = indices(scene, "bone_")
        self.inner = _plot_half(len(self.bones))
        self.opening = _opening_height(len(self.bones))

    def observe(self, sim):
        """Nothing: the end tells."""

    def verdicts(self, sim):
        """Bones that left the plot, bones still in the funnel, and overlap at the end."""
        position = sim.get("center_of_mass")[:, self.bones]
        above = position[..., 2] > self.opening
        # A bone that is not a number has left too: the comparison must be true for it.
        inside = (np.abs(position[..., :2]).max(axis=-1) < self.inner) & (position[..., 2] > 0.0)
        left, waiting = (~(inside | above)).sum(axis=1), above.sum(axis=1)
        sound = {"default": True}
        through = sound if len(self.bones) <= 100 else {}
        return [
            Verdict("escaped", left, "none outside the plot", left == 0, sound),
            Verdict("waiting", waiting, "none above the funnel's opening", waiting == 0, through),
            overlap_verdict(sim, 5e-3, sound),
        ]


def vary(sim, bones, seed, **_):
    """Start environment e where the scene of seed + e does; the order of the kinds is that of the first."""
    start_apart(sim, "bone_", lambda env: starts(bones, seed + env))


DEMO = Demo(
    name="bone_pile",
    summary="craniums, pelvises and femurs fall through a funnel into a walled plot",
    build=build,
    outcome=BonesOutcome,
    duration=4.0,
    variants={"default": {}, "one_pass": ONE_PASS_2003},
    vary=vary,
)
