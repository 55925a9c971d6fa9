"""Data shared by the runs of a sweep, and the grouping of runs into batches."""

import inspect
import logging
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid import scenes
from warp_rigid.checks import finite_vector, instance_of, number_in, shown, unit_quaternion
from warp_rigid.engine import field_values, joint_quantities
from warp_rigid.engine.precision import check_mass_ratio, check_precision
from warp_rigid.engine.quantities import LACKED, VELOCITIES, check_vectors
from warp_rigid.engine.settings import Settings
from warp_rigid.runs.assignments import Assignments, assignment_target
from warp_rigid.runs.file_scene import FILE_SCENE_DURATION, NoOutcome
from warp_rigid.runs.runner import find_scene, selected
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.scene import SURFACE_VELOCITIES, Body, Motion, Scene, check_mass
from warp_rigid.scenes import Demo
from warp_rigid.sweep.batch_size import Footprint, SizedRun, footprint_of
from warp_rigid.sweep.design import Run, digest, stable_hash
from warp_rigid.sweep.metrics import named_observers

MAX_CACHED_SCENES = 4096
"""Maximum number of scenes cached between the validation of a design and its runs; others are built again."""

log = logging.getLogger("warp_rigid")


@dataclass(frozen=True, eq=False)
class Job:
    """Data shared by all runs of a sweep; serialized for the workers of a cluster.

    Attributes:
        demo: the scene description.
        scene_id: identifies the scene, including its source code.
        fixed: values shared by all runs, by name.
        duration: simulated time of each run [s].
        fps: state samples per simulated second, for metrics and trajectories.
        metrics: names of built-in metrics, or functions of the simulator.
        trajectories: whether poses are recorded.
        observers: names of built-in observers, functions or classes, for the columns `observe` and the series.
        observe: names of the observers whose values at the end are columns.
        series: names of the observers whose values at every sample are kept.
        device: a Warp device or its name; None uses the first CUDA device, else the CPU.
        scenes: cached scenes by key.
    """

    demo: Demo
    scene_id: str
    fixed: dict[str, Any]
    duration: float
    fps: float
    metrics: tuple[str | Callable, ...]
    trajectories: bool = False
    observers: tuple[str | Callable, ...] = ()
    observe: tuple[str, ...] = ()
    series: tuple[str, ...] = ()
    device: Any = None
    scenes: dict[str, Scene] = field(default_factory=dict)


def resolve_scene(scene: Any) -> tuple[Demo, str]:
    """Resolve the scene argument of a sweep to a scene description and a scene id.

    Args:
        scene: a built-in name, the path of a .py, USD, MJCF or URDF file, a Demo, a Scene, or a function that returns
            one.

    Raises:
        ValueError: The argument is none of these.
    """
    if isinstance(scene, str | Path):
        demo = find_scene(str(scene))
        path = Path(scene)
        is_file = str(scene) not in scenes.names() and path.is_file()
        return demo, f"{demo.name}:{digest(path.read_bytes())}" if is_file else demo.name
    if isinstance(scene, Demo):
        return scene, scene.name
    if isinstance(scene, Scene):
        made = scene
        demo = Demo("scene", "", lambda: made, NoOutcome, FILE_SCENE_DURATION, {})
        content = [structure(scene), scene.gravity, [_numbers_of(body) for body in scene.bodies]]
        return demo, f"scene:{digest(repr(content).encode())}"
    if callable(scene):
        name = getattr(scene, "__name__", type(scene).__name__)
        demo = Demo(name, "", scene, NoOutcome, FILE_SCENE_DURATION, {})
        try:
            return demo, f"{name}:{digest(inspect.getsource(scene).encode())}"
        except (OSError, TypeError):
            return demo, name
    raise ValueError(f"scene: must be a name, a .py file, a Scene or a function that returns one, got {scene!r}")


def structure(scene: Scene) -> Hashable:
    """All properties of a scene but the poses, velocities, masses, coefficients and activity of bodies, and gravity."""
    bodies = tuple((body.shape.key, int(body.motion), body.name) for body in scene.bodies)
    fields = tuple(repr(field) for field in scene.force_fields)
    apart = tuple(sorted(scene.filtered_pairs))
    joints = tuple(repr(joint) for joint in scene.joints)
    limits = repr(scene.bounds), scene.out_of_bounds
    return bodies, fields, apart, joints, limits, scene.friction_combine, scene.restitution_combine


def make_runs(job: Job, points: list[tuple[dict[str, Any], int]], seed: int | None) -> list[Run]:
    """Create the run of every point, with its implied settings, its seed and its id."""
    base = job.demo.parameters.get("seed", 0) if seed is None else seed
    base = base if isinstance(base, int) else 0
    given = set(points[0][0]) | set(job.fixed) if points else set()
    implied = _implied_settings(job, given, [point for point, _ in points])
    runs, occurrences = [], {}
    for index, (point, repeat) in enumerate(points):
        own = _implied_by(job, point)
        parameters = {**point, **{name: own.get(name, default) for name, default in implied.items()}}
        parts = [job.scene_id, job.fixed, parameters, base + repeat, job.duration]
        run_id = stable_hash(*parts)
        occurrences[run_id] = occurrences.get(run_id, 0) + 1
        if occurrences[run_id] > 1:  # a design may contain a point twice; each occurrence is a separate run
            run_id = stable_hash(*parts, occurrences[run_id])
        runs.append(Run(index, run_id, parameters, base + repeat))
    return runs


def run_inputs(job: Job, runs: Sequence[Run]) -> list[Assignments]:
    """Sort the values of each run by target."""
    known = job.demo.parameters
    names = [*job.fixed, *(runs[0].parameters if runs else ())]
    places = {name: assignment_target(name, known, "fixed" if name in job.fixed else "axis") for name in names}
    found = []
    for run in runs:
        inputs = Assignments(settings=dict(job.demo.settings))
        targets = {"scene": inputs.scene, "setting": inputs.settings, "property": inputs.properties}
        for name, value in {**job.fixed, **run.parameters}.items():
            targets[places[name]][name] = value
        if "seed" in known:
            inputs.scene.setdefault("seed", run.seed)
        found.append(inputs)
    return found


def group_runs(job: Job, runs: list[Run]) -> list[list[SizedRun]]:
    """Group runs that can share a simulator: those with the same time step.

    Builds every scene and validates every value before any run.

    Returns:
        For each group its runs with the memory that they need, in the order of the design.

    Raises:
        ValueError: A name is unknown or a value is out of range.
    """
    # Scenes of one structure have the same footprint, and accept the same properties.
    numbers: dict[Hashable, int] = {}
    footprints: list[Footprint] = []
    number_of_scene: dict[str, int] = {}
    shape_bytes: dict[str, int] = {}
    lacking = named_observers(job.observers)
    checked: set[Any] = set()
    steps: dict[Any, float] = {}
    groups: dict[float, list[SizedRun]] = {}
    for run, inputs in zip(runs, run_inputs(job, runs), strict=True):
        key, settings = inputs.scene_key, tuple(inputs.settings.items())
        with _errors_of_run(run):
            if key not in number_of_scene:
                scene = build_scene(job, inputs)
                check_precision(scene)
                number_of_scene[key] = numbers.setdefault(structure(scene), len(numbers))
                if len(numbers) > len(footprints):
                    footprints.append(footprint_of(scene, shape_bytes))
                    lacking = [observer for observer in lacking if not observer.is_in(scene)]
            number = number_of_scene[key]
            if settings not in steps:
                steps[settings] = Settings(**inputs.settings).dt
            for name, value in inputs.properties.items():
                if (number, name, value) not in checked:
                    _check_property(build_scene(job, inputs), name, value)
                    checked.add((number, name, value))
            _check_masses(build_scene(job, inputs), inputs.properties)
        groups.setdefault(steps[settings], []).append(SizedRun(run, footprints[number]))
    if runs and lacking:
        raise ValueError(f"{lacking[0].name}: no scene has the {lacking[0].owner} {', '.join(lacking[0].members)}")
    return list(groups.values())


@contextmanager
def _errors_of_run(run: Run) -> Iterator[None]:
    """Let errors name the run and its parameters; those of the user's code that are no ValueError keep their type."""
    try:
        yield
    except Exception as error:
        named = f"run {run.index}"
        if run.parameters:
            named += f" ({', '.join(f'{name}={shown(value)}' for name, value in run.parameters.items())})"
        if isinstance(error, ValueError):
            raise ValueError(f"{named}: {error}") from error
        error.add_note(f"in {named} of the sweep")
        raise


def build_scene(job: Job, inputs: Assignments) -> Scene:
    """Build the scene of a run, or take it from the cache.

    Raises:
        ValueError: A parameter is out of range, or the function does not return a Scene.
    """
    key = inputs.scene_key
    if key in job.scenes:
        return job.scenes[key]
    scene = job.demo.build(**inputs.scene)
    if not isinstance(scene, Scene):
        raise ValueError(f"scene: {job.demo.name} must return a Scene, got {type(scene).__name__}")
    if len(job.scenes) < MAX_CACHED_SCENES:
        job.scenes[key] = scene
    return scene


def _implied_settings(job: Job, given: set[str], points: list[dict[str, Any]]) -> dict[str, Any]:
    """Settings implied by axis values of this scene and not set explicitly, with their default values."""
    found: dict[str, Any] = {}
    for axis in job.demo.goes_with:
        for value in dict.fromkeys(point[axis] for point in points if axis in point):
            for name, implied in _implied_by(job, {axis: value}).items():
                if name not in given:
                    found[name] = job.demo.settings.get(name, getattr(Settings(), name))
                    log.info("%s=%s also sets %s=%s, unless set explicitly", axis, value, name, implied)
    return found


def _implied_by(job: Job, point: dict[str, Any]) -> dict[str, Any]:
    """The settings implied by the values of a point; of several axes the first one counts."""
    found: dict[str, Any] = {}
    for axis, by_value in job.demo.goes_with.items():
        found = {**by_value.get(point.get(axis), {}), **found}
    return found


def _check_property(scene: Scene, name: str, value: Any) -> None:
    """Validate a property as Simulator.set does, before any run."""
    plain = name.partition("[")[0]
    if plain in field_values.VALUE_SHAPES:
        for field in field_values.fields_with(scene.force_fields, plain):
            field_values.check(field, plain, value)
        return
    chosen = [] if plain == "gravity" else selected(scene, name)
    if plain in joint_quantities.WRITABLE:
        joint_quantities.check_range(plain, joint_quantities.check(plain, value, ()))
        joint_quantities.check_of_joints(plain, [scene.joints[index] for index in chosen], value)
    elif plain in COEFFICIENTS:
        number_in(name, value, COEFFICIENTS[plain].lower, COEFFICIENTS[plain].upper)
    elif plain == "mass":
        for index in chosen:
            _check_mass(scene.bodies[index], name, value)
    elif plain == "active":
        instance_of(name, value, bool, "True or False")
    elif plain == "orientation":
        unit_quaternion(name, value)
    else:
        check_vectors(plain, value)
        vector = finite_vector(name, value if np.ndim(value) else (value,) * 3)
        for body in [scene.bodies[index] for index in chosen] if any(vector) and plain in LACKED else ():
            if body.motion in LACKED[plain]:
                raise ValueError(f"{name}: must be 0 for {body.name}, which is {body.motion.name.lower()}")


def _check_mass(body: Body, name: str, value: Any) -> None:
    """Check a mass for one of the selected bodies."""
    if body.motion != Motion.DYNAMIC:
        raise ValueError(f"{name}: {body.name} is not dynamic and has no mass")
    try:
        check_mass(body.shape, value)
    except ValueError as error:
        raise ValueError(f"{name}{str(error).removeprefix('mass')}") from None


def _check_masses(scene: Scene, properties: dict[str, Any]) -> None:
    """Check the ratio of the masses that a run has."""
    changed = {name: value for name, value in properties.items() if name.partition("[")[0] == "mass"}
    if changed:
        masses = {index: body.mass for index, body in enumerate(scene.bodies) if body.motion == Motion.DYNAMIC}
        for name, value in changed.items():
            masses |= dict.fromkeys(selected(scene, name), value)
        check_mass_ratio(masses.values())


def _numbers_of(body: Any) -> list:
    names = ("position", "orientation", *VELOCITIES, "mass", *COEFFICIENTS, *SURFACE_VELOCITIES)
    path = "" if body.path is None else digest(body.path.key)
    return [*(getattr(body, name) for name in names), path]
