"""Checkpoints of a run: the simulator, the recorded frames and the state of the outcome.

The attributes of an outcome must be plain data: numbers, strings, arrays, and lists, tuples and dicts of them.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.checks import whole_in
from warp_rigid.engine import checkpoint
from warp_rigid.files import archive
from warp_rigid.runs.recording import Recorder
from warp_rigid.scene.scene import Body, Scene
from warp_rigid.scene.serialization import scenes_to_data
from warp_rigid.scene.shapes import Shape

FRAMES, OUTCOME, DEEPEST = "more_frames_", "more_outcome_", "more_deepest"


@dataclass
class Progress:
    """Progress of a run.

    Attributes:
        recorder: holds the frames recorded so far.
        outcome: the outcome with its observations so far.
        events: pending events.
        deepest: (envs,) maximum penetration so far [m].
        frame: number of completed frames.
        seconds: wall-clock time to step each frame since the start or the checkpoint [s].
    """

    recorder: Recorder
    outcome: Any
    events: list
    deepest: np.ndarray
    frame: int = 0
    seconds: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Checkpoints:
    """When and where a run writes checkpoints.

    Attributes:
        path: the file.
        every: interval between checkpoints [frames]; None writes none.
        resuming: resume from the file if it exists.
    """

    path: Path
    every: int | None = None
    resuming: bool = False

    def write(self, plan: Any, progress: Progress) -> None:
        """Write a checkpoint if one is due."""
        if self.every is None or progress.frame % self.every:
            return
        arrays = {FRAMES + name: array for name, array in progress.recorder.arrays().items()}
        arrays[DEEPEST] = progress.deepest
        more = {
            "run": _identity(plan, progress),
            "frame": progress.frame,
            "events": len(progress.events),
            "outcome": {
                name: _to_plain(f"{plan.demo.name}: {name}", value, arrays)
                for name, value in vars(progress.outcome).items()
                if not (isinstance(value, Scene | Body | Shape) or callable(value))
            },
        }
        with plan.sim.in_use():
            checkpoint.save(plan.sim.internals, self.path, more, arrays)

    def resume(self, plan: Any, progress: Progress) -> bool:
        """Restore the simulator of the plan and the progress from the checkpoint.

        Returns:
            False if there is no checkpoint to resume from.

        Raises:
            ValueError: The file is not a checkpoint, or belongs to a different run.
        """
        if not self.resuming or not self.path.exists():
            return False
        header, arrays = archive.load(self.path, checkpoint.KIND, checkpoint.VERSION)
        try:
            more = header["more"]
            kept = more.get("run", {})
            same_scene = _without_looks(_as_json(scenes_to_data(plan.sim.scenes)[0])) == _without_looks(header)
        except archive.UNREADABLE as error:
            raise archive.unusable(self.path, checkpoint.KIND, error) from None
        for name, value in _identity(plan, progress).items():
            if kept.get(name) != value:
                raise ValueError(
                    f"--resume: {self.path} belongs to a different run: {name} was {kept.get(name)}, is {value}"
                )
        if not same_scene:
            raise ValueError(f"--resume: {self.path} belongs to a different run: the scene differs")
        try:
            progress.frame = whole_in("frame", more["frame"], 1, plan.frames)
            progress.events[:] = progress.events[len(progress.events) - more["events"] :]
            progress.deepest = archive.shaped(arrays, DEEPEST, np.float64, progress.deepest.shape)
            progress.recorder.restore(arrays.below(FRAMES))
            vars(progress.outcome).update({k: _from_plain(v, arrays) for k, v in more["outcome"].items()})
            with plan.sim.in_use():
                checkpoint.restore(plan.sim.internals, header, arrays)
        except archive.UNREADABLE as error:
            raise archive.unusable(self.path, checkpoint.KIND, error) from None
        return True


def _identity(plan: Any, progress: Progress) -> dict[str, Any]:
    """The values that must be equal to resume one run from the checkpoint of another."""
    return _as_json(
        {
            "scene": plan.demo.name,
            "envs": plan.sim.num_envs,
            "fps": plan.fps,
            "seed": plan.sim.seed,
            "set": plan.parameters,
            "settings": asdict(plan.sim.settings),
            "variants": plan.variants,
            "recorded": progress.recorder.envs.tolist(),
            "quantities": progress.recorder.quantities,
        }
    )


def _without_looks(data: dict[str, Any]) -> dict[str, Any]:
    """What the states of a simulation depend on, of the data of its scenes."""
    scenes = [
        {name: value for name, value in scene.items() if name not in ("camera", "looks")} for scene in data["scenes"]
    ]
    return {"shapes": data["shapes"], "scenes": scenes}


def _as_json(value: Any) -> Any:
    """Convert to the form that a JSON file returns."""
    return json.loads(json.dumps(value, default=str))


def _to_plain(name: str, value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Convert to plain data for JSON; arrays are added to `arrays` and referred to by name."""
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, np.ndarray | np.generic) and np.asarray(value).dtype.kind in "biufU":
        place = f"{OUTCOME}{len(arrays)}"
        arrays[place] = np.asarray(value)
        return {"array": place}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_to_plain(name, part, arrays) for part in value]}
    if isinstance(value, dict):
        return {"dict": [[_to_plain(name, part, arrays) for part in pair] for pair in value.items()]}
    raise ValueError(f"{name}: must be plain data to be stored in a checkpoint, got {type(value).__name__}")


def _from_plain(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "array":
        return arrays[content].copy()[()]
    if kind == "dict":
        return {_from_plain(key, arrays): _from_plain(part, arrays) for key, part in content}
    parts = [_from_plain(part, arrays) for part in content]
    return tuple(parts) if kind == "tuple" else parts
