"""Paths by which the files of an export refer to images."""

import os
from pathlib import Path

from pxr import Ar, Sdf

from warp_rigid.render.textures import image_bytes, warn_of_image

COPIES = "textures"
"""Folder of the copies in a package."""


class ImagePaths:
    """Names the images in the layers of an export.

    The images stay where they are, and the layers have relative paths to them. Only a package holds copies.

    Args:
        root: the root layer as it is written, possibly in a hidden folder.
        path: the output file, beside which the layers will be in the end.
        is_package: whether it is a package.
    """

    def __init__(self, root: Path, path: Path, is_package: bool):
        """Prepare without writing."""
        self._written, self._final = root.parent, Path(os.path.abspath(path)).parent
        self._is_package = is_package
        self._copies: dict[str, Path | None] = {}

    def asset(self, image: str, layer: Sdf.Layer) -> str | None:
        """The path of an image in a layer; None if a package cannot have it.

        Raises:
            OSError: A copy cannot be written.
        """
        inner = os.path.relpath(os.path.realpath(Path(layer.realPath).parent), os.path.realpath(self._written))
        target, folder = (self._copied(image), self._written) if self._is_package else (Path(image), self._final)
        if target is None:
            return None
        try:
            relative = Path(os.path.relpath(target, folder / inner)).as_posix()
        except ValueError:  # on another drive of Windows
            return target.as_posix()
        return relative if relative.startswith("../") else f"./{relative}"

    def _copied(self, image: str) -> Path | None:
        """Path of the copy of an image; None if it cannot be read."""
        if image not in self._copies:
            try:
                content = image_bytes(image)
            except ValueError as error:
                warn_of_image(image, error)
                content = None
            name = Path(Ar.SplitPackageRelativePathInner(image)[1] or image).name
            copy = self._written / COPIES / f"{len(self._copies)}_{name}"
            if content is not None:
                copy.parent.mkdir(exist_ok=True)
                copy.write_bytes(content)
            self._copies[image] = None if content is None else copy
        return self._copies[image]
