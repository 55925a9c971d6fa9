"""Scenes of users: a .py file that describes a scene as the built-in ones are.

Besides the function `scene(**parameters)` the file may define

- `events(sim, frame)` or `events(sim, frame, parameters)`: called before each frame of 1/60 s, to push, spawn or change
  something; `parameters` has those of `scene` by name;
- `outcome(sim)` or `outcome(sim, parameters)`: called at the end, returns by name the measured values, (envs,), in SI
  units. With a unit to show them in, it is a tuple (values, "mm"). Booleans are a verdict, also (values, booleans) and
  (values, booleans, "mm"). Or a class as the built-in scenes have, made with the scene, with `observe` and `verdicts`;
- `VARIANTS`: settings to compare, by name; "default", which changes nothing, is always the first;
- `vary(sim, **parameters)`: gives each environment of a batch a different start;
- `SETTINGS`: differences from `Settings()` that the scene needs;
- `DURATION`: duration of a run [s].
"""

import inspect
import math
from collections.abc import Callable
from dataclasses import fields
from functools import partial, wraps
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from warp_rigid.checks import number_in, shown, suggestion
from warp_rigid.engine.settings import PER_ENVIRONMENT, Settings
from warp_rigid.runs.user_code import check_call, errors_of, module_of_file, scene_function, with_parameters
from warp_rigid.scene.scene import Scene
from warp_rigid.scenes import Demo, Verdict
from warp_rigid.scenes.demo import no_events

FILE_SCENE_DURATION = 4.0
"""Default duration of a scene from a user's file [s]."""

EVENT_RATE = 60.0
"""Calls of `events` per simulated second."""


class NoOutcome:
    """Outcome of a scene without expectations, such as one from a user's file."""

    def __init__(self, scene: Scene):
        """Accept any scene."""

    def observe(self, sim: Any) -> None:
        """Do nothing."""

    def verdicts(self, sim: Any) -> list[Verdict]:
        """Return no verdicts."""
        return []


class FunctionOutcome(NoOutcome):
    """Outcome of a user's function, which is called once at the end."""

    def __init__(self, function: Callable, scene: Scene):
        """Remember the scene for its parameters."""
        self._function, self._scene = function, scene

    def verdicts(self, sim: Any) -> list[Verdict]:
        """Return what the function measured.

        Raises:
            UserCodeError: the function fails, or does not return values for each environment by name.
        """
        with errors_of(self._function):
            found = self._function(sim, dict(self._scene.parameters))
            if not isinstance(found, dict):
                raise ValueError(f"outcome() must return a dictionary, got {shown(found)}")
            return [self._verdict(name, value, sim.num_envs) for name, value in found.items()]

    def _verdict(self, name: str, value: Any, count: int) -> Verdict:
        parts = list(value) if isinstance(value, tuple) else [value]
        unit = parts.pop() if len(parts) > 1 and isinstance(parts[-1], str) else ""
        columns = [np.atleast_1d(np.asarray(part)) for part in parts]
        values, passed = columns[0], columns[-1] if columns[-1].dtype == bool else None
        fits = all(column.shape == (count,) and column.dtype.kind in "biuf" for column in columns)
        if not fits or len(columns) > 2 or (len(columns) == 2 and passed is None):
            raise ValueError(
                f"outcome() must return ({count},) numbers for {name}, or a tuple of these, of ({count},) booleans for "
                f"a verdict, and of a unit, got {shown(value)}"
            )
        return Verdict(str(name), values if values.dtype == bool else values.astype(np.float64), "", passed, {}, unit)


def scene_of_file(path: Path) -> Demo:
    """The scene that a file describes.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: One of its definitions is not what it must be.
    """
    module = module_of_file(path)
    build = scene_function(path, getattr(module, "scene", None))
    parameters = inspect.signature(build).parameters
    for name, parameter in parameters.items():
        if parameter.default is inspect.Parameter.empty:
            raise ValueError(f"{path}: parameter {name} of scene() must have a default")
    events, vary = _function(path, module, "events", "sim", "frame"), _function(path, module, "vary")
    if vary is not None:
        check_call(path, f"vary({', '.join(['sim', *parameters])})", vary, None, **dict.fromkeys(parameters))
    return Demo(
        name=path.stem,
        summary=(module.__doc__ or "").partition("\n")[0],
        build=build,
        outcome=_outcome(path, getattr(module, "outcome", None)),
        duration=number_in(f"{path}: DURATION", getattr(module, "DURATION", FILE_SCENE_DURATION), above=0.0),
        variants=_variants(path, module),
        events=no_events if events is None else partial(_every_frame, events),
        settings=_settings(path, "SETTINGS", getattr(module, "SETTINGS", {}), dt=True),
        vary=vary,
    )


def _every_frame(events: Callable, scene: Scene) -> list[tuple[float, Callable]]:
    """An event that calls a function before the first frame, and is followed by that of the next frame."""
    return [(0.0, partial(_frame_event, events, scene.parameters, 0))]


def _frame_event(events: Callable, parameters: dict[str, Any], frame: int, sim: Any) -> tuple[float, Callable]:
    """Call a function for a frame, or for the present one after a run was resumed; returns the next event."""
    passed = math.floor(sim.time * EVENT_RATE + 1e-6)
    frame = max(frame, passed)
    events(sim, frame, parameters)
    return (passed + 1) / EVENT_RATE, partial(_frame_event, events, parameters, frame + 1)


def _function(path: Path, module: ModuleType, name: str, *arguments: str) -> Any:
    """A function of the file, None if it has none of that name.

    With the names of its arguments it is checked for these, and the result takes the parameters of the scene as well.
    """
    found = getattr(module, name, None)
    if found is None:
        return None
    if not callable(found):
        raise ValueError(f"{path}: {name} must be a function, got {shown(found)}")
    return errors_of(found)(with_parameters(path, found, *arguments) if arguments else found)


def _checked_verdicts(method: Callable) -> Callable:
    """The method `verdicts` of a user's outcome with errors as one line."""

    @wraps(method)
    def checked(outcome: Any, sim: Any) -> list[Verdict]:
        with errors_of(method):
            found, shape = method(outcome, sim), (sim.num_envs,)
            whole = isinstance(found, list) and all(isinstance(verdict, Verdict) for verdict in found)
            if (
                not whole
                or any(np.shape(one.values) != shape for one in found)
                or any(one.passed is not None and np.shape(one.passed) != shape for one in found)
            ):
                raise ValueError(f"verdicts() must return a list of Verdict with {shape} values, got {shown(found)}")
            return found

    return checked


def _outcome(path: Path, found: Any) -> Any:
    """The outcome of the file: function(scene) -> Outcome."""
    if found is None:
        return NoOutcome
    if not callable(found):
        raise ValueError(f"{path}: outcome must be a function or a class, got {shown(found)}")
    if inspect.isclass(found):
        return _class_outcome(path, found)
    return partial(FunctionOutcome, with_parameters(path, found, "sim"))


def _class_outcome(path: Path, found: Any) -> type:
    """A user's class with errors as one line."""
    missing = [name for name in ("observe", "verdicts") if not callable(getattr(found, name, None))]
    if missing:
        raise ValueError(f"{path}: class outcome must have a method {missing[0]}")
    check_call(path, "outcome(scene)", found, None)
    begin, observe, verdicts = found.__init__, found.observe, _checked_verdicts(found.verdicts)
    methods = {"__init__": errors_of(begin)(begin), "observe": errors_of(observe)(observe), "verdicts": verdicts}
    # A subclass, so that checkpoints find the attributes of the user's class.
    return type(found.__name__, (found,), methods)


def _variants(path: Path, module: ModuleType) -> dict[str, dict[str, Any]]:
    """The settings to compare; "default" is the first."""
    variants = getattr(module, "VARIANTS", None)
    if variants is None:
        return {}
    if not isinstance(variants, dict) or not all(isinstance(name, str) for name in variants):
        raise ValueError(f"{path}: VARIANTS must be a dictionary of settings by name, got {shown(variants)}")
    given = {name: _settings(path, f"VARIANTS {name}", changes, dt=False) for name, changes in variants.items()}
    if given.get("default"):
        raise ValueError(f"{path}: VARIANTS default must be {{}}; the settings of the scene are SETTINGS")
    return {"default": {}, **given}


def _settings(path: Path, what: str, changes: Any, dt: bool) -> dict[str, Any]:
    """Checked differences from Settings()."""
    known = [entry.name for entry in fields(Settings) if dt or entry.name in PER_ENVIRONMENT]
    if not isinstance(changes, dict):
        raise ValueError(f"{path}: {what} must be a dictionary of settings, got {shown(changes)}")
    for name in changes:
        if name not in known:
            raise ValueError(f"{path}: {what} must have names of settings, got {shown(name)}{suggestion(name, known)}")
    try:
        Settings(**changes)
    except ValueError as error:
        raise ValueError(f"{path}: {what}: {error}") from None
    return changes
