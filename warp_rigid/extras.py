"""Optional packages: the extra that installs each, and one line for a package that is missing."""

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

EXTRAS = {
    "PIL": "picture",
    "matplotlib": "picture",
    "imageio_ffmpeg": "picture",
    "viser": "viewer",
    "pygltflib": "gltf",
    "loky": "sweep",
    "pandas": "sweep",
    "pyarrow": "sweep",
    "scipy": "sweep",
    "polars": "tables",
    "xarray": "tables",
    "zarr": "trajectories",
    "distributed": "cluster",
    "optuna": "opt",
}
"""The extra that installs an optional module."""

WRITERS = {
    ".png": ("matplotlib", "PIL"),
    ".gif": ("PIL",),
    ".mp4": ("PIL", "imageio_ffmpeg"),
    ".html": ("viser",),
    ".glb": ("pygltflib",),
}
"""The optional modules that write a file, by its suffix."""


def advice(module: str) -> str:
    """What to do about a module that is not installed."""
    extra = EXTRAS.get(module.partition(".")[0])
    package = f"'warp-rigid[{extra}]'" if extra else "--force-reinstall warp-rigid"
    return f"{module} is not installed; install it with: pip install {package}"


def need(module: str) -> ModuleType:
    """Import an optional module.

    Raises:
        ModuleNotFoundError: It is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(advice(error.name or module), name=error.name) from None


def need_for_file(path: Any) -> None:
    """Check that the optional modules that write a file of this suffix are installed.

    Raises:
        ModuleNotFoundError: See need.
    """
    for module in WRITERS.get(Path(path).suffix, ()):
        need(module)
