"""Appearance of a recording: colours, normals and the layout of its environments.

Shared by the USD writer and the renderer, so that both show the same.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np

from warp_rigid.rotations import rotate
from warp_rigid.runs.drawn_surface import DrawnSurface
from warp_rigid.runs.recording import Frame, Recording, is_moving
from warp_rigid.scene.look import Look
from warp_rigid.scene.scene import Motion
from warp_rigid.scene.shapes.analytic import DRAWN_HALF_WIDTH

# sRGB colours. Neighbours in the list differ in hue and lightness, so that consecutive bodies are distinguishable
# with colour blindness.
DYNAMIC_COLORS = (
    "#e07a3f", "#3f7fbf", "#f2c14e", "#4b9e86", "#b5483a",
    "#8fbcd4", "#6d5a9c", "#a9b665", "#d98a9e", "#5b6770",
)  # fmt: skip
STATIC_COLOR = "#c9c6bf"
KINEMATIC_COLOR = "#9a8f7a"
ASLEEP_COLOR = "#3c4a63"

COLORINGS = ("body", "environment", "level", "speed", "asleep")
"""Quantities that can determine the colour of a dynamic body: its index, environment, level in the contact graph,
speed, or whether it is asleep."""

UNSUPPORTED_COLOR = "#8a8f96"
LEVEL_COUNT = 5
"""Number of levels of the contact graph after which their colours repeat."""
TOP_SPEED = 2.0
"""Speed of the last colour [m/s]."""

CREASE_ANGLE = math.radians(40.0)
ROW_LENGTH = 5
"""Maximum number of environments in a single row; more are arranged in a square grid."""
PLANE_ROOM = 4.0
"""Width of a drawn plane, relative to the distance of the bodies from its middle."""
SPACING = 1.35
"""Distance between environments, relative to their width."""


def linear_color(code: str) -> np.ndarray:
    """A screen colour "#rrggbb" as linear light, which USD and the shading expect, (3,)."""
    return linear_light(np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]))


def linear_light(screen: np.ndarray) -> np.ndarray:
    """Screen colours (sRGB), 0 to 255, as linear light."""
    value = screen / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def on_screen(light: np.ndarray) -> np.ndarray:
    """Convert linear RGB to sRGB, both from 0 to 1."""
    light = np.clip(light, 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)


@cache
def color_map(count: int) -> np.ndarray:
    """`count` equally spaced colours of the map viridis, (count, 3) float32 in linear light.

    The darkest fifth of the map is left out, because shading would not be visible on it.
    """
    from trimesh.visual import interpolate

    values = np.append(0.0, np.linspace(0.2, 1.0, count))  # the first value makes the map's range 0 to 1
    return linear_light(interpolate(values, "viridis")[1:, :3]).astype(np.float32)


def body_colors(motion, looks: Mapping[int, Look] | None = None) -> np.ndarray:
    """One colour a body, (bodies, 3) float32 in linear light: that of its look, else grey static, bright dynamic."""
    motion = np.asarray(motion)
    colors = environment_colors(np.cumsum(motion == Motion.DYNAMIC) - 1)
    colors[motion == Motion.STATIC] = linear_color(STATIC_COLOR)
    colors[motion == Motion.KINEMATIC] = linear_color(KINEMATIC_COLOR)
    for body, look in (looks or {}).items():
        if look.color is not None:
            colors[body] = look.color
    return colors


def body_gloss(count: int, looks: Mapping[int, Look]) -> np.ndarray:
    """Roughness and metallic of each body, (bodies, 2) float32; (1, 0), matt, without a look."""
    gloss = np.tile(np.array((1.0, 0.0), np.float32), (count, 1))
    for body, look in looks.items():
        gloss[body] = look.roughness, look.metallic
    return gloss


def drawn_looks(recording: Recording, coloring: str = "body") -> dict[int, Look]:
    """Looks of bodies by their index, with images only where they are shown.

    These are the bodies whose meshes have texture coordinates, without those that another colouring colours.
    """
    dynamic = np.asarray(recording.motion) == Motion.DYNAMIC

    def shown(body: int) -> bool:
        return recording.surfaces[recording.surface[body]].uv is not None and (coloring == "body" or not dynamic[body])

    return {body: look if shown(body) else replace(look, image=None) for body, look in recording.looks.items()}


def environment_colors(env) -> np.ndarray:
    """A colour for each environment by its number, (...) -> (..., 3) float32 in linear light."""
    palette = np.array([linear_color(code) for code in DYNAMIC_COLORS])
    return palette[np.asarray(env) % len(palette)].astype(np.float32)


def level_colors(level) -> np.ndarray:
    """A colour for each level of the contact graph, (...) -> (..., 3) float32 in linear light."""
    level = np.asarray(level)
    supported = color_map(LEVEL_COUNT)[(level - 1) % LEVEL_COUNT]
    return np.where((level > 0)[..., None], supported, linear_color(UNSUPPORTED_COLOR).astype(np.float32))


def speed_colors(speed) -> np.ndarray:
    """A colour for each speed, the last for TOP_SPEED and above, (...) [m/s] -> (..., 3) float32 in linear light.

    A speed that is not a number has the colour of rest.
    """
    part = np.clip(np.nan_to_num(speed) / TOP_SPEED, 0.0, 1.0)
    return color_map(256)[np.rint(255.0 * part).astype(int)]


def apply_coloring(coloring: str, plain, dynamic, values) -> np.ndarray:
    """Colours of bodies by a colouring.

    Args:
        coloring: one of COLORINGS.
        plain: (..., 3) colours of the bodies by index.
        dynamic: (...) mask of the dynamic bodies.
        values: (...) the quantity: index of the environment, level, speed [m/s] or whether the body is asleep; ignored
            for the colouring "body".

    Returns:
        (..., 3) float32, linear RGB.
    """
    if coloring == "body":
        return plain
    if coloring == "asleep":
        return np.where((dynamic & values)[..., None], linear_color(ASLEEP_COLOR).astype(np.float32), plain)
    color_of = {"environment": environment_colors, "level": level_colors, "speed": speed_colors}[coloring]
    return np.where(np.asarray(dynamic)[..., None], color_of(values), plain)


def frame_colors(coloring: str, recording: Recording, row: int, frame: Frame) -> np.ndarray:
    """Colours of the bodies of one environment in one frame, (bodies, 3) float32, linear RGB.

    Args:
        coloring: one of COLORINGS.
        recording: recording with the constant data.
        row: row of the environment in the recording.
        frame: the frame.

    Raises:
        ValueError: The colouring is "speed", but velocities were not recorded.
    """
    values = None
    if coloring == "environment":
        values = np.full(len(recording.motion), recording.envs[row])
    elif coloring == "speed":
        if frame.linear_velocity is None:
            raise ValueError("color: speed requires a recording with velocities")
        values = np.linalg.norm(frame.linear_velocity[row], axis=-1)
    elif coloring != "body":
        values = getattr(frame, coloring)[row]
    return apply_coloring(
        coloring, body_colors(recording.motion, recording.looks), recording.motion == Motion.DYNAMIC, values
    )


def corner_normals(vertices, faces) -> np.ndarray:
    """Unit normals for each corner of each triangle: smooth, but sharp at creases.

    A corner takes the area-weighted mean over the triangles around its vertex whose normals lie
    within CREASE_ANGLE of its own. Vertices in the same place count as one.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3).

    Returns:
        (m, 3, 3) float32.
    """
    vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces)
    if len(faces) == 0:
        return np.zeros((0, 3, 3), dtype=np.float32)
    place = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)[faces].reshape(-1)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    area = np.cross(b - a, c - a)
    unit = _normalised(area, fallback=(0.0, 0.0, 1.0))

    # All pairs of corners that share a vertex, without a loop: corners sorted by vertex form runs.
    order = np.argsort(place, kind="stable")
    start = np.searchsorted(place[order], place, side="left")
    count = np.searchsorted(place[order], place, side="right") - start
    corner = np.repeat(np.arange(len(place)), count)
    within = np.arange(len(corner)) - np.repeat(np.cumsum(count) - count, count)
    face, other = corner // 3, order[np.repeat(start, count) + within] // 3

    smooth = np.einsum("ij,ij->i", unit[face], unit[other]) >= math.cos(CREASE_ANGLE)
    total = np.stack(
        [np.bincount(corner, np.where(smooth, area[other, axis], 0.0), len(place)) for axis in range(3)],
        axis=1,
    )
    normals = _normalised(total, fallback=np.repeat(unit, 3, axis=0))
    return normals.reshape(-1, 3, 3).astype(np.float32)


def bound_corners(vertices) -> np.ndarray:
    """The eight corners of the bounding box of some points, (8, 3)."""
    bounds = np.stack([np.min(vertices, axis=0), np.max(vertices, axis=0)])
    return np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i, j, k in np.ndindex(2, 2, 2)])


class Spread:
    """Extent of an environment, accumulated over frames.

    Includes all finite bodies in the first frame in which they are active, and the moving bodies in later frames except
    outliers.

    Args:
        recording: provides the surfaces, the motions and the first frame.
    """

    def __init__(self, recording: Recording):
        """Start with the bounds of the first frame."""
        self._moving, self._recording = is_moving(recording.motion), recording
        self._seen = np.zeros(recording.active[0].shape, bool)
        self._all, self._moved = ([np.full(3, np.inf), np.full(3, -np.inf)] for _ in range(2))
        self._reach = 0.0
        self._appear(recording.position[0], recording.orientation[0], recording.active[0])

    def _appear(self, position: np.ndarray, orientation: np.ndarray, active: np.ndarray) -> None:
        """Include the bounds of bodies that are active for the first time."""
        new = active & ~self._seen
        if not new.any():
            return
        self._seen |= new
        place = np.where(new[..., None], position, np.nan)
        for index, surface in enumerate(self._recording.surfaces):
            bodies = np.flatnonzero(self._recording.surface == index)
            if len(surface.vertices) == 0 or (surface.endless and not self._moving[bodies].any()):
                continue
            turned = rotate(orientation[:, bodies, None], bound_corners(surface.vertices))
            corners = turned + place[:, bodies, None]
            _include(self._all, corners)
            _include(self._moved, corners[:, self._moving[bodies]])

    def add(self, frame: Frame, rows: np.ndarray) -> None:
        """Add the positions of the active bodies in some rows of a frame."""
        self._appear(frame.position, frame.orientation, frame.active)
        position = frame.position[rows][frame.active[rows] & self._moving]
        if len(position):
            sideways = np.abs(position[:, :2]).max(axis=-1)
            finite = sideways[np.isfinite(sideways)]
            self._reach = max(self._reach, float(np.percentile(finite, 98.0)) if finite.size else 0.0)
            extremes = np.percentile(position, (5.0, 95.0), axis=0)
            _include(self._all, extremes)
            _include(self._moved, extremes)

    def spacing(self) -> np.ndarray:
        """Distances between neighbouring environments along x and y, (2,) [m]."""
        extent = (self._all[1] - self._all[0])[:2]
        return np.where(np.isfinite(extent), np.maximum(SPACING * extent, 1e-3), 1.0)

    def moving_corners(self, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the box around the moving bodies of all environments at these translations [m].

        Without moving bodies, it is the box around all bodies.
        """
        for lower, upper in (self._moved, self._all):
            if np.isfinite(lower).all() and np.isfinite(upper).all():
                return lower + offsets.min(axis=0), upper + offsets.max(axis=0)
        return offsets.min(axis=0) - 1.0, offsets.max(axis=0) + 1.0

    def plane_width(self) -> float:
        """Width with which a level plane is drawn, so that the bodies stay on it [m]."""
        extent = np.abs(self._all)[:, :2]
        first = float(extent.max()) if np.isfinite(extent).all() else 0.0
        return max(2.0 * DRAWN_HALF_WIDTH, PLANE_ROOM * max(first, self._reach))


def _include(box: list[np.ndarray], points: np.ndarray) -> None:
    """Widen a box, its lower and upper corner, by the points (..., 3) that are finite."""
    finite = points[np.isfinite(points).all(axis=-1)]
    box[:] = (
        np.minimum(box[0], finite.min(axis=0, initial=np.inf)),
        np.maximum(box[1], finite.max(axis=0, initial=-np.inf)),
    )


def spread_of(recording: Recording) -> Spread:
    """Extent of an environment over a whole recording."""
    spread = Spread(recording)
    for frame in recording.frames():
        spread.add(frame, recording.rows())
    return spread


def environment_offsets(count: int, spacing) -> np.ndarray:
    """Translations of the environments, (count, 3) [m], centred at the origin in the plane z = 0."""
    columns = count if count <= ROW_LENGTH else math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    column, row = np.arange(count) % columns, np.arange(count) // columns
    x = (column - (columns - 1) / 2.0) * spacing[0]
    y = (row - (rows - 1) / 2.0) * spacing[1]
    return np.stack([x, y, np.zeros(count)], axis=1)


def drawn_surfaces(recording: Recording, count: int, spread: Spread, beyond: float = 0.0) -> list[DrawnSurface]:
    """The surfaces as drawn with `count` environments.

    Planes have the width of the scene, level ones are wider by `beyond` [m] on each side. Level planes may overlap,
    since they coincide; of several environments, a tilted plane is reduced to the extent of its environment.
    """
    surfaces = list(recording.surfaces)
    for index, surface in enumerate(surfaces):
        if surface.endless and len(surface.faces) == 2:
            center = surface.vertices.mean(axis=0)
            width = float(np.linalg.norm(surface.vertices[1] - surface.vertices[0]))
            scale = (spread.plane_width() + 2.0 * beyond) / width
            if count > 1 and is_tilted(recording, index):
                scale = min(1.0, float(np.max(spread.spacing())) / width)
            if scale == 1.0:
                continue
            vertices = (center + scale * (surface.vertices - center)).astype(np.float32)
            surfaces[index] = DrawnSurface(vertices, surface.faces, endless=True)
    return surfaces


def is_tilted(recording: Recording, index: int) -> bool:
    """Whether any body with this plane is tilted."""
    plane = recording.surfaces[index]
    normal = corner_normals(plane.vertices, plane.faces)[0, 0]
    orientation = recording.orientation[0][:, recording.surface == index]
    return bool((np.abs(rotate(orientation, normal)[..., 2]) < 1.0 - 1e-6).any())


def _normalised(vectors: np.ndarray, fallback) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0.0, vectors / np.where(length > 0.0, length, 1.0), fallback)
