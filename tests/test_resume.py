"""Runs that go on from a checkpoint: bit for bit, even after kill -9."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.test_scene_runs import MARKS, SMALL
from warp_rigid import scenes
from warp_rigid.commands import cli
from warp_rigid.engine import checkpoint
from warp_rigid.files import archive
from warp_rigid.runs import runner
from warp_rigid.runs.progress import Checkpoints

ROOT = Path(__file__).resolve().parents[1]
FLAT = ("setup_seconds", "seconds", "env_frames_per_second", "contact_capacity", "pair_capacity", "repeated_steps")
"""Figures that tell of the clock and of the room in memory, not of the run."""


def figures(result):
    return json.dumps({name: value for name, value in result.summary.items() if name not in FLAT})


def plan(name, frames, **options):
    return runner.plan_run(scenes.get(name), frames=frames, device="cpu", **options)


def frames_of(recording):
    return [getattr(recording, name).tobytes() for name in ("time", "position", "orientation", "asleep", "level")]


@pytest.mark.parametrize("name", [pytest.param(name, marks=MARKS.get(name, ())) for name in scenes.names()])
def test_every_scene_goes_on_as_if_it_had_not_stopped(name, tmp_path):
    """Poses, verdicts and deepest overlaps of a run that stops on the way, against one that does not."""
    path, size = tmp_path / "a.ckpt", {"assignments": SMALL.get(name, ())}
    whole = runner.execute(plan(name, 4, **size), [0])
    runner.execute(plan(name, 3, **size), [0], checkpoints=Checkpoints(path, every=2))
    rest = runner.execute(plan(name, 4, **size), [0], checkpoints=Checkpoints(path, resuming=True))
    assert frames_of(rest.recording) == frames_of(whole.recording)
    assert figures(rest) == figures(whole)


def test_events_take_place_once(tmp_path):
    """The projectile of the stack flies at 5 s; stopping before or after must not fire it again."""
    options = {"assignments": ["height=1"], "fps": 4.0, "substeps": 30}
    whole = runner.execute(plan("box_stack", 23, **options))
    for stop in (20, 21):
        path = tmp_path / f"{stop}.ckpt"
        runner.execute(plan("box_stack", stop, **options), checkpoints=Checkpoints(path, every=stop))
        rest = runner.execute(plan("box_stack", 23, **options), checkpoints=Checkpoints(path, resuming=True))
        assert frames_of(rest.recording) == frames_of(whole.recording)


@pytest.mark.parametrize(
    ("options", "difference"),
    [
        ({"fps": 30.0}, "fps was 60.0, is 30.0"),
        ({"num_envs": 2}, "envs was 1, is 2"),
        ({"assignments": ["friction=0.3"]}, "set was"),
        ({"seed": 3}, "seed was 0, is 3"),
    ],
)
def test_checkpoint_of_a_different_run_is_refused(tmp_path, options, difference):
    path = tmp_path / "a.ckpt"
    runner.execute(plan("incline", 2), checkpoints=Checkpoints(path, every=1))
    with pytest.raises(ValueError, match=f"^--resume: .*different run: {difference}"):
        runner.execute(plan("incline", 4, **options), checkpoints=Checkpoints(path, resuming=True))
    with pytest.raises(ValueError, match="frame: must be a whole number from 1 to 1"):
        runner.execute(plan("incline", 1), checkpoints=Checkpoints(path, resuming=True))


def command(*arguments):
    return [sys.executable, "-m", "warp_rigid", "run", "box_stack", "--device", "cpu", "--json", *arguments]


@pytest.mark.long
def test_a_killed_run_goes_on_bit_for_bit(tmp_path, capsys):
    """A real kill -9 while checkpoints are being written; then the same command again, with --resume."""
    length = ["--frames", "80", "--envs", "3", "--set", "friction=0.3,0.4,0.5"]
    killed = command(*length, "--checkpoint", str(tmp_path / "killed.ckpt"), "--checkpoint-every", "1")
    process = subprocess.Popen(killed, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not (tmp_path / "killed.ckpt").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.2)
    assert process.poll() is None, "it ran to its end before it could be killed"
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    header, _ = archive.load(tmp_path / "killed.ckpt", checkpoint.KIND, checkpoint.VERSION)
    assert 0 < header["more"]["frame"] < 80
    done = subprocess.run([*killed, "--resume"], cwd=ROOT, check=True, capture_output=True, text=True)
    whole = command(*length, "--checkpoint", str(tmp_path / "whole.ckpt"), "--checkpoint-every", "80")
    assert cli.main(whole[3:]) == 0
    ends = [
        archive.load(tmp_path / f"{name}.ckpt", checkpoint.KIND, checkpoint.VERSION) for name in ("killed", "whole")
    ]
    assert ends[0][0]["more"] == ends[1][0]["more"]
    assert ends[0][1].keys() == ends[1][1].keys()
    assert [name for name, array in ends[0][1].items() if array.tobytes() != ends[1][1][name].tobytes()] == []
    summaries = [json.loads(text) for text in (done.stdout, capsys.readouterr().out)]
    assert [summaries[0][name] for name in summaries[0] if name not in FLAT] == [
        summaries[1][name] for name in summaries[1] if name not in FLAT
    ]


def test_a_usd_film_goes_on_with_the_run(tmp_path, monkeypatch):
    """Colours that tell speeds, and contacts, are those of a run that was not interrupted and wrote as it went."""
    from warp_rigid.render.film import film_from_usd

    monkeypatch.chdir(tmp_path)
    made = ["run", "box_stack", "--device", "cpu", "--color", "speed", "--usd-contacts", "-o"]
    assert cli.main([*made, "whole.usdc", "--frames", "6"]) == 0
    assert cli.main([*made, "part.usdc", "--frames", "3", "--checkpoint-every", "3"]) == 0
    assert cli.main([*made, "rest.usdc", "--frames", "6", "--resume"]) == 0
    whole, rest = film_from_usd("whole.usdc"), film_from_usd("rest.usdc")
    assert whole.num_frames == 7 and whole.color.shape[0] == 7
    for name in ("position", "orientation", "color"):
        assert getattr(rest, name).tobytes() == getattr(whole, name).tobytes(), name


def test_resume_without_a_checkpoint_starts_and_says_so(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["run", "incline", "--frames", "2", "--device", "cpu", "--resume", "--checkpoint-every", "2"]) == 0
    assert "incline.ckpt: no checkpoint found" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["incline.ckpt"]


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["--checkpoint-every", "0"], 2, "--checkpoint-every: must be a whole number from 1"),
        (["--memory-limit", "much"], 2, "--memory-limit: must be bytes or a fraction"),
        (["--memory-limit", "1000"], 3, "memory_limit: simulating 1 environment(s) needs"),
    ],
)
def test_arguments_that_do_not_fit_are_one_line(capsys, tmp_path, monkeypatch, arguments, status, message):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["run", "incline", "--frames", "1", "--device", "cpu", *arguments]) == status
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and message in lines[0]
    assert list(tmp_path.iterdir()) == []


def test_what_an_outcome_may_keep_comes_back():
    from warp_rigid.runs.progress import _from_plain, _to_plain

    kept = {"a": [1, 2.5, None, "x", True], "b": (np.arange(3), [np.float64(0.1)]), 3: {"n": np.array([[1.0]])}}
    arrays = {}
    again = _from_plain(json.loads(json.dumps(_to_plain("x", kept, arrays))), arrays)
    assert repr(again) == repr(kept)
    with pytest.raises(ValueError, match="^x: must be plain data to be stored in a checkpoint, got set"):
        _to_plain("x", {1, 2}, arrays)
