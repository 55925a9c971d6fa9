"""A ball rolls down a ramp and breaks pyramids that have stood still."""

import math
from typing import Any

import numpy as np

from warp_rigid.checks import whole_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Mesh, Sphere
from warp_rigid.scenes.builders import grounds, stacks
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.demo import OverlapOutcome, Verdict, below, indices

HALF = 0.1
ROW_DISTANCE = 0.5
"""Distance between two pyramids [m]."""
RADIUS, DENSITY = 0.3, 5000.0
SLOPE = math.radians(22.8)
RAMP_LENGTH, RAMP_HALF_WIDTH = 4.2, 0.5
RAMP_FOOT = 1.2
"""Distance of the foot of the ramp from the first pyramid [m]."""
RELEASE = 3.6
"""Distance that the ball rolls down the ramp until its speed is measured [m]."""
SURFACE: dict[str, Any] = {"friction": 0.6}


def build(rows: int = 8, pyramids: int = 3) -> Scene:
    """Plane pyramids of cubes of 0.2 m, one behind the other, and a ball of 565 kg on a ramp of 22.8 degrees.

    The proportions are those of the example pyramid of Newton, which has 20 pyramids of 20 rows.

    Args:
        rows: rows of a pyramid, 2 to 20.
        pyramids: number of pyramids, 1 to 20.
    """
    rows, pyramids = whole_in("rows", rows, 2, 20), whole_in("pyramids", pyramids, 1, 20)
    scene = grounds.level_scene(name="ground", **SURFACE, camera=Camera.orbit(-165.0, 24.0))
    along, normal = _directions()
    foot = np.array([0.0, -RAMP_FOOT, 0.0])
    scene.add_static(_ramp(), position=foot, name="ramp", **SURFACE)
    for k in range(pyramids):
        places = stacks.pyramid(rows, HALF) + [0.0, ROW_DISTANCE * k, 0.0]
        add_bodies(scene, Box((HALF,) * 3), places, names=f"cube_{k}", **SURFACE)
    start = foot - (RELEASE + 0.3) * along + RADIUS * normal
    scene.add_body(Sphere(RADIUS), position=start, density=DENSITY, name="ball", **SURFACE)
    return scene


def _ramp():
    """A wedge that rises along -y from its foot at the origin."""
    run, rise = RAMP_LENGTH * math.cos(SLOPE), RAMP_LENGTH * math.sin(SLOPE)
    corners = [(x, y, z) for x in (-RAMP_HALF_WIDTH, RAMP_HALF_WIDTH) for y, z in ((0, 0), (-run, 0), (-run, rise))]
    faces = [(0, 1, 2), (3, 5, 4), (0, 4, 1), (0, 3, 4), (1, 5, 2), (1, 4, 5), (2, 3, 0), (2, 5, 3)]
    return Mesh(np.array(corners), np.array(faces))


def _directions():
    """Unit vectors down the ramp and away from it."""
    return (np.array([0.0, math.cos(SLOPE), -math.sin(SLOPE)]), np.array([0.0, math.sin(SLOPE), math.cos(SLOPE)]))


class WreckOutcome(OverlapOutcome):
    """Drift of the pyramids before the hit, speed of the ball on the ramp, and the collapse."""

    prefix = "cube_"

    speed_error = None

    def observe(self, sim):
        """Record the drift until the ball is near, and how the ball's speed differs from that of rolling."""
        super().observe(sim)
        (ball,) = indices(sim.scene, "ball")
        place = sim.get("position")[:, ball].astype(np.float64)
        rolled = (place - sim.scene.bodies[ball].position) @ _directions()[0]
        if self.speed_error is None:
            self.speed_error = np.full(len(place), np.nan)
        self.keep_largest(drift=np.where((rolled < RELEASE).all(), self.displacement(sim).max(axis=1), 0.0))
        speed = np.linalg.norm(sim.get("linear_velocity")[:, ball].astype(np.float64), axis=1)
        # A ball that rolls without slipping has 5/7 of the acceleration of one that slides without friction.
        exact = np.sqrt(10.0 / 7.0 * 9.81 * math.sin(SLOPE) * np.maximum(rolled, 1e-9))
        on_ramp = (rolled > 0.5 * RELEASE) & (rolled < RELEASE)
        self.speed_error = np.where(on_ramp, speed / exact - 1.0, self.speed_error)

    def judge(self, sim):
        """Drift, speed of the ball, drop of the first pyramid's top, and overlap."""
        verdicts = [below("drift", self.largest["drift"], 1e-3, "no cube moves by 1 mm before the hit")]
        if np.isfinite(self.speed_error).all():
            right = np.abs(self.speed_error) < 0.01
            text = "speed of the ball on the ramp within 1 % of sqrt(10/7 g h)"
            verdicts.append(Verdict("speed_error", self.speed_error, text, right, unit="%"))
        if sim.time > 2.9:
            top = indices(sim.scene, "cube_0_")[-1]
            height = sim.scene.bodies[top].position[2]
            drop, limit = height - sim.get("position")[:, top, 2].astype(np.float64), 0.5 * height
            verdicts += [
                Verdict("drop", drop, f"top of the first pyramid drops by > {limit:.2f} m", drop > limit, unit="m"),
                *self.overlap_verdicts(sim, 1e-3, 0.03),
            ]
        return verdicts


outcome = WreckOutcome
DURATION = 5.0
