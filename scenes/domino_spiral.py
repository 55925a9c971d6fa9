"""A leaning domino topples a spiral of others, if it leans by more than atan(thickness / height)."""

import math
from typing import Any

import numpy as np

from warp_rigid.checks import number_in, whole_in
from warp_rigid.rotations import rotate
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box
from warp_rigid.scenes.builders import grounds
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import SOUND, OverlapOutcome, Verdict

HALF = (0.016, 0.06, 0.18)
"""Half of a domino's thickness, width and height [m]."""
MASS = 0.8
INNER_RADIUS, PITCH = 0.35, 0.32
"""Radius at which the spiral begins, and its growth per turn [m]."""
TOPPLING_ANGLE = math.degrees(math.atan(HALF[0] / HALF[2]))
"""Lean at which a domino balances on its edge [degree]."""
MARGIN = 0.2
"""Difference from that angle at which the outcome is certain [degree]."""
FALLEN = 30.0
"""Lean from which a domino counts as fallen [degree]."""
SPEED_SCALE = math.sqrt(9.81 * 2.0 * HALF[2])
"""sqrt(g height) [m/s], the only speed that gravity and the size of the dominoes define."""


def build(dominoes: int = 60, spacing: float = 0.12, lean: float = 8.0) -> Scene:
    """Upright dominoes along an Archimedean spiral, from the inside out; the first one leans toward the second.

    Size, mass, number per length and spiral are those of the example domino_spiral of Newton, which has 30.

    Args:
        dominoes: number of dominoes, 2 to 300.
        spacing: distance between neighbours along the spiral [m], 0.1 to 0.2.
        lean: of the first domino, on its edge [degree], 0 to 8. It falls if that exceeds 5.08 degrees.
    """
    dominoes = whole_in("dominoes", dominoes, 2, 300)
    place, heading, _ = spiral(dominoes, number_in("spacing", spacing, 0.1, 0.2))
    lean = math.radians(number_in("lean", lean, 0.0, 8.0))
    half_turn = 0.5 * heading
    flat = np.zeros(dominoes)
    upright = np.stack([flat, flat, np.sin(half_turn), np.cos(half_turn)], axis=1)
    position = np.concatenate([place, np.full((dominoes, 1), HALF[2])], axis=1)
    # The first domino stands on its front edge.
    tilt = np.array([0.0, math.sin(0.5 * lean), 0.0, math.cos(0.5 * lean)])
    position[0] += rotate(upright[0], rotate(tilt, np.array([-HALF[0], 0.0, HALF[2]])) + [HALF[0], 0.0, -HALF[2]])
    c, s = upright[0, 3], upright[0, 2]
    upright[0] = (-s * tilt[1], c * tilt[1], s * tilt[3], c * tilt[3])
    scene = grounds.level_scene(friction=0.6, name="ground", camera=Camera.orbit(-60.0, 38.0))
    add_bodies(scene, Box(HALF), position, upright, names="domino", mass=MASS, friction=0.6, restitution=0.1)
    return scene


def spiral(count: int, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points at equal distances along the spiral.

    Returns:
        Points (count, 2) [m], directions of travel (count,) [rad], and distances along the spiral (count,) [m].
    """
    growth = PITCH / (2.0 * math.pi)
    angle = np.linspace(0.0, 2.0 * math.pi * 40, 40_000)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(INNER_RADIUS + growth * angle, growth)[:-1] * np.diff(angle))])
    distance = spacing * np.arange(count)
    polar_angle = np.interp(distance, along, angle)
    radius = INNER_RADIUS + growth * polar_angle
    place = radius[:, None] * np.stack([np.cos(polar_angle), np.sin(polar_angle)], axis=1)
    return place, polar_angle + np.arctan2(radius, growth), distance


class DominoOutcome(OverlapOutcome):
    """Which dominoes fall, in which order, and how fast the wave runs."""

    prefix = "domino_"

    fell_at: Any = np.inf

    @staticmethod
    def _lean(orientation):
        """Angle between a domino's axis and the vertical [rad]."""
        axis = rotate(orientation, np.broadcast_to([0.0, 0.0, 1.0], (*orientation.shape[:-1], 3)))
        return np.arccos(np.clip(axis[..., 2], -1.0, 1.0))

    def observe(self, sim):
        """Record when each domino falls."""
        super().observe(sim)
        lean = self._lean(sim.get("orientation")[:, self.bodies].astype(np.float64))
        self.fell_at = np.minimum(self.fell_at, np.where(lean > math.radians(FALLEN), float(sim.time), np.inf))

    def verdicts(self, sim):
        """Number of fallen dominoes, their order, the speed of the wave, and overlap."""
        if not self.recent:
            return []
        count, fallen = len(self.bodies), np.isfinite(self.fell_at).sum(axis=1)
        lean = math.degrees(self._lean(np.array([sim.scene.bodies[self.bodies[0]].orientation]))[0])
        sure = SOUND if abs(lean - TOPPLING_ANGLE) > MARGIN else {}
        if lean < TOPPLING_ANGLE:
            stands = Verdict("fallen", fallen, "none falls: the lean is below 5.08 degrees", fallen == 0, sure)
            return [stands, *self.overlap_verdicts(sim, 2e-4, 0.006)]
        steps = np.linalg.norm(np.diff(self.start[:, :2], axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        with np.errstate(invalid="ignore"):
            in_order = (np.diff(self.fell_at, axis=1) >= 0.0).all(axis=1)
            third = count // 3
            speed = (along[-1] - along[third]) / (self.fell_at[:, -1] - self.fell_at[:, third])
            plausible = (speed > 0.5 * SPEED_SCALE) & (speed < 2.5 * SPEED_SCALE)
        order = fallen == count
        return [
            Verdict("fallen", fallen, f"all {count} fall", order, sure),
            Verdict("in_order", in_order.astype(float), "no domino falls before the one behind it", in_order, sure),
            Verdict("wave", speed, "wave at 0.5 to 2.5 sqrt(g height)", plausible, sure if count >= 30 else {}, "m/s"),
            *self.overlap_verdicts(sim, 2e-4, 0.006),
        ]


outcome = DominoOutcome
DURATION = 5.0
VARIANTS = {"two_pass": {"shock_propagation": "two_pass"}}
# The fallen dominoes lean on each other in a row and do not stack, so shock propagation is of no use.
SETTINGS = {"shock_propagation": "off", "contact_iterations": 40}
