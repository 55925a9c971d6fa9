"""Users' .py files: import, and errors as one line with the file and the line of code."""

import contextlib
import functools
import importlib.util
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from warp_rigid.checks import shown
from warp_rigid.scene.scene import Scene

__all__ = ["errors_of", "module_of_file", "scene_function"]


def module_of_file(path: Path) -> Any:
    """Import a user's .py file as a module.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The code in the file fails.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    spec: Any = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    with errors_of(path):
        spec.loader.exec_module(module)
    return module


def scene_function(path: Path, build: Any) -> Callable[..., Scene]:
    """The function scene() of a file, with checks of its errors and of what it returns.

    Args:
        path: the file.
        build: the attribute `scene` of the module; None if it has none.

    Raises:
        ValueError: The file has no function scene().
    """
    if not callable(build):
        raise ValueError(f"{path}: has no function scene()")

    @functools.wraps(build)
    def checked(*arguments: Any, **parameters: Any) -> Scene:
        with errors_of(path):
            made = build(*arguments, **parameters)
        if not isinstance(made, Scene):
            raise ValueError(f"{path}: scene() must return a Scene, got {shown(made)}")
        return made

    return checked


@contextlib.contextmanager
def errors_of(path: Path) -> Iterator[None]:
    """Convert every error of the code in a file to a ValueError that names the file and the line."""
    try:
        yield
    except SyntaxError as error:
        file = path if _is_same(error.filename, path) else error.filename
        raise ValueError(f"{file}:{error.lineno}: {type(error).__name__}: {error.msg}") from error
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame.lineno for frame in frames if _is_same(frame.filename, path)]
        place = f"{path}:{own[-1]}" if own else str(path)
        kind = "" if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: "
        raise ValueError(f"{place}: {kind}{error}") from error


def _is_same(name: str | None, path: Path) -> bool:
    return name is not None and Path(name).resolve() == path.resolve()
