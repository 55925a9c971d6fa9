"""Contact points of an environment, and their impulses as lines."""

import numpy as np
from pxr import Sdf, Vt

from warp_rigid.runs.recording import Frame
from warp_rigid.scene.scene import Motion
from warp_rigid.usd.specs import Track, WrittenEnv, define, set_attribute, vec3f

NAMES = Sdf.ValueTypeNames
GRAVITY = 9.81
POINT_COLOR, LINE_COLOR = (0.8, 0.05, 0.02), (0.9, 0.5, 0.02)


class ContactMarks:
    """Writer of contact points and of a line per impulse.

    Lines are scaled so that the impulse of the weight of a body of median mass over one frame is as long as a body of
    median size.

    Args:
        env: the environment, of a recording with the scene.
    """

    def __init__(self, env: WrittenEnv):
        """Define the prims."""
        samples, root, film, row, frame = env
        assert film.scene is not None
        self._samples, self._env = samples, film.envs[row]
        dynamic = [body for body in film.scene.bodies if body.motion == Motion.DYNAMIC]
        self._size = float(np.median([body.shape.size for body in dynamic])) if dynamic else 1.0
        mass = float(np.median([body.mass for body in dynamic])) if dynamic else 1.0
        self._scale = self._size * film.fps / (mass * GRAVITY)
        self._tracks: dict[str, Track] = {}
        points = define(samples.layer, f"{root}/contacts", "Points")
        lines = define(samples.layer, f"{root}/impulses", "BasisCurves")
        set_attribute(lines, "type", NAMES.Token, "linear", uniform=True)
        for prim, width, color in ((points, 0.08, POINT_COLOR), (lines, 0.03, LINE_COLOR)):
            widths = Vt.FloatArray([width * self._size])
            set_attribute(prim, "widths", NAMES.FloatArray, widths, interpolation="constant")
            hue = Vt.Vec3fArray([color])
            set_attribute(prim, "primvars:displayColor", NAMES.Color3fArray, hue, interpolation="constant")
        for key, value in self._values(frame).items():
            prim = points if key.startswith("point") else lines
            name = key.split(".")[1]
            self._tracks[key] = samples.track(set_attribute(prim, name, _TYPES[name], value))

    def sample(self, time: float, frame: Frame) -> None:
        """Write a frame."""
        self._samples.put(self._tracks.values(), time, self._values(frame).values())

    def _values(self, frame: Frame) -> dict:
        assert frame.contacts is not None
        records = frame.contacts[frame.contacts["env"] == self._env]
        start = np.ascontiguousarray(records["position"], dtype=np.float32)
        ends = np.stack([start, start + np.float32(self._scale) * records["impulse"]], axis=1).reshape(-1, 3)
        return {
            "points.points": vec3f(start),
            "points.extent": _extent(start, 0.04 * self._size),
            "lines.points": vec3f(ends),
            "lines.curveVertexCounts": Vt.IntArray.FromNumpy(np.full(len(start), 2, dtype=np.int32)),
            "lines.extent": _extent(ends, 0.015 * self._size),
        }


_TYPES = {"points": NAMES.Point3fArray, "extent": NAMES.Float3Array, "curveVertexCounts": NAMES.IntArray}


def _extent(points: np.ndarray, margin: float) -> Vt.Vec3fArray:
    """Bounding box of points with a margin; around the origin without points."""
    if not len(points):
        points = np.zeros((1, 3), dtype=np.float32)
    box = np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin])
    return vec3f(box)
