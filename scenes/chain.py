"""A hundred links carry a ball a thousand times heavier than one of them."""

from typing import Any

from warp_rigid.checks import number_in, whole_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.joints import SphericalJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Capsule, Sphere
from warp_rigid.scenes.builders.jointed import ClosedJointsOutcome

LENGTH = 0.1
LINK_MASS = 0.1


def build(links: int = 100, ratio: float = 1000.0, speed: float = 1.0) -> Scene:
    """Chain that hangs from the world and swings.

    Args:
        links: number of links, 1 to 200.
        ratio: mass of the ball over that of a link, 0.1 to 10000.
        speed: of the ball at the start [m/s], 0 to 5.
    """
    links = whole_in("links", links, 1, 200)
    ratio = number_in("ratio", ratio, 0.1, 10_000.0)
    speed = number_in("speed", speed, 0.0, 5.0)
    scene = Scene(camera=Camera.orbit(-75.0, -10.0, look_at=(0, 0, 0.5 - LENGTH * links), distance=3.6))
    above, spin = None, (0, -speed / (LENGTH * links), 0)
    for k in range(links):
        place, velocity = (0, 0, -LENGTH * (k + 0.5)), ((k + 0.5) / links * speed, 0, 0)
        motion: dict[str, Any] = {"linear_velocity": velocity, "angular_velocity": spin}
        body = scene.add_body(Capsule(0.015, 0.03), position=place, mass=LINK_MASS, name=f"link_{k}", **motion)
        scene.add_joint(SphericalJoint(), body, above, anchor=(0, 0, -LENGTH * k))
        above = body
    end = -LENGTH * links
    ball = scene.add_body(
        Sphere(0.08), position=(0, 0, end - 0.1), linear_velocity=(speed, 0, 0), mass=ratio * LINK_MASS, name="ball"
    )
    scene.add_joint(SphericalJoint(), ball, above, anchor=(0, 0, end))
    return scene


class ChainOutcome(ClosedJointsOutcome):
    """How far the joints open."""

    def judge(self, sim):
        """The largest gap so far."""
        return [self.closed_verdict(1e-4)]


outcome = ChainOutcome
DURATION = 4.0
