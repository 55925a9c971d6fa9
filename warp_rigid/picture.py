"""Pictures of a film: one frame, a contact sheet, or an animated GIF, made without a screen."""

import math
from pathlib import Path

import numpy as np
import warp as wp

from warp_rigid.appearance import bound_corners, rotate
from warp_rigid.film import Film
from warp_rigid.raycast import Camera, RayCaster

__all__ = ["fit_camera", "save_contact_sheet", "save_gif", "save_picture"]

TOWARD_EYE = (0.42, -1.0, 0.48)
TOWARD_LIGHT = (-0.45, -0.55, 1.0)
FIELD_OF_VIEW = math.radians(32.0)
"""Upright opening angle of the camera."""
MARGIN = 1.12
"""How much wider the view is than what must be seen."""
CAMERA_FRAMES = 24
"""So many frames of a film, evenly spread, decide what must be seen."""
GIF_RATE = 20.0
"""Frames per second of a GIF; common viewers slow down faster ones."""
GIF_FRAMES = 200


def save_picture(film: Film, path, frame: int = -1, width: int = 640, height: int = 480) -> None:
    """Draw one frame into a .png file.

    Args:
        film: what to draw.
        path: the file; folders are made.
        frame: its number; -1 is the last.
        width: of the picture [pixel].
        height: of the picture [pixel].

    Raises:
        ValueError: There is no such frame.
        ModuleNotFoundError: Pillow is not installed.
    """
    if not -film.num_frames <= frame < film.num_frames:
        raise ValueError(f"frame: must be from 0 to {film.num_frames - 1}, or -1, got {frame}")
    camera = fit_camera(film, [frame], width / height, height)
    image = _image(RayCaster(film), film, frame, camera, width, height)
    _prepare(path)
    image.save(path, format="PNG")


def save_contact_sheet(film: Film, path, count: int = 8, columns: int = 4) -> None:
    """Draw frames evenly spread over the film, the first and last included, into one .png file.

    Args:
        film: what to draw.
        path: the file; folders are made.
        count: how many frames; fewer where the film has fewer.
        columns: how many of them side by side.

    Raises:
        ModuleNotFoundError: Pillow is not installed.
    """
    from PIL import Image

    width, height = 400, 300
    frames = np.unique(np.linspace(0, film.num_frames - 1, count).round().astype(int))
    caster, camera = RayCaster(film), fit_camera(film, None, width / height, height)
    rows = math.ceil(len(frames) / columns)
    sheet = Image.new("RGB", (width * min(columns, len(frames)), height * rows), "white")
    for index, frame in enumerate(frames):
        image = _image(caster, film, frame, camera, width, height)
        _write(image, f"{frame / film.fps:.2f} s", (10, 8), "la")
        sheet.paste(image, (width * (index % columns), height * (index // columns)))
    _prepare(path)
    sheet.save(path, format="PNG")


def save_gif(film: Film, path, width: int = 480, height: int = 360) -> None:
    """Draw the film, at its own speed, into an animated .gif file.

    Args:
        film: what to draw.
        path: the file; folders are made.
        width: of the picture [pixel].
        height: of the picture [pixel].

    Raises:
        ModuleNotFoundError: Pillow is not installed.
    """
    from PIL import Image

    stride = max(round(film.fps / GIF_RATE), math.ceil(film.num_frames / GIF_FRAMES), 1)
    caster, camera = RayCaster(film), fit_camera(film, None, width / height, height)
    images = [
        _image(caster, film, frame, camera, width, height)
        for frame in range(0, film.num_frames, stride)
    ]
    # One palette for all frames, without dithering: nothing flickers, and still places cost nothing.
    strip = Image.fromarray(np.concatenate([np.asarray(i)[::4, ::4] for i in images[::4]]))
    palette = strip.quantize(255)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    _prepare(path)
    images[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=images[1:],
        duration=round(1000.0 * stride / film.fps),
        loop=0,
    )


def fit_camera(film: Film, frames, aspect: float, height: int) -> Camera:
    """A view that just holds the moving bodies and the fixed ones of their size around them.

    Args:
        film: what to look at.
        frames: numbers of the frames in which things must be seen; None takes the whole film.
        aspect: width of the picture over its height.
        height: of the picture [pixel].
    """
    if frames is None:
        frames = np.unique(np.linspace(0, film.num_frames - 1, CAMERA_FRAMES).astype(int))
    points = _points_to_see(film, frames)
    back = _unit(TOWARD_EYE)
    right = _unit(np.cross(-back, (0.0, 0.0, 1.0)))
    up = np.cross(back, right)
    tall = math.tan(FIELD_OF_VIEW / 2.0)
    wide = tall * aspect

    # Each point asks for a place of the eye from which it lies just inside the view's borders;
    # moving the eye sideways to the middle of the demands brings it nearest.
    along, across, above = points @ back, points @ right, points @ up
    center_across, distance_across = _middle(across, along, wide / MARGIN)
    center_above, distance_above = _middle(above, along, tall / MARGIN)
    distance = max(distance_across, distance_above)
    eye = center_across * right + center_above * up + distance * back

    camera = Camera()
    camera.eye, camera.forward = wp.vec3(*eye), wp.vec3(*-back)
    camera.right, camera.up = wp.vec3(*(wide * right)), wp.vec3(*(tall * up))
    camera.light = wp.vec3(*_unit(TOWARD_LIGHT))
    reach = distance - float(np.median(along))
    camera.grid = _round_length(reach / 12.0)
    camera.haze = 1.5 * reach
    camera.pixel = 2.0 * tall / height
    return camera


def _middle(side: np.ndarray, along: np.ndarray, slope: float) -> tuple[float, float]:
    """Place of the eye sideways and along the view from which |side| <= slope * depth everywhere."""
    highest, lowest = np.max(side + slope * along), np.max(-side + slope * along)
    return float(highest - lowest) / 2.0, float(highest + lowest) / 2.0 / slope


def _points_to_see(film: Film, frames) -> np.ndarray:
    """Corners of the boxes around what must be seen, (points, 3)."""
    corners = np.stack([bound_corners(mesh.vertices) for mesh in film.meshes])[film.mesh]
    flat = np.array([mesh.flat for mesh in film.meshes])[film.mesh]
    moving = film.moving & ~flat
    if not moving.any():
        moving = ~flat if not flat.all() else np.ones_like(flat)

    def placed(chosen, frame):
        turned = rotate(film.orientation[frame][chosen, None], corners[chosen])
        return turned + film.position[frame][chosen, None]

    points = np.concatenate([placed(moving, frame) for frame in frames])
    # The few that fly off must not make the rest small.
    middle = np.median(points.reshape(-1, 3), axis=0)
    away = np.linalg.norm(points.mean(axis=1) - middle, axis=1)
    points = points[away <= 3.0 * np.percentile(away, 80.0) + 1e-9]
    size = np.linalg.norm(np.ptp(points.reshape(-1, 3), axis=0))

    still = placed(~moving & ~flat, frames[0])
    small = np.linalg.norm(np.ptp(still, axis=1), axis=1) < 2.5 * size
    return np.concatenate([points.reshape(-1, 3), still[small].reshape(-1, 3)])


def _image(caster: RayCaster, film: Film, frame: int, camera: Camera, width: int, height: int):
    """One frame with the environments' labels, as a Pillow image."""
    from PIL import Image

    image = Image.fromarray(caster.draw(frame, camera, width, height))
    for text, place in film.labels:
        offset = np.asarray(place) - np.asarray(camera.eye)
        depth = offset @ np.asarray(camera.forward)
        right = np.asarray(camera.right)
        across = offset @ right / (right @ right) / depth
        _write(image, text, ((0.5 + 0.5 * across) * width, height - 10), "ms")
    return image


def _write(image, text: str, place: tuple[float, float], anchor: str) -> None:
    """Write dark text with a light rim on a picture."""
    from PIL import ImageDraw, ImageFont

    font = ImageFont.load_default(size=max(12, image.height // 26))
    pen = ImageDraw.Draw(image)
    pen.text(
        place, text, fill="#20242a", font=font, anchor=anchor, stroke_width=2, stroke_fill="#f4f4f2"
    )


def _prepare(path) -> None:
    Path(path).parent.mkdir(parents=True, exist_ok=True)


def _round_length(length: float) -> float:
    """The nearest length below of the row 1, 2, 5, 10, 20, ..."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(step for step in (1.0, 2.0, 5.0) if step <= length / power * (1.0 + 1e-9))


def _unit(vector) -> np.ndarray:
    vector = np.asarray(vector, dtype=np.float64)
    return vector / np.linalg.norm(vector)
