"""Cameras of USD files: those of imported files, and the one of a written file."""

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom

from warp_rigid.render.framing import camera_directions, fit_camera, place_at_body, shifted
from warp_rigid.runs.recording import Frame, Recording
from warp_rigid.scene.camera import NARROWEST, WIDEST, Camera, camera_of_text
from warp_rigid.usd.conventions import MARK, custom_data, transform
from warp_rigid.usd.specs import SampleWriter, define, set_attribute, set_operations
from warp_rigid.usd.usd_file import UsdFile

NAMES = Sdf.ValueTypeNames
APERTURE = 20.955
"""Width of the film of a USD camera [mm]."""
ROOM = 0.08
"""What is in view on each side of the moving bodies, relative to the diagonal of the box around their middles."""
ASPECT, LINES = 16.0 / 9.0, 720
"""Shape and height of the picture that the camera is placed for."""
STRAIGHT = 1e-3
"""Largest sine of the angle by which the picture of an imported camera may be turned."""


class CameraWriter:
    """Writes the camera of a recording.

    Args:
        layer: root layer of the file.
        path: path of the prim.
        film: recording with the constant data.
        row: row of the first environment that is written.
        frame: the first frame.
    """

    def __init__(self, layer: Sdf.Layer, path: str, film: Recording, row: int, frame: Frame):
        """Define the prim."""
        self._camera, self._film, self._row = film.camera or Camera(), film, row
        self._prim = define(layer, path, "Camera")
        height = APERTURE / ASPECT
        focal_length = 0.5 * height / math.tan(0.5 * math.radians(self._camera.field_of_view))
        set_attribute(self._prim, "horizontalAperture", NAMES.Float, APERTURE)
        set_attribute(self._prim, "verticalAperture", NAMES.Float, height)
        set_attribute(self._prim, "focalLength", NAMES.Float, focal_length)
        # What the camera does is custom data; its prim has only the place.
        kept: dict[str, Any] = {"camera": str(self._camera)}
        if isinstance(self._camera.body, int):
            named = replace(self._camera, body=film.names[self._camera.body])
            kept = {"camera": str(named), "cameraBody": self._camera.body}
        self._prim.SetInfo("customData", {MARK: kept})
        self._samples = SampleWriter(layer)
        self._tracks = []
        if self._camera.body is not None:
            position, self._reach = self._followed(frame)
            place_prim(self._prim, position, self._camera)
            self._tracks = [self._samples.track(layer.GetAttributeAtPath(f"{path}.xformOp:transform"))]

    def sample(self, time: float, frame: Frame) -> None:
        """Move a camera that follows a body."""
        if self._tracks:
            self._samples.put(self._tracks, time, [_matrix(self._followed(frame)[0], self._camera)])

    def place(self, lower: np.ndarray, upper: np.ndarray, offset: np.ndarray) -> None:
        """Place the camera, when the extent of the film is known.

        Args:
            lower: lower corner of the box that should be in view [m].
            upper: upper corner [m].
            offset: (3,) where the first environment stands [m].
        """
        camera = shifted(self._camera, offset)
        if camera.body is not None:
            reach = self._reach
            shift = NAMES.Double3, Gf.Vec3d(*offset.tolist())
            set_operations(self._prim, {"translate": shift, "transform": (NAMES.Matrix4d, None)})
        elif camera.look_at is not None and camera.distance is not None:
            reach = camera.distance
            place_prim(self._prim, np.array(camera.look_at) + reach * camera_directions(camera)[0], camera)
        else:
            room = ROOM * float(np.linalg.norm(upper - lower)) * np.array((1.0, 1.0, 0.0))
            sides = zip(lower - room, upper + room, strict=True)
            fitted = fit_camera(np.array(list(itertools.product(*sides))), ASPECT, LINES, camera)
            eye = np.array(fitted.eye)
            reach = float((0.5 * (lower + upper) - eye) @ np.array(fitted.forward))
            place_prim(self._prim, eye, camera)
        set_attribute(self._prim, "clippingRange", NAMES.Float2, Gf.Vec2f(0.01 * reach, 1000.0 * reach))

    def _followed(self, frame: Frame) -> tuple[np.ndarray, float]:
        """Where the camera stands that follows a body: position (3,) and distance from the middle of the body [m]."""
        body, row = int(self._camera.body or 0), self._row
        vertices = self._film.surfaces[self._film.surface[body]].vertices_at(frame.times[row])
        return place_at_body(self._camera, vertices, frame.position[row, body], frame.orientation[row, body])


def read_camera(file: UsdFile, prim: Usd.Prim, middle: np.ndarray) -> Camera:
    """The camera of an imported file.

    Args:
        file: the file, which receives the differences.
        prim: a UsdGeom.Camera.
        middle: (3,) of the bodies, to place the point that the camera looks at [m].

    Raises:
        ValueError: The camera is orthographic, or its values are not those of a camera.
    """
    position, rotation, _ = file.frame(prim)
    custom = custom_data(prim)
    if "camera" in custom:
        return camera_of_text(str(custom["camera"]))
    if prim.GetAttribute("projection").Get() == "orthographic":
        raise ValueError("orthographic cameras are not supported")
    camera = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.EarliestTime())
    if not (camera.focalLength > 0.0 and camera.verticalAperture > 0.0):
        raise ValueError("focalLength and verticalAperture must be > 0")
    angle = camera.GetFieldOfView(Gf.Camera.FOVVertical)
    if not NARROWEST <= angle <= WIDEST:
        file.change(prim, f"its field of view of {angle:.3g} degrees is limited to {NARROWEST:g} to {WIDEST:g} degrees")
    axes = rotation / np.linalg.norm(rotation, axis=0)
    ahead = -axes[:, 2]
    reach = camera.focusDistance * file.meter or float((middle - position) @ ahead)
    made = Camera(
        tuple(position), tuple(position + max(reach, file.meter) * ahead), float(np.clip(angle, NARROWEST, WIDEST))
    )
    if abs(axes[:, 0] @ camera_directions(made)[2]) > STRAIGHT and abs(ahead[2]) < 1.0 - 1e-6:
        file.change(prim, "the picture is turned upright")
    if UsdGeom.Xformable(prim).TransformMightBeTimeVarying():
        file.change(prim, "its animated motion is ignored; it stays at the first pose of the animation")
    return made


def place_prim(prim: Sdf.PrimSpec, position: np.ndarray, camera: Camera) -> None:
    """Set the transform of a prim that looks along its own -z, as a camera at a position does."""
    set_operations(prim, {"transform": (NAMES.Matrix4d, _matrix(position, camera))})


def _matrix(position: np.ndarray, camera: Camera) -> Gf.Matrix4d:
    back, right, up = camera_directions(camera)
    return Gf.Matrix4d(transform(np.stack([right, up, back], axis=1), position).T.tolist())
