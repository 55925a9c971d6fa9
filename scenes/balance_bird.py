"""A bird balances on its beak and swings with the period of a pendulum."""

import math

import numpy as np

from warp_rigid.checks import number_in
from warp_rigid.rotations import rotate
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Compound, Mesh, Sphere, tessellation
from warp_rigid.scenes.builders import grounds
from warp_rigid.scenes.demo import SOUND, SceneOutcome, Verdict, below

PEDESTAL_RADII = (0.08, 0.006)
"""Radius of the pedestal at its foot and at its flat top [m]."""
TOP = 0.12
"""Height of the pedestal [m]."""
TIP = 0.008
"""Radius of the ball at the tip of the beak [m]."""
WEIGHT = 0.026
"""Radius of the balls in the tips of the wings [m]."""
ALONG_X = (0.0, math.sin(0.25 * math.pi), 0.0, math.cos(0.25 * math.pi))
FRICTION = 0.8
STILL_CERTAIN = 0.002
"""Distance of the centre of mass from the centre of the tip beyond which the outcome is certain [m]."""
LARGEST_SWING = 0.35
"""Start below which the period of small swings holds to a percent [rad]."""


def build(droop: float = 0.075, tilt: float = 10.0) -> Scene:
    """Bird of 1 kg/dm^3 with a beak, body, tail, two wings and two weights, on a pedestal of 12 cm.

    Sizes and pedestal are close to those of the example balance_bird of Newton.

    Args:
        droop: depth of the weights below the tip of the beak [m], -0.05 to 0.09. The bird stays on the pedestal
            if its centre of mass is below the centre of the tip.
        tilt: forward pitch at the start [degree], 0 to 20.
    """
    droop = number_in("droop", droop, -0.05, 0.09)
    half = 0.5 * math.radians(number_in("tilt", tilt, 0.0, 20.0))
    scene = grounds.level_scene(name="ground", friction=FRICTION)
    scene.camera = Camera.orbit(-40.0, 12.0, look_at=(0, 0, 0.85 * TOP), distance=0.75)
    foot, top = PEDESTAL_RADII
    pedestal = Mesh(*tessellation.revolve([foot, top], [0.0, 0.0, TOP, TOP], 48))
    scene.add_static(pedestal, name="pedestal", friction=FRICTION)
    orientation = (0.0, math.sin(half), 0.0, math.cos(half))
    # The pose is that of the centre of the tip, about which the bird pitches.
    scene.add_body(bird(droop), position=(0, 0, TOP + TIP), orientation=orientation, name="bird", friction=FRICTION)
    return scene


def bird(droop: float) -> Compound:
    """The bird; its origin is the centre of the tip of the beak, which points along x, under its centre of mass.

    Args:
        droop: depth of the weights below the origin [m].
    """
    parts = [
        (Capsule(0.013, 0.045), (-0.055, 0.0, 0.028), ALONG_X),
        (Sphere(0.017), (0.0, 0.0, 0.026), (0, 0, 0, 1)),
        (Box((0.045, 0.02, 0.003)), (-0.14, 0.0, 0.03), (0, 0, 0, 1)),
    ]
    for side in (-1.0, 1.0):
        shoulder, end = np.array([-0.02, 0.0, 0.03]), np.array([0.07, 0.15 * side, -droop])
        parts.append(_wing(shoulder, end))
        parts.append((Sphere(WEIGHT), tuple(end), (0, 0, 0, 1)))
    # Shifted along x so that the centre of mass is under the tip.
    ahead = Compound(parts).center_of_mass[0]
    shifted = [(shape, (x - ahead, y, z), orientation) for shape, (x, y, z), orientation in parts]
    return Compound([(Sphere(TIP), (0.0, 0.0, 0.0), (0, 0, 0, 1)), _beak(shifted[1][1]), *shifted])


def _beak(head):
    """A thin rod from the tip to the head; of the bird's mass it has less than a thousandth."""
    x, _, z = head
    half = 0.5 * math.atan2(x, z)
    return Capsule(0.004, 0.5 * math.hypot(x, z)), (0.5 * x, 0.0, 0.5 * z), (0.0, math.sin(half), 0.0, math.cos(half))


def _wing(start, end):
    """A flat board between two points, its width level."""
    length = float(np.linalg.norm(end - start))
    yaw = math.atan2(end[1] - start[1], end[0] - start[0])
    dip = math.asin((start[2] - end[2]) / length)
    c, s = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    d, e = math.cos(0.5 * dip), math.sin(0.5 * dip)
    return Box((0.5 * length, 0.022, 0.003)), tuple(0.5 * (start + end)), (-s * e, c * e, s * d, c * d)


class BirdOutcome(SceneOutcome):
    """Whether the bird stays on the pedestal, and the period of its swing."""

    prefix = "bird"
    times = pitches = ()

    def observe(self, sim):
        """Record the pitch."""
        axis = rotate(sim.get("orientation")[:, self.bodies[0]].astype(np.float64), np.array([[1.0, 0.0, 0.0]]))
        self.times = (*self.times, float(sim.time))
        self.pitches = (*self.pitches, np.arctan2(-axis[:, 2], axis[:, 0]))

    def verdicts(self, sim):
        """Distance of the tip from its place, and the period and the largest pitch of a bird that stays."""
        body = sim.scene.bodies[self.bodies[0]]
        properties, swing = body.shape.mass_properties, 2.0 * math.asin(body.orientation[1])
        depth = -float(properties.center_of_mass[2])
        place = sim.get("position")[:, self.bodies[0]].astype(np.float64)
        moved = np.linalg.norm(place - [0.0, 0.0, TOP + TIP], axis=1)
        sure = SOUND if abs(depth) > STILL_CERTAIN else {}
        if depth <= 0.0:
            fell = moved > TOP / 2
            return [Verdict("moved", moved, "falls: the tip moves by > 60 mm", fell, sure, "mm")]
        stays = below("moved", moved, 5e-3, "stays: the tip within 5 mm of its place", sure)
        # The tip rolls on the pedestal, so the bird turns about the point of contact, TIP below the tip's centre.
        inertia = properties.inertia[1, 1] / properties.volume + (depth - TIP) ** 2
        period = 2.0 * math.pi * math.sqrt(inertia / (9.81 * depth))
        if not self.times or self.times[-1] - self.times[0] < 2.5 * period or abs(swing) < 0.02:
            return [stays]
        pitch = np.array(self.pitches)
        error = np.array([_period(self.times, column) for column in pitch.T]) / period - 1.0
        swings = sure if abs(swing) < LARGEST_SWING else {}
        grown = np.abs(pitch).max(axis=0) / abs(swing) - 1.0
        text = f"period within 2 % of {period:.3f} s"
        return [
            stays,
            Verdict("period_error", error, text, np.abs(error) < 0.02, swings, "%"),
            below("grown", grown, 0.02, "pitch never more than 2 % above that of the start", swings, "%"),
        ]


def _period(times, angle):
    """Period from the first to the last passage through 0 in either direction; NaN with fewer than three."""
    times, angle = np.array(times), np.asarray(angle)
    k = np.flatnonzero(np.sign(angle[:-1]) * np.sign(angle[1:]) < 0.0)
    if len(k) < 3:
        return math.nan
    passed = times[k] - angle[k] * (times[k + 1] - times[k]) / (angle[k + 1] - angle[k])
    return 2.0 * (passed[-1] - passed[0]) / (len(passed) - 1)


outcome = BirdOutcome
DURATION = 5.0
