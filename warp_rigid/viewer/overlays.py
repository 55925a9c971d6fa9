"""Overlays of the simulator's data: boxes, cells, contacts, joints, samples and clusters."""

from collections.abc import Callable

import numpy as np
import trimesh

from warp_rigid.engine.simulator import Simulator
from warp_rigid.engine.step_reports import CONTACT_RECORD
from warp_rigid.kernels.enums import Coordinate
from warp_rigid.rotations import inverse, rotate
from warp_rigid.scene.scene import Motion

BOXES, CELLS, CONTACTS = "Swept boxes", "Hash cells", "Contacts and impulses"
JOINTS, SAMPLES, CLUSTERS = "Joints", "Samples", "Clusters of the chosen body"
OVERLAYS = (BOXES, CELLS, CONTACTS, JOINTS, SAMPLES, CLUSTERS)

MOST = 20_000
"""Largest number of items drawn of each kind."""

BOX_COLOR = (46, 110, 190)
CELL_COLOR = (150, 90, 190)
CONTACT_COLOR = (205, 40, 40)
JOINT_COLOR = (20, 140, 90)
SAMPLE_COLOR = (20, 20, 20)
KEPT_COLOR, REJECTED_COLOR = (235, 120, 20), (150, 155, 160)

BOX_EDGES = np.array([[a, b] for a in range(8) for b in range(8) if a < b and (a ^ b) in (1, 2, 4)])
"""Pairs of a box's corners; bit k of a corner's index states which end of axis k."""


class Overlays:
    """Scene nodes that show intermediate results of the step.

    Args:
        server: the viser server.

    Attributes:
        shown: names from OVERLAYS that are switched on.
    """

    def __init__(self, server):
        """Create the overlays, all switched off."""
        self._scene = server.scene
        self._nodes = {}
        self._size: float | None = None
        self.shown: set[str] = set()

    def switch(self, name: str, on: bool) -> None:
        """Switch an overlay on, to be drawn by the next `update`, or off immediately."""
        if on:
            self.shown.add(name)
            return
        self.shown.discard(name)
        for key in self._nodes:
            if key.partition(": ")[0] == name:
                self._hide(key)

    def clear(self) -> None:
        """Remove everything from the page, for another scene."""
        for node in self._nodes.values():
            node.remove()
        self._nodes = {}
        self._size = None

    def update(self, sim: Simulator, rows: np.ndarray, offsets: np.ndarray, chosen: tuple[int, int]) -> None:
        """Draw the overlays that are on, for the current state.

        Args:
            sim: the simulator.
            rows: environments on the page.
            offsets: (rows, 3) where they stand [m].
            chosen: environment and body whose clusters are drawn.
        """
        if self._size is None:
            dynamic = [body.shape.bounds for body in sim.scene.bodies if body.motion == Motion.DYNAMIC]
            # Lines and points scale with the longest edge of the median body.
            self._size = float(np.median(np.ptp(dynamic, axis=1).max(axis=1))) if dynamic else 1.0
        draw = {
            BOXES: self._boxes,
            CELLS: self._cells,
            CONTACTS: self._contacts,
            JOINTS: self._joints,
            SAMPLES: self._samples,
            CLUSTERS: lambda sim, rows, offsets, _: self._clusters(sim, rows, offsets, chosen),
        }
        for name, action in draw.items():
            if name in self.shown:
                action(sim, rows, offsets, self._size)

    def _boxes(self, sim, rows, offsets, size) -> None:
        boxes = sim.swept_boxes()[rows] + offsets[:, None, None]
        boxes = boxes.reshape(-1, 2, 3)
        ends = np.abs(boxes).max(axis=(1, 2)) < 1.0e6
        self._lines(BOXES, box_lines(boxes[ends][:MOST]), BOX_COLOR, size)

    def _cells(self, sim, rows, offsets, size) -> None:
        """Cells of the broad phase's grid that hold the middle of a body's box."""
        moving = [i for i, body in enumerate(sim.scene.bodies) if body.motion == Motion.DYNAMIC]
        width = sim.grid_cell
        lines = []
        for row, offset in zip(rows, offsets, strict=True):
            middle = sim.swept_boxes()[row, moving].mean(axis=1)
            cells = np.unique(np.floor(middle / width), axis=0)[:MOST]
            lines.append(box_lines(np.stack([cells, cells + 1.0], axis=1) * width + offset))
        self._lines(CELLS, np.concatenate(lines), CELL_COLOR, size)

    def _contacts(self, sim, rows, offsets, size) -> None:
        """A ball at each contact and its impulse as an arrow; its length grows with the square root of the impulse."""
        place = np.full(sim.num_envs, -1)
        place[rows] = np.arange(len(rows))
        records = sim.contacts()
        records = records[place[records["env"]] >= 0][:MOST].astype(CONTACT_RECORD)
        points = records["position"] + offsets[place[records["env"]]]
        self._points(CONTACTS, points, CONTACT_COLOR, 0.09 * size)
        # As it acts on the body above, where there is an above.
        weight = sim.get("gravity")[records["env"]]
        upward = np.einsum("ij,ij->i", records["impulse"], weight) <= 0.0
        impulse = np.where(upward[:, None], records["impulse"], -records["impulse"])
        strength = np.linalg.norm(impulse, axis=1, keepdims=True)
        pushes = strength[:, 0] > 0.0
        gravity = float(np.linalg.norm(sim.get("gravity")[rows[0]])) or 9.81
        mass = sim.get("mass")[rows[0]]
        usual = float(np.median(mass[mass > 0.0])) * gravity * sim.settings.dt
        length = size * np.clip(np.sqrt(strength[pushes] / usual), 0.0, 3.0)
        ends = points[pushes] + impulse[pushes] / strength[pushes] * length
        arrows = np.stack([points[pushes], ends], axis=1)
        look = {"shaft_radius": 0.018 * size, "head_radius": 0.05 * size, "head_length": 0.12 * size}
        self._draw(f"{CONTACTS}: arrows", arrows, self._scene.add_arrows, CONTACT_COLOR, **look)

    def _joints(self, sim, rows, offsets, size) -> None:
        """A ball at both anchors of each joint that is not broken, and a line between them or along its axis."""
        points, axes = joint_lines(sim, rows, size)
        points, axes = (some + offsets[:, None, None] for some in (points, axes))
        whole = ~sim.get("joint_broken")[rows][:, : points.shape[1]]
        self._points(JOINTS, points[whole].reshape(-1, 3)[:MOST], JOINT_COLOR, 0.12 * size)
        self._lines(f"{JOINTS}: axes", axes[whole][:MOST], JOINT_COLOR, 2.0 * size)

    def _samples(self, sim, rows, offsets, size) -> None:
        position, orientation = sim.get("position"), sim.get("orientation")
        points = []
        for body, data in enumerate(sim.scene.bodies):
            local = data.shape.samples().point
            if data.motion == Motion.DYNAMIC and len(local):
                turned = rotate(orientation[rows, body][:, None], local[None]) + position[rows, body][:, None]
                points.append((turned + offsets[:, None]).reshape(-1, 3))
        flat = np.concatenate(points) if points else np.zeros((0, 3))
        self._points(SAMPLES, flat[:MOST], SAMPLE_COLOR, 0.045 * size)

    def _clusters(self, sim, rows, offsets, chosen) -> None:
        """Spheres around the clusters of the selected body: grey where no other body is within reach."""
        env, body = chosen
        samples = sim.scene.bodies[body].shape.samples()
        if env not in rows or not len(samples.cluster_radius):
            self._hide(CLUSTERS)
            return
        center = rotate(sim.get("orientation")[env, body], samples.cluster_center) + sim.get("position")[env, body]
        kept = np.zeros(len(center), bool)
        for other in _near(sim, env, body):
            back = inverse(sim.get("orientation")[env, other])
            local = rotate(back, center - sim.get("position")[env, other])
            kept |= sim.scene.bodies[other].shape.signed_distance(local)[0] <= samples.cluster_radius
        colors = np.where(kept[:, None], KEPT_COLOR, REJECTED_COLOR).astype(np.uint8)
        radius = np.maximum(samples.cluster_radius, 0.01 * self._size).astype(np.float32)
        places = (center + offsets[list(rows).index(env)]).astype(np.float32)
        node = self._nodes.get(CLUSTERS)
        if node is not None and len(node.batched_positions) == len(places):
            node.batched_positions, node.batched_colors = places, colors
            node.visible = True
            return
        ball = trimesh.creation.icosphere(subdivisions=1)
        self._nodes[CLUSTERS] = self._scene.add_batched_meshes_simple(
            "/overlay/clusters",
            ball.vertices,
            ball.faces,
            batched_positions=places,
            batched_wxyzs=np.tile(np.float32([1, 0, 0, 0]), (len(places), 1)),
            batched_scales=radius,
            batched_colors=colors,
            lod="off",
            opacity=0.35,
            cast_shadow=False,
            receive_shadow=False,
        )

    def _lines(self, name: str, segments: np.ndarray, color, size: float) -> None:
        self._draw(name, segments, self._scene.add_line_segments, color, thickness=0.012 * size)

    def _points(self, name: str, points: np.ndarray, color, size: float) -> None:
        look = {"point_size": size, "point_shape": "circle", "precision": "float32"}
        self._draw(name, points, self._scene.add_point_cloud, color, **look)

    def _draw(self, name: str, points: np.ndarray, add: Callable, color, **look) -> None:
        """Show points in the node of a name, which is added with the first ones; none hide it."""
        if not len(points):
            self._hide(name)
        elif name in self._nodes:
            self._nodes[name].points = points.astype(np.float32)
            self._nodes[name].visible = True
        else:
            self._nodes[name] = add(f"/overlay/{name}", points, color, **look)

    def _hide(self, name: str) -> None:
        if name in self._nodes:
            self._nodes[name].visible = False


def joint_lines(sim: Simulator, rows: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Both anchors of each joint, and the segment that is drawn for it, two (rows, joints, 2, 3) arrays [m].

    The segment is the axis of a revolute or prismatic joint, of length `size`; else it connects the anchors.
    """
    position, orientation = sim.get("position")[rows], sim.get("orientation")[rows]

    points = np.zeros((len(rows), len(sim.scene.joints), 2, 3))
    axes = points.copy()
    for k, entry in enumerate(sim.scene.joints):
        points[:, k] = np.stack(entry.anchors(position, orientation), axis=1)
        axis = rotate(np.array(entry.frame_b.orientation), np.array([1.0, 0, 0]))
        axis = axis if entry.body_b is None else rotate(orientation[:, entry.body_b], axis)
        turning = entry.joint.coordinate in (Coordinate.ANGLE, Coordinate.SLIDE)
        half = 0.5 * size * axis
        axes[:, k] = np.stack([points[:, k, 0] - half, points[:, k, 0] + half], axis=1) if turning else points[:, k]
    return points, axes


def box_lines(boxes: np.ndarray) -> np.ndarray:
    """The edges of boxes (n, 2, 3) given by two corners, as (12 n, 2, 3) segments."""
    corners = np.stack([[boxes[:, (c >> axis) & 1, axis] for axis in range(3)] for c in range(8)]).transpose(2, 0, 1)
    return corners[:, BOX_EDGES].reshape(-1, 2, 3)


def _near(sim: Simulator, env: int, body: int) -> np.ndarray:
    """Bodies whose swept boxes overlap that of a body."""
    lower, upper = np.moveaxis(sim.swept_boxes()[env], 1, 0)
    near = (lower <= upper[body]).all(axis=1) & (upper >= lower[body]).all(axis=1)
    near[body] = False
    return np.flatnonzero(near)
