"""Code of users, in .py files or passed as functions: import, and errors as one line with the file and the line."""

import contextlib
import functools
import importlib.machinery
import importlib.util
import inspect
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.checks import shown
from warp_rigid.errors import CapacityError, NonFiniteError
from warp_rigid.scene.scene import Scene


class UserCodeError(ValueError):
    """An error of a user's code: one line with the file and the line of code.

    Attributes:
        kept: what was computed before the error; None if nothing was.
    """

    kept: Any = None


class _Uncached(importlib.machinery.SourceFileLoader):
    """Compiles a file each time: bytecode beside it is stale where the file changes within a second."""

    def get_code(self, fullname: str) -> Any:
        return self.source_to_code(self.get_data(self.path), self.path)


def module_of_file(path: Path) -> Any:
    """Import a user's .py file as a module.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The code in the file fails.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    spec: Any = importlib.util.spec_from_file_location(path.stem, path, loader=_Uncached(path.stem, str(path)))
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
        with errors_of(build):
            made = build(*arguments, **parameters)
            if not isinstance(made, Scene):
                raise ValueError(f"scene() must return a Scene, got {shown(made)}")
        given = inspect.signature(build).bind(*arguments, **parameters)
        given.apply_defaults()
        made = made.copy()  # a function may return the same scene each time
        made.parameters = dict(given.arguments)
        return made

    return checked


def with_parameters(path: Path, function: Callable, *arguments: str) -> Callable:
    """A function of a file that takes the parameters of the scene after its other arguments, whether it does or not.

    Args:
        path: the file.
        function: the function.
        arguments: names of its other arguments, for the error message.

    Raises:
        ValueError: It can be called neither with these arguments nor with these and the parameters, or has them in
            another order.
    """
    signature = inspect.signature(function)
    count = len(arguments)
    name, given = getattr(function, "__name__", "function"), ", ".join(arguments)
    form = f"{name}({given}) or {name}({given}, parameters)"
    for expected in (arguments, (*arguments, "parameters")):
        found = tuple(signature.parameters)[: len(expected)]
        if found != expected and sorted(found) == sorted(expected):
            raise ValueError(f"{path}: must define {form}, got {name}{signature}")
    short, long = (_accepts(signature, (None,) * number, {}) for number in (count, count + 1))
    if long and (not short or list(signature.parameters)[count : count + 1] == ["parameters"]):
        return function
    check_call(path, form, function, *(None,) * count)

    @functools.wraps(function)
    def without(*given: Any) -> Any:
        return function(*given[:-1])

    return without


def check_call(path: Path, form: str, function: Callable, *arguments: Any, **named: Any) -> None:
    """Check that a function or class of a file can be called with some arguments; `form` shows how it is called.

    Raises:
        ValueError: Its signature is another one.
    """
    signature = inspect.signature(function)
    if not _accepts(signature, arguments, named):
        raise ValueError(f"{path}: must define {form}, got {form.partition('(')[0]}{signature}")


def _accepts(signature: inspect.Signature, arguments: tuple, named: dict[str, Any]) -> bool:
    try:
        signature.bind(*arguments, **named)
    except TypeError:
        return False
    return True


def check_columns(
    name: str, given: Any, is_known: Callable[[str], bool], expected: Callable[[Any], str], classes: bool = False
) -> tuple[str | Callable, ...]:
    """Check what a table of a sweep has columns of, and resolve files to their public functions.

    Args:
        name: of the argument, for messages.
        given: known names, functions, and paths of .py files, one or a list of them.
        is_known: whether a text is a known name.
        expected: what is allowed instead of an entry, as text.
        classes: whether classes are allowed as functions are.

    Raises:
        ValueError: An entry is unknown, or two have the same name.
        FileNotFoundError: A file does not exist.
    """
    found: list[str | Callable] = []
    for entry in given if isinstance(given, list | tuple) else [given]:
        if isinstance(entry, str) and entry.endswith(".py"):
            found += _public_functions(name, Path(entry), classes)
        elif callable(entry) or (isinstance(entry, str) and is_known(entry)):
            found.append(entry)
        else:
            raise ValueError(f"{name}: must be {expected(entry)}")
    names = [column_name(entry) for entry in found]
    if len(set(names)) < len(names):
        raise ValueError(f"{name}: {max(names, key=names.count)} is given twice")
    return tuple(found)


def column_name(entry: str | Callable) -> str:
    """Name of the column of a known name, a function or a class."""
    return entry if isinstance(entry, str) else getattr(entry, "__name__", type(entry).__name__)


def _public_functions(name: str, path: Path, classes: bool) -> list[Callable]:
    """The public functions, and classes, defined in a .py file."""
    module = module_of_file(path)
    found: list[Callable] = [
        value
        for key, value in vars(module).items()
        if (inspect.isfunction(value) or (classes and inspect.isclass(value)))
        and value.__module__ == module.__name__
        and not key.startswith("_")
    ]
    if not found:
        raise ValueError(f"{name}: {path} must define at least one public function{' or class' if classes else ''}")
    return found


@contextlib.contextmanager
def errors_of(code: Path | Callable) -> Iterator[None]:
    """Convert the errors of a user's code to a UserCodeError.

    Exhausted memory and a simulation that fails are no errors of the code.

    Args:
        code: a .py file, or a function, class or callable object.
    """
    try:
        yield
    except (UserCodeError, CapacityError, NonFiniteError, MemoryError):
        raise
    except SyntaxError as error:
        own = isinstance(code, Path) and _is_same(error.filename, code)
        file = code if own else error.filename
        raise UserCodeError(f"{file}:{error.lineno}: {type(error).__name__}: {error.msg}") from error
    except Exception as error:
        kind = "" if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: "
        text = " ".join(f"{kind}{error}".split())
        raise UserCodeError(f"{_place(error, code)}{text}") from error


def _place(error: Exception, code: Path | Callable) -> str:
    """File and line of the last call of the code before the error, or where the code begins; "" if unknown."""
    file, first = (code, None) if isinstance(code, Path) else _source(code)
    if file is None:
        return ""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if _is_same(frame.filename, file)]
    line = lines[-1] if lines else first
    return f"{file}: " if line is None else f"{file}:{line}: "


def _source(code: Any) -> tuple[Path | None, int | None]:
    """File and first line of a function, of the function in a functools.partial, or of the class of an object."""
    while isinstance(code, functools.partial):
        code = code.func
    known = inspect.unwrap(code) if inspect.isroutine(code) or inspect.isclass(code) else type(code)
    try:
        file = inspect.getsourcefile(known)
        return (None, None) if file is None else (_short(Path(file)), inspect.getsourcelines(known)[1])
    except (OSError, TypeError):
        return None, None


def _short(path: Path) -> Path:
    """The path relative to the current folder if it is inside."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def _is_same(name: str | None, path: Path) -> bool:
    return name is not None and Path(name).resolve() == path.resolve()


class Failures:
    """The environments of a batch in which the user's code failed.

    Args:
        num_envs: number of environments.

    Attributes:
        reasons: for each environment the first error as one line; None without an error.
        void: (envs,) bool, whether the error invalidates the simulation itself, and so all its values.
    """

    def __init__(self, num_envs: int) -> None:
        """Start without errors."""
        self.reasons: list[str | None] = [None] * num_envs
        self.void = np.zeros(num_envs, bool)

    @contextlib.contextmanager
    def of(self, code: Callable, what: str, envs: Any = slice(None), void: bool = False) -> Iterator[None]:
        """Store an error of the user's code in the block, which then ends.

        Args:
            code: the user's function, class or object.
            what: its name for the message, such as "metric slope".
            envs: the environments concerned.
            void: whether an error invalidates all their values.
        """
        try:
            with errors_of(code):
                yield
        except UserCodeError as error:
            for env in np.arange(len(self.reasons))[envs]:
                self.reasons[env] = self.reasons[env] or f"{what}: {error}"
            self.void[envs] |= void
