"""Where cameras stand: they frame the moving bodies and follow them, or are placed."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.render.appearance import bound_corners
from warp_rigid.render.film import Film
from warp_rigid.render.raycast import LAMP_RADIUS
from warp_rigid.render.shading import CameraView
from warp_rigid.rotations import rotate
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.scene import Motion

TOWARD_LIGHT = (-0.35, -0.55, 1.0)
DEFAULT = Camera()
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
"""Size up to which a fixed body near the moving ones is kept in view, relative to that of all of these together."""
FOLLOWED_PART = 3.0
"""Height of the picture, relative to the body that a camera follows."""
FRAMED_NEAR, WAITING_NEAR = 0.5, 2.0
"""Distances up to which such a body is near, relative to that size; the second one of kinematic bodies."""
AFTERMATH = 0.8
"""Time that a film shows after the event [s]."""


class CameraPath:
    """The views of every frame, common to some films of equal length.

    A camera that keeps the moving bodies in view follows them if they are much closer together in some frames than in
    the whole film; otherwise it stands still.

    Args:
        films: the films, with one camera.
        frames: indices of the frames that will be drawn.
        width: width of the image [pixel].
        height: height of the image [pixel].
    """

    def __init__(self, films: Sequence[Film], frames: Sequence[int], width: int, height: int):
        """Fit the cameras."""
        self._films, self._camera = films, shifted(films[0].camera, films[0].offset[0])
        self._aim = _Aim(self._camera, width / height, height)
        self._middle = (min(frames) + max(frames)) // 2
        self._is_placed = is_placed(self._camera)
        if not self._is_placed:
            self._fit(min(frames), max(frames))

    def at(self, frame: int, film: int = 0) -> CameraView:
        """The view of a frame of one of the films."""
        if self._is_placed:
            return self._aim.view(*place_camera(self._camera, self._films[film], frame))
        if not self._follows:
            return self._aim.view(*self._still, self._grid)
        eye = np.array([np.interp(frame, self._keys, self._eyes[:, axis]) for axis in range(3)])
        return self._aim.view(eye, float(np.interp(frame, self._keys, self._reaches)), self._grid)

    @property
    def mean(self) -> CameraView:
        """A view from the middle of the path, to decide what hides the bodies."""
        return self.at(self._middle)

    def _fit(self, first: int, last: int) -> None:
        """Keep the moving bodies of all films in view."""
        films, aim = self._films, self._aim
        spaced = np.unique(np.linspace(first, last, CAMERA_FRAMES).astype(int))
        step = max(1, round(FOLLOW_PERIOD * films[0].fps))
        self._keys = np.arange(first, last + step, step).clip(max=last)
        seen = [np.concatenate([points_to_see(film, [int(key)]) for film in films]) for key in self._keys]
        all_seen = np.concatenate([points_to_see(film, spaced) for film in films])
        relief = np.concatenate([_relief(film) for film in films])
        still, fits = aim.fit(all_seen), [aim.fit(points) for points in seen]
        while aim.camera.elevation < HIGHEST and any(aim.is_blocked(*fit, relief) for fit in (still, *fits)):
            aim = aim.raised()
            still, fits = aim.fit(all_seen), [aim.fit(points) for points in seen]
        self._aim, self._still, self._grid = aim, still, grid_length(still[1])
        self._middle = int(self._keys[len(self._keys) // 2])
        self._follows = still[1] > FOLLOW_GAIN * min(reach for _, reach in fits)
        self._eyes, self._reaches = np.array([eye for eye, _ in fits]), np.array([reach for _, reach in fits])
        if self._follows:
            self._smooth(seen, max(1, round(FOLLOW_TIME / FOLLOW_PERIOD)))

    def _smooth(self, seen: list[np.ndarray], width: int) -> None:
        """Smooth the path, and keep the bodies in view by the farthest camera of the neighbouring frames."""
        back = self._aim.back
        window = np.hanning(2 * width + 3)[1:-1]
        window /= window.sum()
        along = self._eyes @ back
        sideways = self._eyes - along[:, None] * back

        def neighbours(values):
            return np.lib.stride_tricks.sliding_window_view(np.pad(values, width, "edge"), 2 * width + 1)

        sideways = np.stack([neighbours(column) @ window for column in sideways.T], axis=1)
        center = neighbours(along - self._reaches) @ window
        needed = [self._aim.depth(points, eye) for points, eye in zip(seen, sideways, strict=True)]
        farthest = neighbours(np.array(needed) - center).max(axis=1)
        self._reaches = neighbours(farthest) @ window
        self._eyes = sideways + (center + self._reaches)[:, None] * back


def is_placed(camera: Camera) -> bool:
    """Whether a camera has its place without regard to the bodies that move."""
    return camera.body is not None or (camera.look_at is not None and camera.distance is not None)


def shifted(camera: Camera, offset: np.ndarray) -> Camera:
    """A camera in the coordinates of an environment, in those of a film where the environment stands at `offset`."""
    if camera.look_at is None:
        return camera
    moved: dict[str, Any] = {
        name: tuple(np.add(value, offset).tolist())
        for name in ("position", "look_at")
        if (value := getattr(camera, name)) is not None
    }
    return replace(camera, **moved)


def place_camera(camera: Camera, film: Film, frame: int) -> tuple[np.ndarray, float]:
    """Where a camera stands that is placed or follows a body: position (3,) and distance from what it looks at [m].

    Args:
        camera: the camera, in the coordinates of the film.
        film: the film, for the bodies.
        frame: index of the frame.

    Raises:
        ValueError: The film does not show the body that the camera follows.
    """
    if camera.body is None:
        assert camera.look_at is not None and camera.distance is not None
        return np.array(camera.look_at) + camera.distance * camera_directions(camera)[0], camera.distance
    found = np.flatnonzero(film.body == camera.body)
    if not len(found):
        raise ValueError(f"camera: body {camera.body} is not in the film")
    at = int(found[0])
    vertices = film.meshes[film.mesh[at]].vertices
    return place_at_body(camera, vertices, film.position[frame, at], film.orientation[frame, at])


def place_at_body(
    camera: Camera, vertices: np.ndarray, position: np.ndarray, orientation: np.ndarray
) -> tuple[np.ndarray, float]:
    """Where a camera stands that follows a body: position (3,) and distance from the middle of the body [m].

    Args:
        camera: the camera.
        vertices: (n, 3) of the body, in its frame [m].
        position: (3,) of the body [m].
        orientation: (4,) of the body.
    """
    corners = bound_corners(vertices)
    middle = corners.mean(axis=0)
    distance = camera.distance
    if distance is None:
        radius = 0.5 * float(np.ptp(corners, axis=0).max())
        distance = FOLLOWED_PART * radius / math.sin(0.5 * math.radians(camera.field_of_view))
    target = rotate(np.asarray(orientation, np.float64), middle) + position
    return np.nan_to_num(target) + distance * camera_directions(camera)[0], distance


def camera_directions(camera: Camera) -> np.ndarray:
    """Unit vectors backward, right and up of a camera, (3, 3)."""
    azimuth, elevation = math.radians(camera.azimuth), math.radians(camera.elevation)
    flat = math.cos(elevation)
    back = np.array((flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)))
    right = np.array((-math.sin(azimuth), math.cos(azimuth), 0.0))
    return np.stack([back, right, np.cross(back, right)])


class _Aim:
    """Direction and field of view of a camera.

    Attributes:
        camera: the camera.
        back: unit vector from what it looks at to the camera.
    """

    def __init__(self, camera: Camera, aspect: float, height: int):
        self.camera, self._aspect, self._height = camera, aspect, height
        self.back, self._right, self._up = camera_directions(camera)
        self._tall = math.tan(0.5 * math.radians(camera.field_of_view))
        self._wide = self._tall * aspect

    def raised(self) -> "_Aim":
        """A camera that looks from higher up."""
        elevation = max(self.camera.elevation, min(self.camera.elevation + RAISE, HIGHEST))
        return _Aim(replace(self.camera, elevation=elevation), self._aspect, self._height)

    def fit(self, points: np.ndarray) -> tuple[np.ndarray, float]:
        """Position of the closest camera that has some points in view, and its distance from their middle [m]."""
        # Each point bounds the positions of the eye from which it is in view; the closest position that satisfies all
        # bounds is centred between the extreme ones.
        along, across, above = points @ self.back, points @ self._right, points @ self._up
        center_across, distance_across = _middle(across, along, self._wide / MARGIN)
        center_above, distance_above = _middle(above, along, self._tall / MARGIN)
        depth, middle = max(distance_across, distance_above), float(np.median(along))
        if self.camera.look_at is not None:
            target = np.array(self.camera.look_at)
            depth = self.depth(points, target)
            center_across, center_above, middle = target @ self._right, target @ self._up, target @ self.back
        if self.camera.distance is not None:
            depth = middle + self.camera.distance
        return center_across * self._right + center_above * self._up + depth * self.back, float(depth - middle)

    def depth(self, points: np.ndarray, eye: np.ndarray) -> float:
        """How far back along the axis the eye must be to have points in view."""
        along = points @ self.back
        across = np.abs((points - eye) @ self._right) / self._wide
        above = np.abs((points - eye) @ self._up) / self._tall
        return float(np.max(along + MARGIN * np.maximum(across, above)))

    def view(self, eye: np.ndarray, reach: float, grid: float | None = None) -> CameraView:
        """What is seen from a position, at a distance `reach` from the middle of the picture [m]."""
        view = CameraView()
        view.eye, view.forward = wp.vec3(*eye), wp.vec3(*-self.back)
        view.right, view.up = wp.vec3(*(self._wide * self._right)), wp.vec3(*(self._tall * self._up))
        view.light = wp.vec3(*(np.array(TOWARD_LIGHT) / np.linalg.norm(TOWARD_LIGHT)))
        view.lamp_radius = LAMP_RADIUS
        view.pixel = 2.0 * self._tall / self._height
        view.grid = grid or grid_length(reach)
        view.haze = 2.0 * reach
        view.shade_reach = SHADE_REACH * reach
        return view

    def is_blocked(self, eye: np.ndarray, reach: float, relief: np.ndarray) -> bool:
        """Whether points of the ground (n, 3) are above the line from the eye to the middle of the view."""
        along = (relief - eye) @ -self.back
        line = eye - along[:, None] * self.back
        near = np.linalg.norm((relief - line)[:, :2], axis=1) < 0.15 * reach
        near &= (along > -0.2 * reach) & (along < 0.7 * reach)
        return bool((relief[near, 2] > line[near, 2]).any())


def fit_camera(points: np.ndarray, aspect: float, height: int, camera: Camera = DEFAULT) -> CameraView:
    """The view of the closest camera that has all points in view.

    Args:
        points: (n, 3) [m].
        aspect: width of the image over its height.
        height: height of the image [pixel].
        camera: direction and field of view of the camera.
    """
    aim = _Aim(camera, aspect, height)
    return aim.view(*aim.fit(points))


def points_to_see(film: Film, frames) -> np.ndarray:
    """Bounding box corners of the dynamic and the moving bodies, and of small other ones near them, (points, 3) [m].

    Absent bodies count only where nothing else than grounds is present.

    Args:
        film: the film.
        frames: indices of the frames to consider.
    """
    corners = np.stack([bound_corners(mesh.vertices) for mesh in film.meshes])[film.mesh]
    flat = film.flat
    kinds = ((film.moving | film.dynamic) & ~flat, ~flat, np.ones_like(flat))
    choices = [kind & film.present for kind in kinds[:2]] + [np.tile(kind, (film.num_frames, 1)) for kind in kinds]
    seen = next(choice for choice in choices if choice.any())
    moving, filled = seen.any(axis=0), np.flatnonzero(seen.any(axis=1))
    nearest = filled[[np.abs(filled - frames[0]).argmin()]]
    frames = np.intersect1d(frames, filled) if np.isin(frames, filled).any() else nearest

    def placed(chosen, frame):
        rotated = rotate(film.orientation[frame][chosen, None], corners[chosen])
        return rotated + film.position[frame][chosen, None]

    points = np.concatenate([placed(seen[frame], frame) for frame in frames])
    # Outliers that fly away are ignored.
    middle = np.median(points.reshape(-1, 3), axis=0)
    away = np.linalg.norm(points.mean(axis=1) - middle, axis=1)
    points = points[away <= STRAY * np.percentile(away, 75.0) + 1e-9]
    size = float(np.linalg.norm(np.ptp(points.reshape(-1, 3), axis=0)))
    own = float(np.median(np.linalg.norm(np.ptp(points, axis=1), axis=1)))
    room = LONELY_ROOM * own * min(1.0, own / max(size, 1e-9))
    points = np.concatenate([points + room * np.array((*side, 0.0)) for side in SIDES])

    others = ~moving & ~flat & film.present[frames[0]]
    still = placed(others, frames[0])
    lower, upper = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    apart = np.maximum(still.min(axis=1) - upper, lower - still.max(axis=1)).clip(min=0.0)
    kept = np.linalg.norm(np.ptp(still, axis=1), axis=1) < FRAMED * size
    near = np.where(film.motion[others] == Motion.KINEMATIC, WAITING_NEAR, FRAMED_NEAR)
    kept &= np.linalg.norm(apart, axis=1) < near * size
    return np.concatenate([points.reshape(-1, 3), still[kept].reshape(-1, 3)])


def _relief(film: Film) -> np.ndarray:
    """Vertices of uneven grounds: fixed, facing upward, much larger than the moving bodies; (points, 3) [m]."""
    moving = film.moving
    sizes = np.array([np.ptp(mesh.vertices, axis=0).max() for mesh in film.meshes])
    bodies = sizes[film.mesh[moving]] if moving.any() else sizes
    found = [np.zeros((0, 3))]
    for i in np.flatnonzero(~moving & film.present.all(axis=0)):
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
    present = film.present[:, moving]
    # A body that appears or vanishes is an event.
    speed = film.fps * (distance / size + 0.5 * turn)
    busy = np.where(present[1:] & present[:-1], speed > STILL, present[1:] != present[:-1])
    if present[-1].any():
        away = np.linalg.norm(position[-1] - np.median(position[-1, present[-1]], axis=0), axis=1)
        near = away <= STRAY * np.percentile(away[present[-1]], 75.0) + size
        busy = busy[:, near | ~present[-1]]
    busy = busy.sum(axis=1) > STRAY_PART * busy.shape[1]
    rest = int(np.flatnonzero(busy)[-1]) + 1 if busy.any() else 0
    return min(last, rest + round(AFTERMATH * film.fps))


def _middle(side: np.ndarray, along: np.ndarray, slope: float) -> tuple[float, float]:
    """Position of the eye, sideways and backward, from which all |side| <= slope * depth."""
    highest, lowest = np.max(side + slope * along), np.max(-side + slope * along)
    return float(highest - lowest) / 2.0, float(highest + lowest) / 2.0 / slope


def grid_length(reach: float) -> float:
    """Distance between the lines of grounds at a distance from the camera: of the series 1, 2, 5, 10, 20, ... [m]."""
    length = reach / 12.0
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(step for step in (1.0, 2.0, 5.0) if step <= length / power * (1.0 + 1e-9))
