"""Images of textures: read from files, also from .usdz packages, and reduced in steps for drawing from afar."""

import io
import warnings
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_rigid.render.appearance import linear_light, on_screen

if TYPE_CHECKING:
    from PIL import Image

LARGEST_FILE, LARGEST_IMAGE = 2**26, 2**26
"""Largest size of an image that is read [bytes], and number of its pixels."""
LARGEST_SIDE = 2048
"""Width and height to which larger images are reduced for drawing [pixel]."""
MEDIA_TYPES = {"PNG": "image/png", "JPEG": "image/jpeg"}
"""Formats that glTF files may have."""
JPEG_QUALITY = 92
ORIENTATION = 0x0112
"""EXIF tag of a turn, which only some readers apply; 1 is none."""
SAMPLED = 64
"""Width and height to which an image is reduced before its colours are averaged [pixel]."""


def image_bytes(path: str) -> bytes:
    """Content of an image file, or of a file in a package, "film.usdz[image.png]".

    Raises:
        ValueError: It cannot be read; the message states why, without the path.
    """
    from pxr import Ar

    if not Path(Ar.SplitPackageRelativePathOuter(path)[0]).is_file():
        raise ValueError("no such file")
    opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path))
    if opened is None:
        raise ValueError("cannot be opened")
    if opened.GetSize() > LARGEST_FILE:
        raise ValueError(f"larger than {LARGEST_FILE >> 20} MiB")
    return bytes(opened.GetBuffer())


def open_image(path: str) -> tuple["Image.Image", str, bytes | None]:
    """An image as RGB, its format, such as "PNG", and the content of its file if browsers show it alike, else None.

    Raises:
        ValueError: It cannot be read; the message states why, without the path.
    """
    content = image_bytes(path)
    try:
        from PIL import Image
    except ImportError:
        raise ValueError("Pillow is not installed: pip install 'warp-rigid[picture]'") from None
    try:
        with Image.open(io.BytesIO(content)) as image:
            if image.width * image.height > LARGEST_IMAGE:
                raise ValueError(f"more than {LARGEST_IMAGE >> 20} million pixels")
            known = image.format in MEDIA_TYPES and image.mode in ("RGB", "RGBA", "L", "P")
            alike = known and image.getexif().get(ORIENTATION, 1) == 1
            return image.convert("RGB"), str(image.format), content if alike else None
    except Image.UnidentifiedImageError:
        raise ValueError("no image of a known format") from None
    except Image.DecompressionBombError:
        raise ValueError(f"more than {LARGEST_IMAGE >> 20} million pixels") from None
    except (OSError, SyntaxError) as error:
        raise ValueError(f"cannot be decoded: {error}") from None


def read_image(path: str, side: int = LARGEST_IMAGE) -> "Image.Image | None":
    """An image as RGB, reduced to `side` pixels in width and height; None, with a warning, if it cannot be read."""
    try:
        image = open_image(path)[0]
    except ValueError as error:
        warn_of_image(path, error)
        return None
    image.thumbnail((side, side), image_filter())
    return image


def embedded_image(path: str) -> tuple[bytes, str] | None:
    """Content of an image and its media type, image/png or image/jpeg; None, with a warning, if it cannot be read.

    A file of another format, or of more than LARGEST_SIDE pixels a side, is converted.
    """
    try:
        image, kind, content = open_image(path)
    except ValueError as error:
        warn_of_image(path, error)
        return None
    kind = kind if kind in MEDIA_TYPES else "PNG"
    if content is None or max(image.size) > LARGEST_SIDE:
        image.thumbnail((LARGEST_SIDE, LARGEST_SIDE), image_filter())
        written = io.BytesIO()
        image.save(written, kind, quality=JPEG_QUALITY)
        content = written.getvalue()
    return content, MEDIA_TYPES[kind]


def warn_of_image(path: str, reason: ValueError) -> None:
    """Warn that an image is not shown, once for each path."""
    if path not in _warned:
        _warned.add(path)
        warnings.warn(f"{path}: {reason}; bodies with this image are shown in their plain colour", stacklevel=3)


_warned: set[str] = set()


def mean_color(path: str) -> tuple[float, float, float] | None:
    """Mean colour of an image in linear light; None if it cannot be read."""
    image = read_image(path)
    if image is None:
        return None
    small = np.asarray(image.resize((SAMPLED, SAMPLED), image_filter()), np.float64)
    r, g, b = np.clip(linear_light(small).reshape(-1, 3).mean(axis=0), 0.0, 1.0).tolist()
    return r, g, b


def image_filter():
    """The filter of Pillow that takes means."""
    from PIL import Image

    return Image.Resampling.BOX


@lru_cache(maxsize=16)
def image_levels(path: str, _modified: int) -> tuple[np.ndarray, ...]:
    """An image and its reductions to half of the width and height, down to one pixel; none if it cannot be read.

    It is read once for each time of its last change, for the panels of a picture.

    Returns:
        (height, width, 3) uint8 each, sRGB. Means are taken in linear light.
    """
    image = read_image(path, LARGEST_SIDE)
    if image is None:
        return ()
    levels = [np.asarray(image, np.uint8)]
    light = linear_light(levels[0].astype(np.float32)).astype(np.float32)
    while max(light.shape[:2]) > 1:
        height, width = (size % 2 if size > 1 else 1 for size in light.shape[:2])
        even = np.pad(light, ((0, height), (0, width), (0, 0)), "edge")
        light = 0.25 * (even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2])
        levels.append(np.round(255.0 * on_screen(light)).astype(np.uint8))
    return tuple(levels)
