"""A nut turns down a bolt by its weight, unless friction locks the thread."""

import math

import numpy as np

from warp_rigid.checks import number_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scenes.builders import grounds, screw_threads
from warp_rigid.scenes.demo import SOUND, OverlapOutcome, Verdict, below

THREAD = screw_threads.Thread()
LENGTH, NUT_HEIGHT, HEAD_HEIGHT, ACROSS_FLATS = 0.14, 0.06, 0.04, 0.12
"""Length of the thread, height of the nut and of the bolt's head, and the width of both [m]."""
START = 0.08
"""Height of the nut above the head at the start, two pitches [m]."""
HALF_WAY = 0.5 * START
MARGIN = 0.2
"""Relative distance of the friction from the critical one at which the outcome is certain."""
CRITICAL_FRICTION = THREAD.lead_tangent * math.cos(math.atan(THREAD.flank_tangent))
"""Friction at which the thread locks itself: tan(lead) cos(flank angle)."""


def build(friction: float = 0.03) -> Scene:
    """A bolt of 80 mm with a coarse thread (pitch 40 mm), and a steel nut that starts two turns above its head.

    Args:
        friction: of nut and bolt, 0 to 1. From 0.15 on, the thread locks itself.
    """
    friction = number_in("friction", friction, 0.0, 1.0)
    scene = grounds.level_scene(name="ground", camera=Camera.orbit(-60.0, 18.0))
    bolt = screw_threads.bolt(THREAD, LENGTH, HEAD_HEIGHT, ACROSS_FLATS)
    scene.add_static(bolt, position=(0, 0, HEAD_HEIGHT), friction=friction, name="bolt")
    nut = screw_threads.nut(THREAD, NUT_HEIGHT, ACROSS_FLATS)
    scene.add_body(nut, position=(0, 0, HEAD_HEIGHT + START), density=7800.0, friction=friction, name="nut")
    return scene


def acceleration(friction: float, inertia: float) -> float:
    """Acceleration with which the nut descends [m/s^2], from the forces on a thread as on an inclined plane.

    With the normal force N at the mean radius r, the lead angle b and the flank angle a in the section across the
    thread: m (g - z'') = N (cos a cos b + f sin b), I z'' / k = N r (cos a sin b - f cos b), k = pitch / 2 pi.

    Args:
        friction: f.
        inertia: I / m, about the axis [m^2].
    """
    lead = math.atan(THREAD.lead_tangent)
    across = math.cos(math.atan(THREAD.flank_tangent * math.cos(lead)))
    turning = across * math.sin(lead) - friction * math.cos(lead)
    carrying = across * math.cos(lead) + friction * math.sin(lead)
    k = THREAD.pitch / (2.0 * math.pi)
    return 9.81 * k / (k + inertia * carrying / (THREAD.mean_radius * turning)) if turning > 0.0 else 0.0


class NutOutcome(OverlapOutcome):
    """Whether the nut turns down or is held, how well it follows the thread, and how fast."""

    prefix = "nut"

    angle = turned = before = passed_at = None

    def observe(self, sim):
        """Record the angle, the distance from the thread, and when the nut is half-way down."""
        super().observe(sim)
        orientation = sim.get("orientation")[:, self.bodies[0]].astype(np.float64)
        angle = 2.0 * np.arctan2(orientation[:, 2], orientation[:, 3])
        if self.angle is None:
            self.angle, self.turned = angle, angle
            self.passed_at = np.full(len(angle), np.nan)
            self.before = (0.0, np.zeros(len(angle)))
        self.turned = self.turned + (angle - self.angle + np.pi) % (2.0 * np.pi) - np.pi
        self.angle = angle
        drop = self.start[0, 2] - sim.get("position")[:, self.bodies[0], 2].astype(np.float64)
        helix = THREAD.pitch * self.turned / (2.0 * np.pi)
        self.keep_largest(off_thread=np.where(np.all(drop < START), np.abs(drop + helix), 0.0))
        time, earlier = self.before
        passing = np.isnan(self.passed_at) & (drop >= HALF_WAY)
        part = (HALF_WAY - earlier[passing]) / (drop - earlier)[passing]
        self.passed_at[passing] = time + part * (float(sim.time) - time)
        self.before = (float(sim.time), drop)

    def judge(self, sim):
        """Descent or lock, distance from the thread, time to half-way, and overlap."""
        body, drop = sim.scene.bodies[self.bodies[0]], self.before[1]
        solid = body.shape.mass_properties
        sure = SOUND if abs(body.friction / CRITICAL_FRICTION - 1.0) > MARGIN else {}
        overlap = self.overlap_verdicts(sim, 2e-4, 1e-3)
        text = "within 1 mm of the thread, on 40 mm a turn"
        follows = below("off_thread", self.largest["off_thread"], 1e-3, text, sure)
        if body.friction >= CRITICAL_FRICTION:
            return [below("drop", drop, 1e-3, "held: the nut sinks by < 1 mm", sure), follows, *overlap]
        exact = math.sqrt(2.0 * HALF_WAY / acceleration(body.friction, solid.inertia[2, 2] / solid.volume))
        if sim.time < 1.5 * exact:
            return []
        error = self.passed_at / exact - 1.0
        text = f"half-way down within 15 % of {exact:.2f} s"
        return [
            Verdict("drop", drop, "turns down by > 40 mm", drop > HALF_WAY, sure, "mm"),
            follows,
            Verdict("delay", error, text, np.abs(error) < 0.15, sure, "%"),
            *overlap,
        ]


outcome = NutOutcome
DURATION = 2.0
