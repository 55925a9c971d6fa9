"""Images of textures: read from files, also from .usdz packages, and reduced in steps for drawing from afar."""

import io
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
SAMPLED = 64
"""Width and height to which an image is reduced before its colours are averaged [pixel]."""


def image_bytes(path: str) -> bytes | None:
    """Content of an image file, or of a file in a package, "film.usdz[image.png]"; None if it cannot be read."""
    from pxr import Ar

    if not Path(Ar.SplitPackageRelativePathOuter(path)[0]).is_file():
        return None
    opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path))
    if opened is None or opened.GetSize() > LARGEST_FILE:
        return None
    return bytes(opened.GetBuffer())


def read_image(path: str) -> "Image.Image | None":
    """An image as RGB; None if it cannot be read, is too large, or Pillow is not installed."""
    try:
        from PIL import Image
    except ImportError:
        return None
    content = image_bytes(path)
    if content is None:
        return None
    try:
        with Image.open(io.BytesIO(content)) as image:
            return None if image.width * image.height > LARGEST_IMAGE else image.convert("RGB")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None


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


def image_levels(path: str) -> tuple[np.ndarray, ...]:
    """An image and its reductions to half of the width and height, down to one pixel; none if it cannot be read.

    Returns:
        (height, width, 3) uint8 each, sRGB. Means are taken in linear light.
    """
    image = read_image(path)
    if image is None:
        return ()
    if max(image.size) > LARGEST_SIDE:
        image.thumbnail((LARGEST_SIDE, LARGEST_SIDE), image_filter())
    levels = [np.asarray(image, np.uint8)]
    light = linear_light(levels[0].astype(np.float32)).astype(np.float32)
    while max(light.shape[:2]) > 1:
        height, width = (size % 2 if size > 1 else 1 for size in light.shape[:2])
        even = np.pad(light, ((0, height), (0, width), (0, 0)), "edge")
        light = 0.25 * (even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2])
        levels.append(np.round(255.0 * on_screen(light)).astype(np.uint8))
    return tuple(levels)
