"""The image that a mesh file has for its surface."""

import contextlib
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.files.atomic import atomic_file
from warp_rigid.scene.shapes.base import content_hash
from warp_rigid.scene.shapes.distance_grid import cache_folder


def image_path(path: Any, image: Any) -> str | None:
    """Absolute path of an image of a mesh file; an image inside of the file is written to the cache folder.

    Args:
        path: of the mesh file.
        image: path of the image, or an image of Pillow; None without.

    Returns:
        None without an image, with a warning if its file does not exist or cannot be written.
    """
    if image is None:
        return None
    if not isinstance(image, Path):
        pixels = image.convert("RGB")
        image = cache_folder() / "images" / f"{content_hash(np.asarray(pixels))}.png"
        with contextlib.suppress(OSError):
            if not image.is_file():
                with atomic_file(image) as temporary:
                    pixels.save(temporary, "PNG")
    if not image.is_file():
        warnings.warn(f"{path}: image {image} does not exist; bodies are shown in their plain colour", stacklevel=4)
        return None
    return str(image.absolute())
