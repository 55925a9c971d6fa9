"""Cameras of a film: they frame the moving bodies and follow them."""

import math
from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_rigid.render.appearance import bound_corners
from warp_rigid.render.film import Film
from warp_rigid.render.raycast import LAMP_RADIUS, Camera
from warp_rigid.rotations import rotate

__all__ = ["CameraPath", "event_end", "fit_camera", "points_to_see"]

TOWARD_LIGHT = (-0.35, -0.55, 1.0)
FIELD_OF_VIEW = math.radians(30.0)
"""Vertical field of view of the camera [rad]."""
MARGIN = 1.12
"""Ratio of the field of view to the extent of the visible points."""
CAMERA_FRAMES = 24
"""Number of evenly spaced frames considered by the fit of a camera that does not move."""
FOLLOW_GAIN = 1.3
"""A camera follows the bodies if it comes closer to them by this factor in some frame."""
FOLLOW_PERIOD = 0.1
"""Time between the frames to which a following camera is fitted [s]."""
FOLLOW_TIME = 0.5
"""Time over which the path of a following camera is smoothed [s]."""
SHADE_REACH = 0.06
"""Distance over which surfaces occlude the sky, relative to the distance of the camera."""
STILL = 0.1
"""Speed below which a body is still, in its own sizes per second."""
SIDES = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
LONELY_ROOM = 0.5
"""Space around a single body, in its own sizes; less is added around several bodies."""
STRAY = 6.0
"""Bodies farther from the others than this multiple of the distance within which most are do not guide the camera."""
RAISE, HIGHEST = 10.0, 75.0
"""If the ground hides the view, the camera is raised by steps of this angle, up to an elevation [degree]."""
STRAY_PART = 0.02
"""An event is over when no more than this fraction of the bodies moves."""
FRAMED = 2.0
"""Size up to which a fixed body is kept in view, relative to that of all moving bodies together."""
AFTERMATH = 0.8
"""Time that a film shows after the event [s]."""


class CameraPath:
    """The camera of every frame, common to some films of equal length.

    If the bodies are much closer together in some frames than in the whole film, the camera follows them; otherwise it
    stands still.

    Args:
        films: the films.
        frames: indices of the frames that will be drawn.
        width: width of the image [pixel].
        height: height of the image [pixel].
    """

    def __init__(self, films: Sequence[Film], frames: Sequence[int], width: int, height: int):
        """Fit the cameras."""
        self._aspect, self._height, self._view = width / height, height, films[0].view
        first, last = min(frames), max(frames)
        spaced = np.unique(np.linspace(first, last, CAMERA_FRAMES).astype(int)) if last > first else np.array([last])
        step = max(1, round(FOLLOW_PERIOD * films[0].fps))
        self._keys = np.arange(first, last + step, step).clip(max=last) if last > first else np.array([last])
        seen = [np.concatenate([points_to_see(film, [int(key)]) for film in films]) for key in self._keys]
        all_seen = np.concatenate([points_to_see(film, spaced) for film in films])
        relief = np.concatenate([_relief(film) for film in films])
        self._still, fits = self._fit(all_seen), [self._fit(points) for points in seen]
        while self._view[1] < HIGHEST and any(fit.is_blocked(relief) for fit in (self._still, *fits)):
            self._view = (self._view[0], min(self._view[1] + RAISE, HIGHEST))
            self._still, fits = self._fit(all_seen), [self._fit(points) for points in seen]
        self._follows = self._still.reach > FOLLOW_GAIN * min(fit.reach for fit in fits)
        self._eyes, self._reaches = np.array([fit.eye for fit in fits]), np.array([fit.reach for fit in fits])
        if self._follows:
            self._smooth(seen, max(1, round(FOLLOW_TIME / FOLLOW_PERIOD)))

    def at(self, frame: int) -> Camera:
        """The camera of a frame."""
        if not self._follows:
            return self._still.camera
        eye = [np.interp(frame, self._keys, self._eyes[:, axis]) for axis in range(3)]
        fit = self._still.moved(np.array(eye), float(np.interp(frame, self._keys, self._reaches)))
        return fit.camera

    @property
    def mean(self) -> Camera:
        """A camera from the middle of the path, to decide what hides the bodies."""
        return self.at(int(self._keys[len(self._keys) // 2]))

    def _fit(self, points: np.ndarray) -> "_Fit":
        return _Fit(points, self._aspect, self._height, self._view)

    def _smooth(self, seen: list[np.ndarray], width: int) -> None:
        """Smooth the path, and keep the bodies in view by the farthest camera of the neighbouring frames."""
        back = -np.array(self._still.camera.forward)
        window = np.hanning(2 * width + 3)[1:-1]
        window /= window.sum()
        along = self._eyes @ back
        sideways = self._eyes - along[:, None] * back

        def padded(values):
            return np.concatenate([[values[0]] * width, values, [values[-1]] * width])

        def mean(values):
            return np.convolve(padded(values), window, mode="valid")

        def farthest(values):
            extended = padded(values)
            return np.max([extended[k : k + len(values)] for k in range(2 * width + 1)], axis=0)

        sideways = np.stack([mean(column) for column in sideways.T], axis=1)
        center = mean(along - self._reaches)
        needed = [self._still.distance(points, eye) for points, eye in zip(seen, sideways, strict=True)]
        self._reaches = mean(farthest(np.array(needed) - center))
        self._eyes = sideways + (center + self._reaches)[:, None] * back


class _Fit:
    """The closest camera that has some points in view.

    Attributes:
        camera: the camera.
        eye: its position [m].
        reach: its distance from the middle of the points [m].
    """

    def __init__(self, points: np.ndarray, aspect: float, height: int, view: tuple[float, float]):
        azimuth, elevation = np.radians(view)
        flat = math.cos(elevation)
        back = np.array((flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)))
        right = _unit(np.cross(-back, (0.0, 0.0, 1.0)))
        up = np.cross(back, right)
        tall = math.tan(FIELD_OF_VIEW / 2.0)
        wide = tall * aspect

        # Each point bounds the positions of the eye from which it is in view; the closest position that satisfies all
        # bounds is centred between the extreme ones.
        along, across, above = points @ back, points @ right, points @ up
        center_across, distance_across = _middle(across, along, wide / MARGIN)
        center_above, distance_above = _middle(above, along, tall / MARGIN)
        distance = max(distance_across, distance_above)
        eye = center_across * right + center_above * up + distance * back

        camera = Camera()
        camera.forward = wp.vec3(*-back)
        camera.right, camera.up = wp.vec3(*(wide * right)), wp.vec3(*(tall * up))
        camera.light = wp.vec3(*_unit(TOWARD_LIGHT))
        camera.lamp_radius = LAMP_RADIUS
        camera.pixel = 2.0 * tall / height
        self.camera = camera
        self._place(eye, distance - float(np.median(along)))
        camera.grid = _round_length(self.reach / 12.0)

    def distance(self, points: np.ndarray, eye: np.ndarray) -> float:
        """How far back along the axis the eye must be to have points in view."""
        along = points @ -np.array(self.camera.forward)
        distances = []
        for side in (np.array(self.camera.right), np.array(self.camera.up)):
            slope = np.linalg.norm(side)
            distances.append(along + MARGIN * np.abs((points - eye) @ side) / slope**2)
        return float(np.max(distances))

    def is_blocked(self, relief: np.ndarray) -> bool:
        """Whether points of the ground (n, 3) are above the line from the eye to the middle of the view."""
        ahead = np.array(self.camera.forward)
        along = (relief - self.eye) @ ahead
        line = self.eye + along[:, None] * ahead
        near = np.linalg.norm((relief - line)[:, :2], axis=1) < 0.15 * self.reach
        near &= (along > -0.2 * self.reach) & (along < 0.7 * self.reach)
        return bool((relief[near, 2] > line[near, 2]).any())

    def moved(self, eye: np.ndarray, reach: float) -> "_Fit":
        """The same camera at another place."""
        made = _Fit.__new__(_Fit)
        made.camera = Camera()
        for name in ("forward", "right", "up", "light", "lamp_radius", "pixel", "grid"):
            setattr(made.camera, name, getattr(self.camera, name))
        made._place(eye, reach)
        return made

    def _place(self, eye: np.ndarray, reach: float) -> None:
        self.eye, self.reach = eye, reach
        self.camera.eye = wp.vec3(*eye)
        self.camera.haze = 2.0 * reach
        self.camera.shade_reach = SHADE_REACH * reach


def fit_camera(points: np.ndarray, aspect: float, height: int, view: tuple[float, float] | None = None) -> Camera:
    """The closest camera that has all points in view.

    Args:
        points: (n, 3) [m].
        aspect: width of the image over its height.
        height: height of the image [pixel].
        view: azimuth and elevation of the camera [degree]; None uses the default of a film.
    """
    return _Fit(points, aspect, height, view or Film.view).camera


def points_to_see(film: Film, frames) -> np.ndarray:
    """Bounding box corners of moving bodies and of fixed bodies of similar size, (points, 3) [m].

    Args:
        film: the film.
        frames: indices of the frames to consider.
    """
    corners = np.stack([bound_corners(mesh.vertices) for mesh in film.meshes])[film.mesh]
    flat = np.array([mesh.flat for mesh in film.meshes])[film.mesh]
    moving = film.moving & ~flat
    if not moving.any():
        moving = ~flat if not flat.all() else np.ones_like(flat)

    def placed(chosen, frame):
        rotated = rotate(film.orientation[frame][chosen, None], corners[chosen])
        return rotated + film.position[frame][chosen, None]

    points = np.concatenate([placed(moving, frame) for frame in frames])
    # Outliers that fly away are ignored.
    middle = np.median(points.reshape(-1, 3), axis=0)
    away = np.linalg.norm(points.mean(axis=1) - middle, axis=1)
    points = points[away <= STRAY * np.percentile(away, 75.0) + 1e-9]
    size = float(np.linalg.norm(np.ptp(points.reshape(-1, 3), axis=0)))
    own = float(np.median(np.linalg.norm(np.ptp(points, axis=1), axis=1)))
    room = LONELY_ROOM * own * min(1.0, own / max(size, 1e-9))
    points = np.concatenate([points + room * np.array((*side, 0.0)) for side in SIDES])

    still = placed(~moving & ~flat, frames[0])
    small = np.linalg.norm(np.ptp(still, axis=1), axis=1) < FRAMED * size
    return np.concatenate([points.reshape(-1, 3), still[small].reshape(-1, 3)])


def _relief(film: Film) -> np.ndarray:
    """Vertices of uneven grounds: fixed, facing upward, much larger than the moving bodies; (points, 3) [m]."""
    moving = film.moving
    sizes = np.array([np.ptp(mesh.vertices, axis=0).max() for mesh in film.meshes])
    bodies = sizes[film.mesh[moving]] if moving.any() else sizes
    found = [np.zeros((0, 3))]
    for i in np.flatnonzero(~moving):
        mesh = film.meshes[film.mesh[i]]
        upward = rotate(film.orientation[0][i], mesh.normals)[..., 2] > 0.0
        if not mesh.flat and upward.all() and sizes[film.mesh[i]] > 5.0 * np.median(bodies):
            for vertices in (mesh.vertices, *mesh.frames[:: max(1, len(mesh.frames) // 4)]):
                found.append(rotate(film.orientation[0][i], vertices) + film.position[0][i])
    return np.concatenate(found)


def event_end(film: Film) -> int:
    """The last frame to show: AFTERMATH after the bodies have come to rest, or the last one of the film."""
    last = film.num_frames - 1
    moving = film.moving
    if last < 1 or not moving.any() or any(mesh.frames for mesh in film.meshes):
        return last
    size = np.stack([np.linalg.norm(np.ptp(mesh.vertices, axis=0)) for mesh in film.meshes])[film.mesh][moving]
    position, orientation = film.position[:, moving], film.orientation[:, moving]
    distance = np.linalg.norm(np.diff(position, axis=0), axis=2)
    cosine = np.abs(np.einsum("fij,fij->fi", orientation[1:], orientation[:-1])).clip(max=1.0)
    turn = 2.0 * np.arccos(cosine)
    speed = film.fps * (distance / size + 0.5 * turn)
    away = np.linalg.norm(position[-1] - np.median(position[-1], axis=0), axis=1)
    present = away <= STRAY * np.percentile(away, 75.0) + size
    busy = (speed[:, present] > STILL).sum(axis=1) > STRAY_PART * present.sum()
    rest = int(np.flatnonzero(busy)[-1]) + 1 if busy.any() else 0
    return min(last, rest + round(AFTERMATH * film.fps))


def _middle(side: np.ndarray, along: np.ndarray, slope: float) -> tuple[float, float]:
    """Position of the eye, sideways and backward, from which all |side| <= slope * depth."""
    highest, lowest = np.max(side + slope * along), np.max(-side + slope * along)
    return float(highest - lowest) / 2.0, float(highest + lowest) / 2.0 / slope


def _round_length(length: float) -> float:
    """Round down to a length of the series 1, 2, 5, 10, 20, ..."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(step for step in (1.0, 2.0, 5.0) if step <= length / power * (1.0 + 1e-9))


def _unit(vector) -> np.ndarray:
    vector = np.asarray(vector, dtype=np.float64)
    return vector / np.linalg.norm(vector)
