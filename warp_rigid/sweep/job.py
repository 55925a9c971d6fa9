"""What the runs of a sweep have in common, and how they are put into batches."""

import hashlib
import inspect
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.checks import finite_number, finite_vector, number_in, unit_quaternion
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.variation import structure
from warp_rigid.runs.assignments import place_of
from warp_rigid.runs.runner import FILE_SCENE_DURATION, NoOutcome, chosen_bodies, find_scene
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.scene import Scene
from warp_rigid.scenes import Demo
from warp_rigid.sweep.design import Run, address

__all__ = ["Job", "Needs", "group_runs", "make_runs", "needs_of", "resolve_scene", "settle_batch_size"]

MOST_KEPT = 4096
"""So many scenes are kept from the check of a design for its runs; further ones are built again."""

log = logging.getLogger("warp_rigid")


@dataclass(frozen=True, eq=False)
class Job:
    """What all runs of a sweep share; it travels to the workers of a cluster.

    Attributes:
        demo: the scene.
        scene_id: what tells the scene from others, its source included.
        fixed: names and values that all runs share.
        duration: simulated time of each run [s].
        fps: looks at the state per simulated second, for metrics and trajectories.
        metrics: names of built-in metrics, or functions of the simulator.
        trajectories: whether poses are kept.
        device: a Warp device or its name; None takes the first CUDA device, else the CPU.
        scenes: scenes that were built already, by their key.
    """

    demo: Demo
    scene_id: str
    fixed: dict[str, Any]
    duration: float
    fps: float
    metrics: tuple[str | Callable, ...]
    trajectories: bool = False
    device: Any = None
    scenes: dict[str, Scene] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Needs:
    """What one run asks for, by where it goes.

    Attributes:
        scene: parameters of the scene.
        settings: settings, dt among them.
        properties: properties of bodies and gravity.
    """

    scene: dict[str, Any]
    settings: dict[str, Any]
    properties: dict[str, Any]

    @property
    def scene_key(self) -> str:
        """What runs of the same scene have in common."""
        return repr(sorted(self.scene.items()))


def resolve_scene(scene: Any) -> tuple[Demo, str]:
    """A caller's scene and what tells it from others.

    Args:
        scene: a built-in name, the path of a .py file, a Demo, a Scene, or a function that returns a Scene.

    Raises:
        ValueError: It is none of these.
    """
    if isinstance(scene, str | Path):
        demo = find_scene(str(scene))
        text = Path(scene).read_text() if str(scene).endswith(".py") else ""
        return demo, f"{demo.name}:{_digest(text)}" if text else demo.name
    if isinstance(scene, Demo):
        return scene, scene.name
    if isinstance(scene, Scene):
        made = scene
        demo = Demo("scene", "", lambda: made, NoOutcome, FILE_SCENE_DURATION, {})
        content = [structure(scene), scene.gravity, [_numbers_of(body) for body in scene.bodies]]
        return demo, f"scene:{_digest(repr(content))}"
    if callable(scene):
        name = getattr(scene, "__name__", type(scene).__name__)
        demo = Demo(name, "", scene, NoOutcome, FILE_SCENE_DURATION, {})
        try:
            return demo, f"{name}:{_digest(inspect.getsource(scene))}"
        except (OSError, TypeError):
            return demo, name
    raise ValueError(f"scene: must be a name, a .py file, a Scene or a function that returns one, got {scene!r}")


def make_runs(job: Job, points: list[tuple[dict[str, Any], int]], seed: int | None) -> list[Run]:
    """Give every point its settings, its seed and its address."""
    base = job.demo.parameters.get("seed", 0) if seed is None else seed
    base = base if isinstance(base, int) else 0
    asked = set(points[0][0]) | set(job.fixed) if points else set()
    companions = _companions(job, asked, [point for point, _ in points])
    runs, met = [], {}
    for index, (point, repeat) in enumerate(points):
        parameters = dict(point)
        for name in companions:
            parameters[name] = _accompanied(job, point, name, companions[name])
        parts = [job.scene_id, job.fixed, parameters, base + repeat, job.duration]
        found = address(*parts)
        met[found] = met.get(found, 0) + 1
        # A design may hold the same point twice; each of them is a run of its own.
        runs.append(Run(index, found if met[found] == 1 else address(*parts, met[found]), parameters, base + repeat))
    return runs


def needs_of(job: Job, runs: Sequence[Run]) -> list[Needs]:
    """Sort what runs set by where it goes."""
    known = job.demo.parameters
    names = [*job.fixed, *(runs[0].parameters if runs else ())]
    places = {name: place_of(name, known, "axis") for name in names}
    found = []
    for run in runs:
        needs = Needs({}, dict(job.demo.settings), {})
        targets = {"scene": needs.scene, "setting": needs.settings, "property": needs.properties}
        for name, value in {**job.fixed, **run.parameters}.items():
            targets[places[name]][name] = value
        if "seed" in known:
            needs.scene.setdefault("seed", run.seed)
        found.append(needs)
    return found


def group_runs(job: Job, runs: list[Run]) -> list[tuple[Scene, list[Run]]]:
    """Runs that can share a simulator: one structure of the scene, one time step.

    Every scene is built and every value checked here, before anything runs.

    Returns:
        For each group a scene of its structure and its runs, in the order of the design.

    Raises:
        ValueError: A name is unknown or a value out of range.
    """
    kinds: dict[str, Scene] = {}
    examples: dict[Any, Scene] = {}
    checked: set[Any] = set()
    steps: dict[Any, float] = {}
    groups: dict[Any, tuple[Scene, list[Run]]] = {}
    for run, needs in zip(runs, needs_of(job, runs), strict=True):
        key = needs.scene_key
        if key not in kinds:
            scene = build_scene(job, needs)
            kinds[key] = examples.setdefault(structure(scene), scene)
        example = kinds[key]
        settings = tuple(needs.settings.items())
        if settings not in steps:
            steps[settings] = Settings(**needs.settings).dt
        for name, value in needs.properties.items():
            if (id(example), name, value) not in checked:
                _check_property(example, name, value)
                checked.add((id(example), name, value))
        groups.setdefault((id(example), steps[settings]), (example, []))[1].append(run)
    return list(groups.values())


def build_scene(job: Job, needs: Needs) -> Scene:
    """The scene of a run.

    Raises:
        ValueError: A parameter is out of range, or the function returns no Scene.
    """
    key = needs.scene_key
    if key in job.scenes:
        return job.scenes[key]
    scene = job.demo.build(**needs.scene)
    if not isinstance(scene, Scene):
        raise ValueError(f"scene: {job.demo.name} must return a Scene, got {type(scene).__name__}")
    if len(job.scenes) < MOST_KEPT:
        job.scenes[key] = scene
    return scene


def settle_batch_size(count: int, most: int, workers: int = 1) -> int:
    """Environments a batch, at most `most`, so that all batches and all workers have about as many."""
    rounds = math.ceil(count / (workers * most))
    return max(1, math.ceil(count / (workers * rounds)))


def _companions(job: Job, asked: set[str], points: list[dict[str, Any]]) -> dict[str, Any]:
    """Settings that go with values of the axes in this scene and were not given, with what holds otherwise."""
    found: dict[str, Any] = {}
    for axis, by_value in job.demo.goes_with.items():
        values = dict.fromkeys(point[axis] for point in points if axis in point)
        for value in values:
            for name, companion in by_value.get(value, {}).items():
                if name not in asked:
                    found[name] = job.demo.settings.get(name, getattr(Settings(), name))
                    log.info("%s=%s also sets %s=%s, unless that is set", axis, value, name, companion)
    return found


def _accompanied(job: Job, point: dict[str, Any], name: str, otherwise: Any) -> Any:
    """The value of a setting that goes with the point's values, or what holds otherwise."""
    for axis, by_value in job.demo.goes_with.items():
        if axis in point and name in by_value.get(point[axis], {}):
            return by_value[point[axis]][name]
    return otherwise


def _check_property(scene: Scene, name: str, value: Any) -> None:
    """Refuse what Simulator.set would refuse, before anything runs."""
    plain, _, choice = name.partition("[")
    if plain != "gravity":
        chosen_bodies(scene, name, plain, choice.rstrip("]"))
    if plain in COEFFICIENTS:
        number_in(name, value, COEFFICIENTS[plain].lower, COEFFICIENTS[plain].upper)
    elif plain == "mass":
        number_in(name, value, above=0.0)
    elif plain == "orientation":
        unit_quaternion(name, value)
    elif np.ndim(value):
        finite_vector(name, value)
    else:
        finite_number(name, value)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _numbers_of(body: Any) -> list:
    names = ("position", "orientation", "linear_velocity", "angular_velocity", "mass")
    return [getattr(body, name) for name in (*names, *COEFFICIENTS)]
