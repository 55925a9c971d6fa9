"""Runner: one simulation, from the name of a scene to its recording, verdicts and summary."""

import bisect
import fnmatch
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid import scenes
from warp_rigid.checks import listed, shown, suggestion
from warp_rigid.engine import field_values, joint_quantities
from warp_rigid.engine.health_checks import WARNING_NAMES
from warp_rigid.engine.quantities import VECTOR_LENGTHS, owner_of
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.files.mesh_files import USD_SUFFIXES
from warp_rigid.runs.assignments import SELECTING, Assignments, sort_assignments
from warp_rigid.runs.file_scene import FILE_SCENE_DURATION, NoOutcome, scene_of_file
from warp_rigid.runs.progress import Checkpoints, Progress
from warp_rigid.runs.recording import Recorder, Recording, steps_per_frame
from warp_rigid.runs.user_code import UserCodeError
from warp_rigid.scene.camera import Camera, camera_of_text, with_body_index
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.scene import SURFACE_VELOCITIES, Motion, Scene
from warp_rigid.scenes import Demo, Verdict
from warp_rigid.scenes.demo import OverlapOutcome
from warp_rigid.usd import import_usd
from warp_rigid.usd.load import film_duration
from warp_rigid.usd.robots import ROBOT_SUFFIXES, import_robot
from warp_rigid.version import __version__


@dataclass(frozen=True, eq=False)
class Plan:
    """A simulation that is ready to run.

    Attributes:
        demo: the scene description.
        scene: the scene.
        sim: the Simulator.
        labels: one label per environment; may be empty.
        variants: the variant of the demo that each environment runs; None if settings or properties were changed or
            the duration shortened, in which case no outcome is expected.
        fps: frames per simulated second.
        frames: number of frames to simulate.
        parameters: assigned values by name, for the summary.
        setup_seconds: wall-clock time to build the scene and the simulator, including kernel loading [s].
        camera: where pictures are taken from; None for the camera of the scene.
    """

    demo: Demo
    scene: Scene
    sim: Simulator
    labels: tuple[str, ...]
    variants: tuple[str | None, ...]
    fps: float
    frames: int
    parameters: dict[str, Any]
    setup_seconds: float = 0.0
    camera: Camera | None = None


@dataclass(frozen=True, eq=False)
class Result:
    """Result of a run.

    Attributes:
        recording: poses of the recorded environments.
        verdicts: verdicts of the outcome; empty for a scene without an outcome.
        summary: plain data for JSON.
    """

    recording: Recording
    verdicts: list[Verdict]
    summary: dict[str, Any]


def find_scene(source: str) -> Demo:
    """Find a scene by built-in name, .py file with a function scene(), or USD, MJCF or URDF file.

    Raises:
        ValueError: The scene is unknown, the file has no function scene(), or the converter of its format is missing.
        FileNotFoundError: The file does not exist.
    """
    if source.endswith(".py"):
        return scene_of_file(Path(source))
    if source.endswith(USD_SUFFIXES):
        return _scene_of_usd(Path(source))
    if source.endswith(ROBOT_SUFFIXES):
        return _scene_of_robot(Path(source))
    if source not in scenes.names():
        raise ValueError(
            "scene: must be a USD, MJCF or URDF file, a .py file with a function scene() or a built-in scene, got "
            f"{shown(source)}{suggestion(source, scenes.names(), 'warp-rigid scenes')}"
        )
    return scenes.get(source)


def plan_run(
    demo: Demo,
    assignments=(),
    num_envs: int | None = None,
    compare: bool = False,
    frames: int | None = None,
    fps: float = 60.0,
    substeps: int | None = None,
    device: Any = None,
    seed: int | None = None,
    memory_limit: int | float | None = None,
    camera: str | None = None,
) -> Plan:
    """Build the scene and the simulator.

    Args:
        demo: from find_scene.
        assignments: strings "name=value" or "name=value,value,...", see warp_rigid.runs.assignments.
        num_envs: number of environments; None uses the length of the lists or variants, else one.
        compare: simulate one environment per variant of the scene.
        frames: number of frames; None uses the duration of the scene.
        fps: frames per simulated second.
        substeps: steps per frame, which sets dt; None uses the dt of the settings.
        device: as in Simulator.
        seed: seed of the scene's random numbers; None uses its default.
        memory_limit: as in Simulator.
        camera: where pictures are taken from: a text for camera_of_text, or the path or name of a camera of a USD file.

    Raises:
        ValueError: An argument is incompatible with the scene or with another argument.
    """
    start = time.perf_counter()
    given = sort_assignments(assignments, demo.build)
    if seed is not None and "seed" in demo.parameters:
        given.scene.setdefault("seed", seed)
    settings = _settings(demo, given, fps, substeps)
    variants = _variants(demo, given) if compare else {}
    count = _num_envs(num_envs, given, variants)
    if frames is None:
        frames = round(demo.duration * fps)
    if frames < 0:
        raise ValueError(f"--frames: must be >= 0, got {frames}")
    scene = demo.build(**given.scene)
    chosen = None if camera is None else _camera(camera, scene)
    sim = Simulator(scene, num_envs=count, settings=settings, device=device, seed=seed or 0, memory_limit=memory_limit)
    if demo.vary and count > 1 and not variants and not given.batched:
        demo.vary(sim, **{**demo.parameters, **given.scene})
    _apply(sim, given, variants)
    changed = given.settings or given.properties or given.batched or substeps is not None
    ends_early = frames < round(demo.duration * fps)
    judged = tuple(variants) or ("default",) * count
    labels = tuple(", ".join(f"{name}={v[env]}" for name, v in given.batched.items()) for env in range(count))
    return Plan(
        demo=demo,
        scene=scene,
        sim=sim,
        labels=tuple(variants) or labels,
        variants=(None,) * count if changed or ends_early else judged,
        fps=fps,
        frames=frames,
        parameters={**given.scene, **given.settings, **given.properties, **given.batched},
        setup_seconds=time.perf_counter() - start,
        camera=chosen,
    )


def _camera(text: str, scene: Scene) -> Camera:
    """The camera that a text describes or names.

    Raises:
        ValueError: There is no such camera, or the text has another form.
    """
    known = scene.import_report.cameras if scene.import_report is not None else {}
    if "=" in text:
        return with_body_index(camera_of_text(text), [body.name for body in scene.bodies])
    found = [path for path in known if text in (path, path.rpartition("/")[2])]
    if len(found) == 1:
        return known[found[0]]
    names = f" or one of the cameras {listed(list(known))}" if known else " (the scene has no cameras of its own)"
    raise ValueError(f"camera: must be values such as position=3,0,2 look_at=0,0,0{names}, got {shown(text)}")


def execute(
    plan: Plan,
    envs=None,
    on_frame: Callable[[int], None] | None = None,
    checkpoints: Checkpoints | None = None,
    velocities: bool = False,
    contacts: bool = False,
) -> Result:
    """Run a plan: step, apply the events of the scene, and update its outcome every frame.

    Args:
        plan: from plan_run.
        envs: environments to record; None records all.
        on_frame: called after each frame with the number of completed frames.
        checkpoints: the checkpoint to resume from and to write.
        velocities: whether to record velocities.
        contacts: whether to record contacts.

    Raises:
        ValueError: An environment does not exist, fps does not divide the step rate, or the checkpoint belongs to a
            different run.
        UserCodeError: The events or the outcome of a user's scene failed; `kept` is the Result up to there.
    """
    sim, scene = plan.sim, plan.scene
    per_frame = steps_per_frame(sim.settings.dt, plan.fps)
    events = sorted(plan.demo.events(scene), key=lambda event: event[0])
    outcome = plan.demo.outcome(scene)
    labels = [plan.labels[env] for env in envs] if envs is not None else plan.labels
    recorder = Recorder(sim, plan.fps, envs, labels, velocities, contacts, plan.camera)
    progress = Progress(recorder, outcome, events, np.zeros(sim.num_envs))
    if not (checkpoints and checkpoints.resume(plan, progress)):
        recorder.capture(sim)
    try:
        for frame in range(progress.frame, plan.frames):
            start = time.perf_counter()
            step_frame(sim, per_frame, events)
            progress.seconds.append(time.perf_counter() - start)
            recorder.capture(sim)
            outcome.observe(sim)
            progress.deepest = np.maximum(progress.deepest, _overlap(outcome, sim))
            progress.frame = frame + 1
            if checkpoints:
                checkpoints.write(plan, progress)
            if on_frame is not None:
                on_frame(frame + 1)
        verdicts = outcome.verdicts(sim)
    except UserCodeError as error:
        error.kept = _result(plan, progress, [])
        raise
    return _result(plan, progress, verdicts)


def _overlap(outcome: Any, sim: Any) -> np.ndarray:
    """The present overlap of each environment [m]. An outcome that judges it has just measured it, which takes long."""
    return outcome.recent[-1][1] if isinstance(outcome, OverlapOutcome) else sim.penetration()


def _scene_of_usd(path: Path) -> Demo:
    """A scene without an outcome, with the duration of the animation in the file if there is one.

    A name without a folder may refer to a file shipped with the built-in scenes.
    """
    shipped = Path(scenes.__file__).parent / path
    if not path.is_file() and path.name == str(path) and shipped.is_file():
        path = shipped

    def build(root: str | None = None, sdf_resolution: int = 64) -> Scene:
        return import_usd(path, root, sdf_resolution=sdf_resolution)

    return _imported(path, build, film_duration(path) or FILE_SCENE_DURATION)


def _scene_of_robot(path: Path) -> Demo:
    """The scene of an MJCF or URDF file, without an outcome."""

    def build(self_collision: bool = False, sdf_resolution: int = 64) -> Scene:
        return import_robot(path, self_collision=self_collision, sdf_resolution=sdf_resolution)

    return _imported(path, build, FILE_SCENE_DURATION)


def _imported(path: Path, build: Callable[..., Scene], duration: float) -> Demo:
    """The scene of a file, without an outcome and without warnings: the caller prints the whole import report."""

    @wraps(build)
    def quiet(*arguments: Any, **named: Any) -> Scene:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*see scene.import_report")
            return build(*arguments, **named)

    summary = f"the bodies of {path.name}"
    return Demo(path.stem, summary, quiet, NoOutcome, duration, variants={})


def _settings(demo: Demo, given: Assignments, fps: float, substeps: int | None) -> Settings:
    """The settings of the scene, overridden by assignments."""
    chosen = {**demo.settings, **given.settings}
    if substeps is not None:
        if "dt" in given.settings:
            raise ValueError("--substeps: sets dt and cannot be combined with --set dt")
        if substeps < 1:
            raise ValueError(f"--substeps: must be >= 1, got {substeps}")
        chosen["dt"] = 1.0 / (fps * substeps)
    settings = Settings(**chosen)
    steps_per_frame(settings.dt, fps)
    return settings


def _variants(demo: Demo, given: Assignments) -> dict[str, dict[str, Any]]:
    if not demo.variants:
        raise ValueError(f"--compare: {demo.name} has no variants to compare")
    if given.batched:
        name = next(iter(given.batched))
        raise ValueError(f"--compare: cannot be combined with a list for {name}")
    return demo.variants


def _num_envs(num_envs: int | None, given: Assignments, variants: dict) -> int:
    wanted = len(variants) or given.num_envs
    if num_envs is None:
        return wanted or 1
    if num_envs < 1:
        raise ValueError(f"--envs: must be >= 1, got {num_envs}")
    if wanted is not None and wanted not in (0, num_envs):
        raise ValueError(f"--envs: must be {wanted}, the number of values to compare, got {num_envs}")
    return num_envs


def _apply(sim: Simulator, given: Assignments, variants: dict) -> None:
    """Set the values that differ between environments, and body properties."""
    for name in dict.fromkeys(name for variant in variants.values() for name in variant):
        default = getattr(sim.settings, name)
        sim.set(name, [variant.get(name, default) for variant in variants.values()])
    for name, value in given.properties.items():
        set_each(sim, name, [value] * sim.num_envs)
    for name, values in given.batched.items():
        set_each(sim, name, values)


def set_each(sim: Simulator, name: str, values: list) -> None:
    """Set a setting or property to one value per environment.

    Args:
        sim: the simulator.
        name: a name accepted by Simulator.set. A property of bodies or joints may select them by name, pattern or
            index: "mass[box_3]", "mass[box_*]", "mass[4]", "joint_friction[elbow]". Without a selection, a coefficient
            applies to all bodies, a property of joints to those that can have it, a velocity of surfaces to the bodies
            whose surface runs in the scene, any other property to the dynamic bodies.
        values: one value per environment, shared by what is selected.

    Raises:
        ValueError: No body or joint is selected, or a value is out of range.
    """
    plain = name.partition("[")[0]
    if plain in VECTOR_LENGTHS:
        values = [np.broadcast_to(value, VECTOR_LENGTHS[plain]) for value in values]  # 0 is the zero vector
    if plain in field_values.VALUE_SHAPES:
        sim.set(plain, np.asarray(values)[:, None])
    elif plain not in SELECTING:
        sim.set(plain, values)
    else:
        # One value per environment, (envs, 1) or (envs, 1, 3), broadcast over its bodies.
        columns = np.asarray(values)[:, None]
        groups: dict[tuple[int, ...], list[int]] = {}
        for index, scene in enumerate(sim.scenes):
            groups.setdefault(tuple(selected(scene, name)), []).append(index)
        for rows, scenes_of_group in groups.items():
            envs = np.flatnonzero(np.isin(sim.scene_of, scenes_of_group))
            sim.set(plain, columns[envs], envs=envs, **{owner_of(plain): list(rows)})


def selected(scene: Scene, name: str) -> list[int]:
    """Indices of the bodies or joints selected by a property name; see set_each."""
    plain, _, choice = name.partition("[")
    choice = choice.removesuffix("]")
    owner = owner_of(plain)
    entries = list(enumerate(getattr(scene, owner)))
    if choice.isdigit():
        found = [index for index, _ in entries if index == int(choice)]
    elif choice:
        found = [index for index, entry in entries if fnmatch.fnmatchcase(entry.name, choice)]
    else:
        found = [index for index, entry in entries if _is_meant(entry, plain)]
    if not found:
        noun = {"bodies": "body", "joints": "joint"}[owner]
        raise ValueError(f"{name}: selects no {noun}; {owner} are {listed([entry.name for _, entry in entries])}")
    return found


def _is_meant(entry: Any, plain: str) -> bool:
    """Whether a property without a selection applies to a body or joint."""
    if plain in SURFACE_VELOCITIES:
        return any(any(getattr(entry, name)) for name in SURFACE_VELOCITIES)
    if owner_of(plain) == "joints":
        return joint_quantities.can_have(entry, plain)
    return plain in COEFFICIENTS or entry.motion == Motion.DYNAMIC


def step_frame(sim: Simulator, steps: int, events: list) -> None:
    """Step the simulation; an event (time, function(sim)) is applied before the first step at or after its time.

    Args:
        sim: the simulator.
        steps: number of steps.
        events: pending events, sorted by time; applied events are removed. An event may return the one that follows it.
    """
    dt = sim.settings.dt
    done = 0
    while done < steps:
        while events and events[0][0] < sim.time + 0.5 * dt:
            following = events.pop(0)[1](sim)
            if following is not None:
                bisect.insort(events, following, key=lambda event: event[0])
        until_event = round((events[0][0] - sim.time) / dt) if events else steps
        count = min(steps - done, max(1, until_event))
        sim.step(count)
        done += count


def _result(plan: Plan, progress: Progress, verdicts: list[Verdict]) -> Result:
    """The result of the frames so far, with a summary as plain data."""
    sim, seconds = plan.sim, progress.seconds
    status = sim.status()
    # The first frame may load kernels or grow buffers, so it is excluded from the throughput.
    warm = seconds[1:] or seconds
    summary = {
        "scene": plan.demo.name,
        "version": __version__,
        "device": str(sim.device),
        "envs": sim.num_envs,
        "bodies": sim.num_bodies,
        "frames": progress.frame,
        "fps": plan.fps,
        "time": sim.time,
        "set": plan.parameters,
        "settings": asdict(sim.settings),
        "labels": list(plan.labels),
        "variants": {label: plan.demo.variants[label] for label in plan.labels if label in plan.demo.variants},
        **{name: int(value) for name, value in sim.counts().items()},
        "penetration": sim.penetration().tolist(),
        "deepest_penetration": progress.deepest.tolist(),
        "failed": _records(status, ~np.isin(status["status"], ("ok", "out of bounds"))),
        "out_of_bounds": _records(status, status["status"] == "out of bounds"),
        "warnings": [dict(zip(WARNING_NAMES, record.item(), strict=True)) for record in sim.warnings()],
        "setup_seconds": plan.setup_seconds,
        "seconds": sum(seconds),
        "env_frames_per_second": sim.num_envs * len(warm) / sum(warm) if warm else 0.0,
        "verdicts": [_verdict(verdict, plan.variants) for verdict in verdicts],
    }
    return Result(progress.recorder.recording(), verdicts, summary)


def _records(status: np.ndarray, chosen: np.ndarray) -> list[dict[str, Any]]:
    """Status records of the selected environments."""
    return [
        {"env": int(env)} | {name: status[name][env].item() for name in ("status", "step", "time", "body")}
        for env in np.flatnonzero(chosen)
    ]


def _verdict(verdict: Verdict, variants: tuple[str | None, ...]) -> dict[str, Any]:
    """A verdict with the result expected in each environment (None: nothing is expected)."""
    return {
        "name": verdict.name,
        "limit": verdict.limit,
        "unit": verdict.unit,
        "values": verdict.values.astype(bool if verdict.values.dtype == bool else float).tolist(),
        "passed": None if verdict.passed is None else [bool(passed) for passed in verdict.passed],
        "expected": [None if variant is None else verdict.expected.get(variant) for variant in variants],
    }
