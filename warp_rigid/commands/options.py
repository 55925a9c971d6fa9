"""Commands with a dataclass of options, whose fields are arguments and options of the command line."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields
from typing import Annotated, Any, TypeVar, get_type_hints

import typer

Options = TypeVar("Options")
Result = TypeVar("Result")

SimulatedScene = Annotated[
    str, typer.Argument(help="Built-in scene, .py file with a function scene(), or USD, MJCF or URDF file.")
]
Envs = Annotated[int | None, typer.Option(help="Number of environments.")]
Device = Annotated[str | None, typer.Option(help="Device, such as cpu or cuda:0.")]
Seed = Annotated[int | None, typer.Option(help="Seed of the random numbers of the scene.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


def takes(options: type[Options]) -> Callable[[Callable[[Options], Result]], Callable[..., Result]]:
    """Return a decorator that makes a function of a dataclass of options a command for Typer.

    Args:
        options: the dataclass; its fields are annotated as parameters of a command.
    """
    hints: dict[str, Any] = get_type_hints(options, include_extras=True)
    parameters = [
        inspect.Parameter(
            entry.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if entry.default is MISSING else entry.default,
            annotation=hints[entry.name],
        )
        for entry in fields(options)  # type: ignore[arg-type]
    ]

    def decorate(function: Callable[[Options], Result]) -> Callable[..., Result]:
        @functools.wraps(function)
        def command(**given: Any) -> Result:
            return function(options(**given))

        command.__dict__["__signature__"] = inspect.Signature(parameters)
        command.__annotations__ = hints
        return command

    return decorate
