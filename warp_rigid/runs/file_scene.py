"""Scenes of users: a .py file that describes a scene as the built-in ones are.

Besides the function `scene(**parameters)` the file may define

- `events(sim, frame)`: called before each frame of 1/60 s, to push, spawn or change something;
- `outcome(sim)`: called at the end, returns by name the measured values, (envs,), booleans for what passed, or a pair
  of values and booleans; or a class as the built-in scenes have, made with the scene, with `observe` and `verdicts`;
- `VARIANTS`: settings to compare, by name; the first is the default;
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
from warp_rigid.engine.settings import PER_ENVIRONMENT, Settings, check_setting
from warp_rigid.runs.user_code import errors_of, module_of_file, scene_function
from warp_rigid.scene.scene import Scene
from warp_rigid.scenes import Demo, Verdict
from warp_rigid.scenes.demo import no_events

__all__ = ["FILE_SCENE_DURATION", "NoOutcome", "scene_of_file"]

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
        """Store the function; it receives the simulator, not the scene."""
        self._function = function

    def verdicts(self, sim: Any) -> list[Verdict]:
        """Return what the function measured.

        Raises:
            UserCodeError: the function fails, or does not return values for each environment by name.
        """
        with errors_of(self._function):
            found = self._function(sim)
            if not isinstance(found, dict):
                raise ValueError(f"outcome() must return a dictionary, got {shown(found)}")
            return [self._verdict(name, value, sim.num_envs) for name, value in found.items()]

    def _verdict(self, name: str, value: Any, count: int) -> Verdict:
        values, passed = value if isinstance(value, tuple) and len(value) == 2 else (value, value)
        values, passed = np.atleast_1d(np.asarray(values)), np.atleast_1d(np.asarray(passed))
        if passed.dtype != bool and not isinstance(value, tuple):
            passed = np.ones(len(values), bool)
        numbers = values.shape == passed.shape == (count,) and values.dtype.kind in "biuf"
        if not numbers or passed.dtype != bool:
            raise ValueError(
                f"outcome() must return ({count},) numbers for {name}, or a pair of numbers and booleans, "
                f"got shape {values.shape} of {values.dtype}"
            )
        return Verdict(str(name), values.astype(np.float64), "", passed, {})


def scene_of_file(path: Path) -> Demo:
    """The scene that a file describes.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: One of its definitions is not what it must be.
    """
    module = module_of_file(path)
    build = scene_function(path, getattr(module, "scene", None))
    for name, parameter in inspect.signature(build).parameters.items():
        if parameter.default is inspect.Parameter.empty:
            raise ValueError(f"{path}: parameter {name} of scene() must have a default")
    events = _function(path, module, "events")
    return Demo(
        name=path.stem,
        summary=(module.__doc__ or "").partition("\n")[0],
        build=build,
        outcome=_outcome(path, getattr(module, "outcome", None)),
        duration=number_in(f"{path}: DURATION", getattr(module, "DURATION", FILE_SCENE_DURATION), above=0.0),
        variants=_variants(path, module),
        events=no_events if events is None else partial(_every_frame, events),
        settings=_settings(path, "SETTINGS", getattr(module, "SETTINGS", {}), dt=True),
        vary=_function(path, module, "vary"),
    )


def _every_frame(events: Callable, scene: Scene) -> list[tuple[float, Callable]]:
    """An event that calls a function before the first frame, and is followed by that of the next frame."""
    return [(0.0, partial(_frame_event, events, 0))]


def _frame_event(events: Callable, frame: int, sim: Any) -> tuple[float, Callable]:
    """Call a function for a frame, or for the present one after a run was resumed; returns the next event."""
    passed = math.floor(sim.time * EVENT_RATE + 1e-6)
    frame = max(frame, passed)
    events(sim, frame)
    return (passed + 1) / EVENT_RATE, partial(_frame_event, events, frame + 1)


def _function(path: Path, module: ModuleType, name: str) -> Any:
    """A function of the file, None if it has none of that name."""
    found = getattr(module, name, None)
    if found is None:
        return None
    if not callable(found):
        raise ValueError(f"{path}: {name} must be a function, got {shown(found)}")
    return _checked(found)


def _checked(function: Callable) -> Callable:
    """A function of the file with errors as one line."""

    @wraps(function)
    def checked(*arguments: Any, **named: Any) -> Any:
        with errors_of(function):
            return function(*arguments, **named)

    return checked


def _checked_verdicts(method: Callable) -> Callable:
    """The method `verdicts` of a user's outcome with errors as one line."""

    @wraps(method)
    def checked(outcome: Any, sim: Any) -> list[Verdict]:
        with errors_of(method):
            found, shape = method(outcome, sim), (sim.num_envs,)
            whole = isinstance(found, list) and all(isinstance(verdict, Verdict) for verdict in found)
            if not whole or any(not np.shape(one.values) == np.shape(one.passed) == shape for one in found):
                raise ValueError(f"verdicts() must return a list of Verdict with {shape} values, got {shown(found)}")
            return found

    return checked


def _outcome(path: Path, found: Any) -> Any:
    """The outcome of the file: function(scene) -> Outcome."""
    if found is None:
        return NoOutcome
    if not callable(found):
        raise ValueError(f"{path}: outcome must be a function or a class, got {shown(found)}")
    return _class_outcome(path, found) if inspect.isclass(found) else partial(FunctionOutcome, found)


def _class_outcome(path: Path, found: Any) -> type:
    """A user's class with errors as one line."""
    missing = [name for name in ("observe", "verdicts") if not callable(getattr(found, name, None))]
    if missing:
        raise ValueError(f"{path}: class outcome must have a method {missing[0]}")
    methods = {name: _checked(getattr(found, name)) for name in ("__init__", "observe")}
    methods["verdicts"] = _checked_verdicts(found.verdicts)
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
    return given if "default" in given else {"default": {}, **given}


def _settings(path: Path, what: str, changes: Any, dt: bool) -> dict[str, Any]:
    """Checked differences from Settings()."""
    known = [entry.name for entry in fields(Settings) if dt or entry.name in PER_ENVIRONMENT]
    if not isinstance(changes, dict):
        raise ValueError(f"{path}: {what} must be a dictionary of settings, got {shown(changes)}")
    for name in changes:
        if name not in known:
            raise ValueError(f"{path}: {what} must have names of settings, got {shown(name)}{suggestion(name, known)}")
    for name, value in changes.items():
        try:
            if name in PER_ENVIRONMENT:
                check_setting(name, value)
        except ValueError as error:
            raise ValueError(f"{path}: {what}: {error}") from None
    return changes
