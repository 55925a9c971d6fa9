"""A ball on a chain swings into a wall of bricks; the chain stays closed."""

import numpy as np

from warp_rigid.checks import number_in, whole_in
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.joints import SphericalJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Plane, Sphere
from warp_rigid.scenes.builders.jointed import ClosedJointsOutcome
from warp_rigid.scenes.demo import Verdict

BRICK = (0.1, 0.2, 0.1)
LINKS, LINK = 12, 0.25
RADIUS, BALL_MASS, LINK_MASS = 0.4, 2000.0, 1.0
HIT = 2.0
"""The ball has hit the wall before this time [s]."""


def build(rows: int = 25, columns: int = 20, angle: float = 60.0) -> Scene:
    """Wall below the pivot of a chain of twelve links of 1 kg, which carries a ball of 2 t.

    At rest the ball would hang before the wall, at four fifths of its height.

    Args:
        rows: of bricks, 1 to 25.
        columns: bricks in a row, 1 to 20.
        angle: of the chain at the start [degrees], 10 to 80.
    """
    rows, columns = whole_in("rows", rows, 1, 25), whole_in("columns", columns, 1, 20)
    lean = np.radians(number_in("angle", angle, 10.0, 80.0))
    scene = Scene(camera=Camera.orbit(-35.0, 18.0))
    scene.add_static(Plane(), friction=0.6, name="ground")
    for row in range(rows):
        for column in range(columns):
            y = 2.0 * BRICK[1] * (column - 0.5 * columns + (0.5 if row % 2 else 0.25))
            place = (BRICK[0] + RADIUS, y, BRICK[2] * (2 * row + 1))
            scene.add_body(Box(BRICK), position=place, friction=0.6, name=f"brick_{row}_{column}")
    pivot = np.array([0.0, 0.0, LINKS * LINK + RADIUS + 0.05 + 0.8 * 2.0 * BRICK[2] * rows])
    along = np.array([-np.sin(lean), 0.0, -np.cos(lean)])
    orientation = (0.0, np.sin(lean / 2), 0.0, np.cos(lean / 2))
    above: int | None = None
    links = []
    for k in range(LINKS):
        rod, middle = Capsule(0.04, 0.5 * LINK - 0.05), pivot + (k + 0.5) * LINK * along
        link = scene.add_body(rod, position=middle, orientation=orientation, mass=LINK_MASS, name=f"link_{k}")
        scene.add_joint(SphericalJoint(), link, above, anchor=pivot + k * LINK * along)
        above = link
        links.append(link)
    end = pivot + LINKS * LINK * along
    ball = scene.add_body(Sphere(RADIUS), position=end + (RADIUS + 0.05) * along, mass=BALL_MASS, name="ball")
    scene.add_joint(SphericalJoint(), ball, above, anchor=end)
    scene.filter_pair(ball, links[-2])
    return scene


class DemolitionOutcome(ClosedJointsOutcome):
    """Bricks that were displaced, and how far joints of the chain opened."""

    prefix = "brick_"

    def judge(self, sim):
        """Chain closed, wall broken after the hit."""
        if sim.time < HIT:
            return []
        share = (self.displacement(sim) > 2.0 * BRICK[0]).mean(axis=1)
        return [
            self.closed_verdict(1e-3),
            Verdict("displaced", share, "more than 5 % of the bricks displaced by their width", share > 0.05, unit="%"),
        ]


outcome = DemolitionOutcome
DURATION = 3.0
