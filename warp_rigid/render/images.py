"""Images of a film, rendered without a display: one frame, a contact sheet, an animated GIF or an MP4 video."""

import errno
import itertools
import math
from collections.abc import Callable

import numpy as np

from warp_rigid.files.atomic import atomic_file
from warp_rigid.render.film import Film
from warp_rigid.render.framing import CameraPath, event_end
from warp_rigid.render.raycast import RayCaster

Progress = Callable[[int, int], object] | None

PICTURE_SIZE = (1280, 720)
"""Default width and height of pictures and MP4 films, all panels together [pixel]."""
GIF_SIZE = (640, 360)
SMALLEST_PANEL = 320
"""Least default width of a panel [pixel], so that bodies and labels of comparisons are recognizable."""
SHEET_SIZE = (480, 270)
"""Width and height of a picture in a contact sheet [pixel]."""

MAX_PANELS = 9
"""Maximum number of environments drawn in separate panels; more are drawn together in one view."""
PANEL_ROW = 3
"""Maximum number of panels in a single row; more are arranged in a square."""
GIF_RATE = 20.0
"""Frames per second of a GIF; common viewers slow down higher rates."""
GIF_FRAMES = 200
COLORFUL = 40
"""Difference between the largest and the smallest channel from which on a pixel counts as saturated, of 255."""
MP4_RATE = 30.0
"""Maximum frames per second of an MP4 file."""


def save_picture(film: Film, path, frame: int = -1, width: int | None = None, height: int | None = None) -> None:
    """Render one frame to a .png file, with a panel per environment if there are few.

    Args:
        film: the film.
        path: output file; missing folders are created.
        frame: frame index; -1 is the last.
        width: width of a panel [pixel]; None for 1280 pixels in all.
        height: height of a panel [pixel]; None for 9/16 of its width.

    Raises:
        ValueError: The frame does not exist.
        ModuleNotFoundError: Pillow is not installed.
    """
    width, height = _panel_size(film, PICTURE_SIZE, width, height)
    if not -film.num_frames <= frame < film.num_frames:
        raise ValueError(f"frame: must be from 0 to {film.num_frames - 1}, or -1, got {frame}")
    frame %= film.num_frames
    studio = _Studio(film, [frame], width, height)
    _save_png(_tiled(studio.draw(frame)), path)


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
    last = event_end(film)
    studio = _Studio(film, range(last + 1), *SHEET_SIZE)
    frames = np.unique(np.linspace(0, last, count).round().astype(int))
    drawn = [studio.draw(frame) for frame in frames]
    for frame, panels in zip(frames, drawn, strict=True):
        for image in panels:
            _write(image, f"{frame / film.fps:.2f} s", (10, 8), "la")
    columns = len(frames) if len(drawn[0]) > 1 else math.ceil(len(frames) / 2)
    _save_png(_tiled([image for row in zip(*drawn, strict=True) for image in row], columns), path)


def save_film(film: Film, path, width: int | None = None, height: int | None = None, on_frame: Progress = None) -> None:
    """Render the film in real time to an animated .gif or an .mp4 file. It ends soon after the bodies are at rest.

    Args:
        film: the film.
        path: output file; the suffix selects the format; missing folders are created.
        width: width of a panel [pixel]; None for 1280 pixels in all, or 640 for .gif, and at least 320.
        height: height of a panel [pixel]; None for 9/16 of its width.
        on_frame: called with the number of frames drawn and their total, after each.

    Raises:
        ModuleNotFoundError: Pillow, or for .mp4 imageio-ffmpeg, is not installed.
    """
    save, size = (_save_mp4, PICTURE_SIZE) if str(path).endswith(".mp4") else (_save_gif, GIF_SIZE)
    with atomic_file(path) as temporary:
        save(film, temporary, *_panel_size(film, size, width, height), on_frame)


def _save_gif(film: Film, path, width: int, height: int, on_frame: Progress) -> None:
    from PIL import Image

    stride = max(round(film.fps / GIF_RATE), math.ceil((event_end(film) + 1) / GIF_FRAMES), 1)
    images = list(_frames(film, stride, width, height, on_frame))
    # A common palette without dithering avoids flicker and compresses constant regions.
    palette = shared_palette(images[::4], 255)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    duration = round(1000.0 * stride / film.fps)
    images[0].save(path, format="GIF", save_all=True, append_images=images[1:], duration=duration, loop=0)


def shared_palette(images: list, colors: int):
    """A palette for some Pillow images, as an image of Pillow's.

    Half of it is for the saturated pixels, which are few: grounds and skies would take nearly all of it.
    """
    from PIL import Image

    pixels = np.concatenate([np.asarray(image)[::2, ::2].reshape(-1, 3) for image in images])
    colorful = np.ptp(pixels.astype(int), axis=1) > COLORFUL
    palettes = []
    for chosen, count in ((pixels[~colorful], colors - colors // 2), (pixels[colorful], colors // 2)):
        if len(chosen):
            strip = Image.fromarray(chosen[None]).quantize(count, Image.Quantize.MEDIANCUT)
            palettes += (strip.getpalette() or [])[: 3 * count]
    made = Image.new("P", (1, 1))
    made.putpalette(palettes)
    return made


def _save_mp4(film: Film, path, width: int, height: int, on_frame: Progress) -> None:
    """Encode as H.264 in a widely supported pixel format, which requires even sizes."""
    import imageio_ffmpeg

    stride = max(1, math.ceil(film.fps / MP4_RATE - 1e-6))
    images = _frames(film, stride, 2 * round(width / 2), 2 * round(height / 2), on_frame)
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
    wanted = len(range(0, event_end(film) + 1, stride))
    if written != wanted:
        raise OSError(errno.EIO, f"only {written} of {wanted} frames could be written; is the disk full?")


def _frames(film: Film, stride: int, width: int, height: int, on_frame: Progress):
    """Every `stride`-th frame of a film until its event is over, as Pillow images."""
    frames = range(0, event_end(film) + 1, stride)
    studio = _Studio(film, frames, width, height)
    for done, frame in enumerate(frames, start=1):
        yield _tiled(studio.draw(frame))
        if on_frame is not None:
            on_frame(done, len(frames))


class _Studio:
    """Renders the panels of a film, one per environment, with a common camera.

    Args:
        film: the film.
        frames: indices of the frames that will be drawn.
        width: width of a panel [pixel].
        height: height of a panel [pixel].
    """

    def __init__(self, film: Film, frames, width: int, height: int):
        several = _num_panels(film) > 1
        films = [film.alone(env) for env in range(len(film.labels))] if several else [film]
        self._path = CameraPath(films, frames, width, height)
        self._casters = [RayCaster(panel, self._path.mean) for panel in films]
        self._labels = film.labels if several else ("",)
        self._size = width, height

    def draw(self, frame: int) -> list:
        """Render the labelled panels of a frame as Pillow images."""
        from PIL import Image

        width, height = self._size
        images = []
        for panel, (caster, label) in enumerate(zip(self._casters, self._labels, strict=True)):
            images.append(Image.fromarray(caster.draw(frame, width, height, self._path.at(frame, panel))))
            _write(images[-1], label, (width / 2, height - 10), "ms")
        return images


def _write(image, text: str, place: tuple[float, float], anchor: str) -> None:
    """Draw dark text with a light outline on an image, in place."""
    from PIL import ImageDraw, ImageFont

    font = ImageFont.load_default(size=max(12, image.height // 26))
    pen = ImageDraw.Draw(image)
    pen.text(place, text, fill="#20242a", font=font, anchor=anchor, stroke_width=2, stroke_fill="#f4f4f2")


def _num_panels(film: Film) -> int:
    """Number of panels of a frame: one per environment if there are few, else one for all."""
    return len(film.labels) if len(film.labels) <= MAX_PANELS else 1


def _columns(panels: int) -> int:
    """Number of panels side by side."""
    return panels if panels <= PANEL_ROW else math.ceil(math.sqrt(panels))


def _panel_size(film: Film, whole: tuple[int, int], width: int | None, height: int | None) -> tuple[int, int]:
    """Width and height of a panel, by default such that all panels together are as wide as `whole`, or wider."""
    width = width or max(SMALLEST_PANEL, whole[0] // _columns(max(1, _num_panels(film))))
    return width, height or round(width * whole[1] / whole[0])


def _tiled(images: list, columns: int | None = None):
    """Tile images of equal size, row by row; without a number of columns as the panels of a frame."""
    from PIL import Image

    columns = min(columns or _columns(len(images)), len(images))
    width, height = images[0].size
    rows = math.ceil(len(images) / columns)
    whole = Image.new("RGB", (width * columns, height * rows), "white")
    for index, image in enumerate(images):
        whole.paste(image, (width * (index % columns), height * (index // columns)))
    return whole


def _save_png(image, path) -> None:
    with atomic_file(path) as temporary:
        image.save(temporary, format="PNG")
