"""A four-bar linkage and a slider-crank turn; both follow their closed forms."""

import math

import numpy as np

from warp_rigid.checks import number_in
from warp_rigid.rotations import rotate
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.joints import PrismaticJoint, RevoluteJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box
from warp_rigid.scenes.demo import SceneOutcome, below, indices

CRANK, COUPLER, ROCKER, BASE = 0.3, 0.9, 0.7, 1.0
ROD, AWAY = 0.8, 2.0
LAYER = 0.06
"""Distance of the planes in which bars move, so that they do not meet [m]."""


def third_corner(b, d, to_b, to_d):
    """Intersection of circles around b (..., 2) and d, on the left of the line from b to d."""
    line = d - b
    distance = np.linalg.norm(line, axis=-1, keepdims=True)
    along = (to_b**2 - to_d**2 + distance**2) / (2.0 * distance)
    left = np.stack([-line[..., 1], line[..., 0]], axis=-1)
    return b + (along * line + np.sqrt(to_b**2 - along**2) * left) / distance


def build(speed: float = 2.0) -> Scene:
    """Both cranks turn about vertical axes at a speed, without gravity.

    Args:
        speed: of the cranks [rad/s], 0.1 to 5.
    """
    speed = number_in("speed", speed, 0.1, 5.0)
    scene = Scene(gravity=(0, 0, 0), camera=Camera.orbit(0.0, 60.0))
    for joint in (add_four_bar(scene, (math.cos(1.0), math.sin(1.0))), add_slider_crank(scene, (0.0, 1.0), AWAY)):
        scene.add_drive(joint, damping=1e4, target_velocity=speed)
    return scene


def add_four_bar(scene, toward) -> int:
    """Add a crank in a direction (2,) of the plane, a coupler and a rocker; returns the hinge of the crank."""
    a, d = np.zeros(2), np.array([BASE, 0.0])
    b = CRANK * np.array(toward)
    c = third_corner(b, d, COUPLER, ROCKER)
    crank, coupler = _bar(scene, "crank", a, b, 0), _bar(scene, "coupler", b, c, 1)
    rocker = _bar(scene, "rocker", d, c, 2)
    driven = _hinge(scene, crank, None, a)
    for body, other, point in ((coupler, crank, b), (rocker, coupler, c), (rocker, None, d)):
        _hinge(scene, body, other, point)
    return driven


def add_slider_crank(scene, toward, away=0.0) -> int:
    """Add a crank in a direction (2,), a rod and a slider along x at y = away [m]; returns the hinge of the crank."""
    a = np.array([0.0, away])
    b = a + CRANK * np.array(toward)
    c = np.array([b[0] + math.sqrt(ROD**2 - (CRANK * toward[1]) ** 2), away])
    crank, rod = _bar(scene, "second_crank", a, b, 0), _bar(scene, "rod", b, c, 1)
    slider = scene.add_body(Box((0.06, 0.04, 0.02)), position=(*c, 2 * LAYER), name="slider")
    driven = _hinge(scene, crank, None, a)
    _hinge(scene, rod, crank, b)
    _hinge(scene, slider, rod, c)
    scene.add_joint(PrismaticJoint((1, 0, 0)), slider, anchor=(*c, 2 * LAYER))
    return driven


def _bar(scene, name, p, q, layer):
    """A bar between two points of the plane, in one of the layers."""
    length, angle = np.linalg.norm(q - p), math.atan2(*(q - p)[::-1])
    orientation = (0, 0, math.sin(angle / 2), math.cos(angle / 2))
    return scene.add_body(
        Box((0.5 * length, 0.02, 0.02)), position=(*(p + q) / 2, layer * LAYER), orientation=orientation, name=name
    )


def _hinge(scene, body, other, point):
    return scene.add_joint(RevoluteJoint((0, 0, 1)), body, other, anchor=(*point, 0))


class LinkageOutcome(SceneOutcome):
    """Distance of the coupler and of the slider from their closed forms, for the angles of the cranks."""

    def observe(self, sim):
        """Record the largest distances."""
        place = sim.get("position").astype(np.float64)
        orientation = sim.get("orientation").astype(np.float64)
        at = {name: indices(sim.scene, name)[0] for name in ("crank", "coupler", "second", "slider")}
        b, second = (
            CRANK * rotate(orientation[:, at[name]], np.array([1.0, 0, 0]))[:, :2] for name in ("crank", "second")
        )
        middle = (b + third_corner(b, np.array([BASE, 0.0]), COUPLER, ROCKER)) / 2.0
        x, y = second.T
        expected = np.stack([x + np.sqrt(ROD**2 - y**2), np.full_like(x, AWAY)], axis=-1)
        self.keep_largest(
            coupler=np.linalg.norm(place[:, at["coupler"], :2] - middle, axis=-1),
            slider=np.linalg.norm(place[:, at["slider"], :2] - expected, axis=-1),
        )

    def judge(self, sim):
        """Both distances so far."""
        return [
            below("coupler", self.largest["coupler"], 1e-4, "coupler within 0.1 mm of its curve"),
            below("slider", self.largest["slider"], 1e-4, "slider within 0.1 mm of its place"),
        ]


outcome = LinkageOutcome
DURATION = 4.0
