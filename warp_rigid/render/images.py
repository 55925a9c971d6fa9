"""Images of a film, rendered without a display: one frame, a contact sheet, an animated GIF or an MP4 video."""

import errno
import itertools
import math

import numpy as np
import warp as wp

from warp_rigid.files.atomic import atomic_file
from warp_rigid.render.appearance import bound_corners
from warp_rigid.render.film import Film
from warp_rigid.render.raycast import Camera, RayCaster
from warp_rigid.rotations import rotate

__all__ = ["fit_camera", "points_to_see", "save_contact_sheet", "save_film", "save_picture"]

TOWARD_EYE = (0.42, -1.0, 0.48)
TOWARD_LIGHT = (-0.2, -0.75, 1.15)
FIELD_OF_VIEW = math.radians(32.0)
"""Vertical field of view of the camera [rad]."""
MARGIN = 1.12
"""Ratio of the field of view to the extent of the visible points."""
CAMERA_FRAMES = 24
"""Number of evenly spaced frames considered by the camera fit."""
MAX_PANELS = 9
"""Maximum number of environments drawn in separate panels; more are drawn together in one view."""
PANEL_ROW = 3
"""Maximum number of panels in a single row; more are arranged in a square."""
GIF_RATE = 20.0
"""Frames per second of a GIF; common viewers slow down higher rates."""
GIF_FRAMES = 200
MP4_RATE = 30.0
"""Maximum frames per second of an MP4 file."""


def save_picture(film: Film, path, frame: int = -1, width: int = 640, height: int = 480) -> None:
    """Render one frame to a .png file, with a panel per environment if there are few.

    Args:
        film: the film.
        path: output file; missing folders are created.
        frame: frame index; -1 is the last.
        width: width of a panel [pixel].
        height: height of a panel [pixel].

    Raises:
        ValueError: The frame does not exist.
        ModuleNotFoundError: Pillow is not installed.
    """
    if not -film.num_frames <= frame < film.num_frames:
        raise ValueError(f"frame: must be from 0 to {film.num_frames - 1}, or -1, got {frame}")
    studio = _Studio(film, [frame], width, height)
    _save(_arranged(studio.draw(frame)), path, format="PNG")


def save_contact_sheet(film: Film, path, count: int = 8) -> None:
    """Render evenly spaced frames, including the first and the last, to one .png file.

    The frames of one environment fill two rows; several environments have one row each.

    Args:
        film: the film.
        path: output file; missing folders are created.
        count: maximum number of frames.

    Raises:
        ModuleNotFoundError: Pillow is not installed.
    """
    studio = _Studio(film, None, 400, 300)
    frames = np.unique(np.linspace(0, film.num_frames - 1, count).round().astype(int))
    rows = [[] for _ in range(studio.num_panels)]
    for frame in frames:
        for row, image in zip(rows, studio.draw(frame), strict=True):
            _write(image, f"{frame / film.fps:.2f} s", (10, 8), "la")
            row.append(image)
    columns = len(frames) if len(rows) > 1 else math.ceil(len(frames) / 2)
    _save(_tiled(sum(rows, []), columns), path, format="PNG")


def save_film(film: Film, path, width: int = 480, height: int = 360) -> None:
    """Render the film in real time to an animated .gif or an .mp4 file.

    Args:
        film: the film.
        path: output file; the suffix selects the format; missing folders are created.
        width: width of a panel [pixel].
        height: height of a panel [pixel].

    Raises:
        ModuleNotFoundError: Pillow, or for .mp4 imageio-ffmpeg, is not installed.
    """
    with atomic_file(path) as temporary:
        (_save_mp4 if str(path).endswith(".mp4") else _save_gif)(film, temporary, width, height)


def _save_gif(film: Film, path, width: int, height: int) -> None:
    from PIL import Image

    stride = max(round(film.fps / GIF_RATE), math.ceil(film.num_frames / GIF_FRAMES), 1)
    images = list(_frames(film, stride, width, height))
    # A common palette without dithering avoids flicker and compresses constant regions.
    strip = Image.fromarray(np.concatenate([np.asarray(i)[::4, ::4] for i in images[::4]]))
    palette = strip.quantize(255)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    duration = round(1000.0 * stride / film.fps)
    images[0].save(path, format="GIF", save_all=True, append_images=images[1:], duration=duration, loop=0)


def _save_mp4(film: Film, path, width: int, height: int) -> None:
    """Encode as H.264 in a widely supported pixel format, which requires even sizes."""
    import imageio_ffmpeg

    stride = max(1, math.ceil(film.fps / MP4_RATE - 1e-6))
    images = _frames(film, stride, 2 * round(width / 2), 2 * round(height / 2))
    first = next(images)
    writer = imageio_ffmpeg.write_frames(
        str(path), first.size, fps=film.fps / stride, codec="libx264", quality=7, macro_block_size=2
    )
    writer.send(None)
    for image in itertools.chain([first], images):
        writer.send(np.ascontiguousarray(image))
    writer.close()
    # The writer does not report write errors of ffmpeg.
    try:
        written, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except RuntimeError:
        written = 0
    wanted = len(range(0, film.num_frames, stride))
    if written != wanted:
        raise OSError(errno.EIO, f"only {written} of {wanted} frames could be written; is the disk full?")


def _frames(film: Film, stride: int, width: int, height: int):
    """Every `stride`-th frame of a film, as Pillow images."""
    studio = _Studio(film, None, width, height)
    for frame in range(0, film.num_frames, stride):
        yield _arranged(studio.draw(frame))


class _Studio:
    """Renders the panels of a film, one per environment, with a common camera.

    Args:
        film: the film.
        frames: indices of the frames that the camera fit considers; None uses the whole film.
        width: width of a panel [pixel].
        height: height of a panel [pixel].
    """

    def __init__(self, film: Film, frames, width: int, height: int):
        several = 1 < len(film.labels) <= MAX_PANELS
        films = [film.alone(env) for env in range(len(film.labels))] if several else [film]
        if frames is None:
            frames = np.unique(np.linspace(0, film.num_frames - 1, CAMERA_FRAMES).astype(int))
        points = np.concatenate([points_to_see(panel, frames) for panel in films])
        camera = fit_camera(points, width / height, height)
        self._casters = [RayCaster(panel, camera) for panel in films]
        self._labels = film.labels if several else ("",)
        self._size = width, height

    @property
    def num_panels(self) -> int:
        return len(self._casters)

    def draw(self, frame: int) -> list:
        """Render the labelled panels of a frame as Pillow images."""
        from PIL import Image

        width, height = self._size
        images = []
        for caster, label in zip(self._casters, self._labels, strict=True):
            images.append(Image.fromarray(caster.draw(frame, width, height)))
            _write(images[-1], label, (width / 2, height - 10), "ms")
        return images


def fit_camera(points: np.ndarray, aspect: float, height: int) -> Camera:
    """The closest camera that has all points in view.

    Args:
        points: (n, 3) [m].
        aspect: width of the image over its height.
        height: height of the image [pixel].
    """
    back = _unit(TOWARD_EYE)
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
    camera.eye, camera.forward = wp.vec3(*eye), wp.vec3(*-back)
    camera.right, camera.up = wp.vec3(*(wide * right)), wp.vec3(*(tall * up))
    camera.light = wp.vec3(*_unit(TOWARD_LIGHT))
    reach = distance - float(np.median(along))
    camera.grid = _round_length(reach / 12.0)
    camera.haze = 1.5 * reach
    camera.pixel = 2.0 * tall / height
    return camera


def _middle(side: np.ndarray, along: np.ndarray, slope: float) -> tuple[float, float]:
    """Position of the eye, sideways and backward, from which all |side| <= slope * depth."""
    highest, lowest = np.max(side + slope * along), np.max(-side + slope * along)
    return float(highest - lowest) / 2.0, float(highest + lowest) / 2.0 / slope


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
    points = points[away <= 2.5 * np.percentile(away, 75.0) + 1e-9]
    size = np.linalg.norm(np.ptp(points.reshape(-1, 3), axis=0))

    still = placed(~moving & ~flat, frames[0])
    small = np.linalg.norm(np.ptp(still, axis=1), axis=1) < 2.5 * size
    return np.concatenate([points.reshape(-1, 3), still[small].reshape(-1, 3)])


def _write(image, text: str, place: tuple[float, float], anchor: str) -> None:
    """Draw dark text with a light outline on an image, in place."""
    from PIL import ImageDraw, ImageFont

    font = ImageFont.load_default(size=max(12, image.height // 26))
    pen = ImageDraw.Draw(image)
    pen.text(place, text, fill="#20242a", font=font, anchor=anchor, stroke_width=2, stroke_fill="#f4f4f2")


def _arranged(panels: list):
    """Combine the panels of a frame to one image."""
    count = len(panels)
    return _tiled(panels, count if count <= PANEL_ROW else math.ceil(math.sqrt(count)))


def _tiled(images: list, columns: int):
    """Tile images of equal size, row by row."""
    from PIL import Image

    columns = min(columns, len(images))
    width, height = images[0].size
    rows = math.ceil(len(images) / columns)
    whole = Image.new("RGB", (width * columns, height * rows), "white")
    for index, image in enumerate(images):
        whole.paste(image, (width * (index % columns), height * (index // columns)))
    return whole


def _save(image, path, **options) -> None:
    with atomic_file(path) as temporary:
        image.save(temporary, **options)


def _round_length(length: float) -> float:
    """Round down to a length of the series 1, 2, 5, 10, 20, ..."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(step for step in (1.0, 2.0, 5.0) if step <= length / power * (1.0 + 1e-9))


def _unit(vector) -> np.ndarray:
    vector = np.asarray(vector, dtype=np.float64)
    return vector / np.linalg.norm(vector)
