"""Checkpoints of a run: how far it is, what it recorded and observed, beside the simulator itself.

What an outcome observes must be plain data: numbers, texts, arrays, and lists, tuples and dicts of them.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.checks import whole_in
from warp_rigid.engine import checkpoint
from warp_rigid.files import archive
from warp_rigid.runs.recording import Recorder
from warp_rigid.scene.scene import Body, Scene
from warp_rigid.scene.serialization import scene_to_data
from warp_rigid.scene.shapes import Shape

FRAMES, OUTCOME, DEEPEST = "more_frames_", "more_outcome_", "more_deepest"


@dataclass
class Progress:
    """How far a run is.

    Attributes:
        recorder: the frames so far.
        outcome: what was observed so far.
        events: those that have not taken place yet.
        deepest: (envs,) deepest overlap so far [m].
        frame: frames done.
    """

    recorder: Recorder
    outcome: Any
    events: list
    deepest: np.ndarray
    frame: int = 0


@dataclass(frozen=True)
class Checkpoints:
    """Where a run keeps its checkpoint.

    Attributes:
        path: the file.
        every: write one whenever so many frames more are done; None writes none.
        resuming: go on from the file if there is one.
    """

    path: Path
    every: int | None = None
    resuming: bool = False

    def write(self, plan: Any, progress: Progress) -> None:
        """Write a checkpoint if it is time for one."""
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
                if not isinstance(value, Scene | Body | Shape)
            },
        }
        checkpoint.save(plan.sim, self.path, more, arrays)

    def resume(self, plan: Any, progress: Progress) -> bool:
        """Bring the plan's simulator and the progress to where the checkpoint was written.

        Returns:
            False if there is nothing to go on from.

        Raises:
            ValueError: the file is no checkpoint, or one of another run.
        """
        if not self.resuming or not self.path.exists():
            return False
        header, arrays = archive.load(self.path, checkpoint.KIND, checkpoint.VERSION)
        try:
            more = header["more"]
            kept = more.get("run", {})
            same_scene = _as_json(scene_to_data(plan.scene)[0]) == header["scene"]
        except archive.UNREADABLE as error:
            raise archive.unusable(self.path, checkpoint.KIND, error) from None
        for name, value in _identity(plan, progress).items():
            if kept.get(name) != value:
                raise ValueError(f"--resume: {self.path} is of another run: {name} was {kept.get(name)}, is {value}")
        if not same_scene:
            raise ValueError(f"--resume: {self.path} is of another run: the scene is not the same")
        try:
            progress.frame = whole_in("frame", more["frame"], 1, plan.frames)
            progress.events[:] = progress.events[len(progress.events) - more["events"] :]
            progress.deepest = archive.shaped(arrays, DEEPEST, np.float64, progress.deepest.shape)
            frames = {name[len(FRAMES) :]: array for name, array in arrays.items() if name.startswith(FRAMES)}
            progress.recorder.restore(frames)
            vars(progress.outcome).update({k: _from_plain(v, arrays) for k, v in more["outcome"].items()})
            checkpoint.restore(plan.sim, header, arrays)
        except archive.UNREADABLE as error:
            raise archive.unusable(self.path, checkpoint.KIND, error) from None
        return True


def _identity(plan: Any, progress: Progress) -> dict[str, Any]:
    """What two runs must have in common for one to go on where the other was."""
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


def _as_json(value: Any) -> Any:
    """As it comes back from a file."""
    return json.loads(json.dumps(value, default=str))


def _to_plain(name: str, value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Plain data for JSON; arrays are put beside it and named."""
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
    raise ValueError(f"{name}: must be plain data to be kept in a checkpoint, got {type(value).__name__}")


def _from_plain(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "array":
        return arrays[content].copy()[()]
    parts = [_from_plain(part, arrays) for part in content] if kind != "dict" else []
    if kind == "dict":
        return {_from_plain(key, arrays): _from_plain(part, arrays) for key, part in content}
    return tuple(parts) if kind == "tuple" else parts
