"""Runner: one simulation from a scene's name to its recording, verdicts and figures."""

import fnmatch
import importlib.util
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid import scenes
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.runs.assignments import PROPERTIES, Assignments, sort_assignments
from warp_rigid.runs.progress import Checkpoints, Progress
from warp_rigid.runs.recording import Recorder, Recording, steps_per_frame
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scenes import Demo, Verdict
from warp_rigid.usd import import_usd
from warp_rigid.usd.load import film_duration
from warp_rigid.usd.options import SUFFIXES as USD_SUFFIXES

__all__ = ["Plan", "Result", "execute", "find_scene", "module_of_file", "plan_run", "set_each", "step_frame"]

FILE_SCENE_DURATION = 4.0
"""How long a scene from a user's file runs unless told otherwise [s]."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A simulation that is ready to run.

    Attributes:
        demo: the scene's description.
        scene: what it built.
        sim: the Simulator.
        labels: what tells the environments apart; empty texts if nothing does.
        variants: which of the demo's variants each environment runs; None where settings or
            properties were changed or the run is cut short, so that the demo expects nothing.
        fps: frames per simulated second.
        frames: how many frames to simulate.
        parameters: what was set, by name, for the summary.
        setup_seconds: what building the scene and the simulator took, kernels included.
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


@dataclass(frozen=True, eq=False)
class Result:
    """What a run gave.

    Attributes:
        recording: the chosen environments' poses.
        verdicts: the outcome's verdicts; empty for a scene without an outcome.
        status: (envs,) records of Simulator.status.
        summary: figures, ready for JSON.
    """

    recording: Recording
    verdicts: list[Verdict]
    status: np.ndarray
    summary: dict[str, Any]


def find_scene(source: str) -> Demo:
    """A built-in scene by name, the one that a .py file makes with its function scene(), or that of a USD file.

    Raises:
        ValueError: There is no such scene, the file has no function scene(), or its format needs a converter.
        FileNotFoundError: There is no such file.
    """
    if source.endswith(".py"):
        return _scene_of_file(Path(source))
    if source.endswith(USD_SUFFIXES):
        return _scene_of_usd(Path(source))
    if source.endswith((".urdf", ".xml", ".mjcf")):
        converter = "urdf-usd-converter" if source.endswith(".urdf") else "mujoco-usd-converter"
        raise ValueError(f"{source}: convert it to USD first, with {converter}; joints are not simulated")
    if source not in scenes.names():
        raise ValueError(
            "scene: must be a USD file, a .py file with a function scene() or one of "
            f"{', '.join(scenes.names())}; got {source!r}"
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
) -> Plan:
    """Build the scene and the simulator.

    Args:
        demo: from find_scene.
        assignments: texts "name=value" or "name=value,value,...", see warp_rigid.runs.assignments.
        num_envs: environments; None takes as many as the lists or variants need, else one.
        compare: one environment for each of the scene's variants.
        frames: how many; None takes the scene's own duration.
        fps: frames per simulated second.
        substeps: steps a frame, which sets dt; None takes the dt of the settings.
        device: as in Simulator.
        seed: of the scene, where it draws random numbers; None leaves its own.
        memory_limit: as in Simulator.

    Raises:
        ValueError: An argument does not fit the scene or another argument.
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
    sim = Simulator(scene, num_envs=count, settings=settings, device=device, seed=seed or 0, memory_limit=memory_limit)
    if demo.vary and count > 1 and not variants and not given.batched:
        demo.vary(sim, **{**demo.parameters, **given.scene})
    _apply(sim, given, variants)
    changed = given.settings or given.properties or given.batched or substeps is not None
    expected: tuple[str | None, ...]
    if changed or frames < round(demo.duration * fps):
        expected = (None,) * count
    else:
        expected = tuple(variants) or ("default",) * count
    return Plan(
        demo=demo,
        scene=scene,
        sim=sim,
        labels=tuple(variants) or _labels(given, count),
        variants=expected,
        fps=fps,
        frames=frames,
        parameters={**given.scene, **given.settings, **given.properties, **given.batched},
        setup_seconds=time.perf_counter() - start,
    )


def execute(
    plan: Plan,
    envs=None,
    on_frame: Callable[[int], None] | None = None,
    checkpoints: Checkpoints | None = None,
    velocities: bool = False,
    contacts: bool = False,
) -> Result:
    """Run a plan: step, fire the scene's events, let its outcome observe every frame.

    Args:
        plan: from plan_run.
        envs: environments to record; None records all.
        on_frame: called with the number of frames done after each.
        checkpoints: where to go on from, and to write checkpoints to.
        velocities: whether to record the bodies' velocities too.
        contacts: whether to record the contacts too.

    Raises:
        ValueError: An environment does not exist, fps does not divide the step rate, or the checkpoint to go on from
            is of another run.
    """
    sim, scene = plan.sim, plan.scene
    per_frame = steps_per_frame(sim.settings.dt, plan.fps)
    events = sorted(plan.demo.events(scene), key=lambda event: event[0])
    outcome = plan.demo.outcome(scene)
    labels = [plan.labels[env] for env in envs] if envs is not None else plan.labels
    recorder = Recorder(sim, plan.fps, envs, labels, velocities, contacts)
    progress = Progress(recorder, outcome, events, np.zeros(sim.num_envs))
    if not (checkpoints and checkpoints.resume(plan, progress)):
        recorder.capture(sim)
    seconds = []
    for frame in range(progress.frame, plan.frames):
        start = time.perf_counter()
        step_frame(sim, per_frame, events)
        seconds.append(time.perf_counter() - start)
        recorder.capture(sim)
        progress.deepest = np.maximum(progress.deepest, sim.penetration())
        outcome.observe(sim)
        progress.frame = frame + 1
        if checkpoints:
            checkpoints.write(plan, progress)
        if on_frame is not None:
            on_frame(frame + 1)
    verdicts = outcome.verdicts(sim)
    status = sim.status()
    summary = _summary(plan, seconds, progress.deepest, status, verdicts)
    return Result(recorder.recording(), verdicts, status, summary)


class NoOutcome:
    """A scene from a user's file says nothing of how it must end."""

    def __init__(self, scene: Scene):
        """Nothing to expect."""

    def observe(self, sim: Simulator) -> None:
        """Nothing to look for."""

    def verdicts(self, sim: Simulator) -> list[Verdict]:
        """Nothing to judge."""
        return []


def module_of_file(path: Path) -> Any:
    """What a user's .py file defines.

    Raises:
        FileNotFoundError: There is no such file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    spec: Any = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _scene_of_file(path: Path) -> Demo:
    module = module_of_file(path)
    build = getattr(module, "scene", None)
    if not callable(build):
        raise ValueError(f"{path}: has no function scene()")
    return Demo(
        name=path.stem,
        summary=(module.__doc__ or "").partition("\n")[0],
        build=build,
        outcome=NoOutcome,
        duration=FILE_SCENE_DURATION,
        variants={},
    )


def _scene_of_usd(path: Path) -> Demo:
    """A scene without an outcome; it runs as long as the file's own film, where it has one.

    A name without a folder may be that of a file which comes with the built-in scenes.
    """
    shipped = Path(scenes.__file__).parent / path
    if not path.is_file() and path.name == str(path) and shipped.is_file():
        path = shipped

    def build(root: str | None = None, sdf_resolution: int = 64) -> Scene:
        with warnings.catch_warnings():
            # The caller tells all that the report says.
            warnings.filterwarnings("ignore", message=".*see scene.import_report")
            return import_usd(path, root, sdf_resolution=sdf_resolution)

    return Demo(
        name=path.stem,
        summary=f"the bodies of {path.name}",
        build=build,
        outcome=NoOutcome,
        duration=film_duration(path) or FILE_SCENE_DURATION,
        variants={},
    )


def _settings(demo: Demo, given: Assignments, fps: float, substeps: int | None) -> Settings:
    """The scene's own settings, overridden by those given."""
    chosen = {**demo.settings, **given.settings}
    if substeps is not None:
        if "dt" in given.settings:
            raise ValueError("--substeps: sets dt, so it must not be given together with dt")
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
        raise ValueError(f"--compare: must not be given with a list for {name}")
    return demo.variants


def _num_envs(num_envs: int | None, given: Assignments, variants: dict) -> int:
    wanted = len(variants) or given.num_envs
    if num_envs is None:
        return wanted or 1
    if num_envs < 1:
        raise ValueError(f"--envs: must be >= 1, got {num_envs}")
    if wanted is not None and wanted not in (0, num_envs):
        raise ValueError(f"--envs: {num_envs}, but there are {wanted} values to compare")
    return num_envs


def _apply(sim: Simulator, given: Assignments, variants: dict) -> None:
    """Set what differs between environments, and the bodies' properties."""
    for name in dict.fromkeys(name for variant in variants.values() for name in variant):
        default = getattr(sim.settings, name)
        sim.set(name, [variant.get(name, default) for variant in variants.values()])
    for name, value in given.properties.items():
        set_each(sim, name, [value] * sim.num_envs)
    for name, values in given.batched.items():
        set_each(sim, name, values)


def set_each(sim: Simulator, name: str, values: list) -> None:
    """Give each environment its value of a setting or property.

    Args:
        sim: the simulator.
        name: a name that Simulator.set takes. That of a body's property can choose bodies, by name, pattern or index:
            "mass[box_3]", "mass[box_*]", "mass[4]". Without a choice a coefficient is for all bodies, every other
            property for the dynamic ones.
        values: one value for each environment, the same for all of its chosen bodies.

    Raises:
        ValueError: No body is chosen, or a value is out of range.
    """
    plain, _, choice = name.partition("[")
    if plain == "gravity" or plain not in PROPERTIES:
        sim.set(plain, values)
    else:
        # One value an environment, (envs, 1) or (envs, 1, 3), for all its bodies.
        sim.set(plain, np.asarray(values)[:, None], bodies=chosen_bodies(sim.scene, name, plain, choice.rstrip("]")))


def chosen_bodies(scene: Scene, name: str, plain: str, choice: str) -> list[int]:
    """Indices of the bodies that a property is for; see set_each."""
    bodies = list(enumerate(scene.bodies))
    if choice.isdigit():
        found = [index for index, _ in bodies if index == int(choice)]
    elif choice:
        found = [index for index, body in bodies if fnmatch.fnmatchcase(body.name, choice)]
    else:
        found = [index for index, body in bodies if plain in COEFFICIENTS or body.motion == Motion.DYNAMIC]
    if not found:
        raise ValueError(f"{name}: chooses no body; there are {', '.join(body.name for _, body in bodies)}")
    return found


def _labels(given: Assignments, count: int) -> tuple[str, ...]:
    """Texts such as "friction=0.1" for each environment."""
    return tuple(", ".join(f"{name}={values[env]}" for name, values in given.batched.items()) for env in range(count))


def step_frame(sim: Simulator, steps: int, events: list) -> None:
    """Do steps; an event, (time, function(sim)), takes place before the first step that begins at or after it.

    Args:
        sim: the simulator.
        steps: how many.
        events: those still to come, by time; what takes place is removed.
    """
    dt = sim.settings.dt
    done = 0
    while done < steps:
        while events and events[0][0] < sim.time + 0.5 * dt:
            events.pop(0)[1](sim)
        until_event = round((events[0][0] - sim.time) / dt) if events else steps
        count = min(steps - done, max(1, until_event))
        sim.step(count)
        done += count


def _summary(
    plan: Plan, seconds: list, deepest: np.ndarray, status: np.ndarray, verdicts: list[Verdict]
) -> dict[str, Any]:
    """Figures of a run, of plain numbers and texts."""
    import warp_rigid

    sim = plan.sim
    # The first frame may still load kernels or grow pools: it tells little of the speed.
    warm = seconds[1:] or seconds
    return {
        "scene": plan.demo.name,
        "version": warp_rigid.__version__,
        "device": str(sim.device),
        "envs": sim.num_envs,
        "bodies": sim.num_bodies,
        "frames": plan.frames,
        "fps": plan.fps,
        "time": sim.time,
        "set": plan.parameters,
        "settings": asdict(sim.settings),
        "labels": list(plan.labels),
        **{name: int(value) for name, value in sim.counts().items()},
        "penetration": _numbers(sim.penetration()),
        "deepest_penetration": _numbers(deepest),
        "failed": _records(status, ~np.isin(status["status"], ("ok", "out of bounds"))),
        "out_of_bounds": _records(status, status["status"] == "out of bounds"),
        "setup_seconds": plan.setup_seconds,
        "seconds": sum(seconds),
        "env_frames_per_second": sim.num_envs * len(warm) / sum(warm) if warm else 0.0,
        "verdicts": [_verdict(verdict, plan.variants) for verdict in verdicts],
    }


def _records(status: np.ndarray, chosen: np.ndarray) -> list[dict[str, Any]]:
    """Status records of the chosen environments."""
    return [
        {"env": int(env)} | {name: status[name][env].item() for name in status.dtype.names or ()}
        for env in np.flatnonzero(chosen)
    ]


def _verdict(verdict: Verdict, variants: tuple[str | None, ...]) -> dict[str, Any]:
    """A verdict with what the demo expects of each environment (None: nothing)."""
    return {
        "name": verdict.name,
        "limit": verdict.limit,
        "values": _numbers(verdict.values),
        "passed": [bool(passed) for passed in verdict.passed],
        "expected": [None if variant is None else verdict.expected.get(variant) for variant in variants],
    }


def _numbers(values) -> list[float]:
    return [float(value) for value in np.atleast_1d(values)]
