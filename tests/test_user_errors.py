"""Errors of users' events, outcomes, metrics and observers: one line with file and line, and nothing else is lost."""

import json
import os
import sys

import numpy as np
import pytest
from PIL import Image
from pxr import Usd

import warp_rigid as wr
from warp_rigid.commands import cli, run
from warp_rigid.runs import user_code
from warp_rigid.runs.runner import execute, find_scene, plan_run
from warp_rigid.runs.user_code import UserCodeError

SCENE = """import numpy as np

import warp_rigid as wr

DURATION = 0.5


def scene(height: float = 1.0, boxes: int = 1):
    made = wr.Scene()
    made.add_static(wr.Plane(), name="ground")
    made.add_body(wr.Sphere(0.1), position=(0, 0, height), name="ball")
    for i in range(boxes):
        made.add_body(wr.Box((0.1,) * 3), position=(1 + i, 0, 0.1), name=f"box_{i}")
    return made


"""
EVENTS = """def events(sim, frame):
    if frame == 6 and sim.get("position").shape[1] == 4:
        {}["kick"]
"""
OUTCOME = """class outcome:
    def __init__(self, scene):
        self.frames = 0

    def observe(self, sim):
        self.frames += 1
        if self.frames == 2 and sim.get("position").shape[1] == 4:
            raise RuntimeError("two\\nlines")

    def verdicts(self, sim):
        return [wr.scenes.Verdict("height", sim.get("position")[:, 1, 2], "", np.ones(sim.num_envs, bool), {})]
"""


@pytest.fixture
def write(tmp_path):
    """Write a scene file with further definitions."""

    def made(more, name="mine.py"):
        (tmp_path / name).write_text(SCENE + more)
        return str(tmp_path / name)

    return made


def place(path, text):
    """The file and the line of it on which a text stands."""
    return next(f"{path}:{i}" for i, line in enumerate(open(path), 1) if text in line)


def test_a_run_keeps_the_frames_before_an_error_of_its_events(write, tmp_path, capsys):
    path, film, gif = write(EVENTS), tmp_path / "a.usdc", tmp_path / "a.gif"
    command = ["run", path, "--set", "boxes=2", "--device", "cpu"]
    assert cli.main([*command, "-o", str(film), "--film", str(gif), "--json"]) == 2
    out, err = capsys.readouterr()
    assert err.splitlines()[-1] == f"warp-rigid: {place(path, 'kick')}: KeyError: 'kick'"
    assert json.loads(out)["frames"] == 6
    assert Usd.Stage.Open(str(film)).GetEndTimeCode() == 6 and Image.open(gif).n_frames > 1
    with pytest.raises(UserCodeError, match=place(path, "kick") + ": KeyError: 'kick'$") as error:
        execute(plan_run(find_scene(path), ["boxes=2"], device="cpu"))
    assert error.value.kept.recording.position.shape[0] == 7


def test_an_error_of_events_is_told_before_films_are_drawn(write, tmp_path, capsys, monkeypatch):
    path, told = write(EVENTS), []
    monkeypatch.setattr(run, "_draw", lambda *_: told.append(capsys.readouterr().err))
    cli.main(["run", path, "--set", "boxes=2", "--device", "cpu", "--film", str(tmp_path / "a.gif")])
    assert f"{place(path, 'kick')}: KeyError: 'kick'" in told[0]


def test_bodies_that_start_in_each_other_are_told(write, capsys):
    path = write("")
    for height, told in ((0.08, "bodies overlap by 20 mm at the start"), (0.099, "")):
        assert cli.main(["run", path, "--set", f"height={height}", "--device", "cpu", "--frames", "1"]) == 0
        err = capsys.readouterr().err
        assert told in err and bool(told) == ("overlap" in err)


def test_a_run_keeps_everything_but_the_verdicts_of_an_outcome_that_fails(write, capsys):
    path = write("def outcome(sim):\n    return sim.nothing\n")
    assert cli.main(["run", path, "--frames", "3", "--device", "cpu", "--json"]) == 2
    out, err = capsys.readouterr()
    assert err.splitlines()[-1].startswith(f"warp-rigid: {place(path, 'nothing')}: AttributeError: ")
    summary = json.loads(out)
    assert summary["frames"] == 3 and summary["verdicts"] == []


@pytest.mark.parametrize("method", ["observe", "verdicts"])
def test_an_outcome_class_must_have_its_methods(write, method):
    path = write(OUTCOME.replace(f"def {method}", "def other"))
    with pytest.raises(ValueError, match=f"^{path}: class outcome must have a method {method}$"):
        find_scene(path)


def test_verdicts_of_a_wrong_shape_are_named(write):
    path = write(OUTCOME.replace("[:, 1, 2]", "[:, 1]"))
    message = place(path, "def verdicts") + r": verdicts\(\) must return a list of Verdict with \(1,\) values"
    with pytest.raises(UserCodeError, match=message):
        execute(plan_run(find_scene(path), ["boxes=1"], frames=1, device="cpu"))


def test_starts_that_fail_are_named(write):
    path = write("def vary(sim, height, boxes):\n    sim.set('position', (0, 0, 3), bodies=['lid'])\n")
    with pytest.raises(UserCodeError, match=place(path, "lid") + ": .*lid"):
        plan_run(find_scene(path), num_envs=2, device="cpu")


def sweep(path, **more):
    return wr.sweep(path, {"boxes": [0, 2]}, metrics=["drift", "outcome"], device="cpu", **more)


def test_a_sweep_loses_only_the_runs_whose_events_fail(write, caplog):
    result = sweep(path := write(EVENTS))
    alone = wr.sweep(path, {"boxes": [0]}, metrics=["drift", "outcome"], device="cpu")
    assert result.rows[0]["status"] == "ok" and result.rows[0]["drift"] == alone.rows[0]["drift"]
    row = result.rows[1]
    assert (row["status"], row["drift"]) == ("error", None)
    assert row["reason"] == f"events: {place(path, 'kick')}: KeyError: 'kick'"
    assert [record.message for record in caplog.records if record.levelname == "ERROR"] == [f"run 1: {row['reason']}"]


def test_a_sweep_loses_only_the_columns_of_an_outcome_that_fails(write):
    result = sweep(path := write(OUTCOME))
    assert result.rows[0]["outcome_height_ok"] and result.rows[1]["outcome_height"] is None
    assert result.rows[1]["reason"] == f"outcome: {place(path, 'raise')}: RuntimeError: two lines"
    assert result.rows[1]["status"] == "error" and result.rows[1]["drift"] > 0.3


def fails_for_boxes(sim):
    if sim.num_bodies == 4:
        raise KeyError("boxes")
    return sim.get("position")[:, 1, 2]


def wrong_shape(sim):
    return np.zeros(3)


def test_a_sweep_loses_only_the_column_of_a_metric_that_fails(write):
    scene = find_scene(write("")).build
    result = wr.sweep(scene, {"boxes": [0, 2]}, duration=0.1, metrics=["drift", fails_for_boxes], device="cpu")
    assert [row["status"] for row in result.rows] == ["ok", "error"]
    assert result.rows[0]["fails_for_boxes"] > 0.9 and result.rows[1]["fails_for_boxes"] is None
    assert result.rows[1]["drift"] > 0.0
    line = fails_for_boxes.__code__.co_firstlineno
    assert (
        result.rows[1]["reason"] == f"metric fails_for_boxes: tests/test_user_errors.py:{line + 2}: KeyError: 'boxes'"
    )
    result = wr.sweep(scene, {}, duration=0.1, metrics=["drift", wrong_shape], device="cpu")
    line = wrong_shape.__code__.co_firstlineno
    reason = f"metric wrong_shape: tests/test_user_errors.py:{line}: must return (1,) or (1, n) values, got shape (3,)"
    assert result.rows[0]["reason"] == reason and result.rows[0]["drift"] > 0.0


class Fragile:
    """An observer that cannot be made."""

    def __init__(self, sim):
        raise OSError("no licence")


def test_an_observer_that_cannot_be_made_loses_only_its_column(write):
    scene = find_scene(write("")).build
    options = {"observe": [Fragile, "impacts"], "series": ["Fragile", "energy"], "metrics": ["drift"]}
    result = wr.sweep(scene, {}, duration=0.5, device="cpu", **options)
    (row,) = result.rows
    line = Fragile.__init__.__code__.co_firstlineno
    assert row["reason"] == f"observer Fragile: tests/test_user_errors.py:{line + 1}: no licence"
    assert row["Fragile"] is None and row["impacts"] == 1 and row["drift"] > 0.3
    series = result.series().to_pandas()
    assert series["Fragile"].isna().all() and np.isfinite(series["energy"]).all()


def grows(sim):
    return np.zeros((sim.num_envs, 1 + (sim.time > 0.2)))


def test_an_observer_must_keep_its_shape(write):
    scene = find_scene(write("")).build
    options = {"observe": [grows, "impacts"], "series": ["grows"], "metrics": ["drift"]}
    result = wr.sweep(scene, {}, duration=0.5, device="cpu", **options)
    line = grows.__code__.co_firstlineno
    text = "must return shape (1, 1) at every sample, as at the first, got (1, 2)"
    assert result.rows[0]["reason"] == f"observer grows: tests/test_user_errors.py:{line}: {text}"
    assert result.rows[0]["impacts"] == 1 and result.rows[0]["drift"] > 0.3
    assert result.series().num_rows == 3


def test_a_sweep_stopped_by_an_error_tells_what_it_kept(write, tmp_path, capsys, monkeypatch):
    from warp_rigid.sweep.table import ResultFile

    def full(self, rows, add=ResultFile.add):
        if self.rows:
            raise OSError(28, "No space left on device", str(self.path))
        add(self, rows)

    monkeypatch.setattr(ResultFile, "add", full)
    table = tmp_path / "t.parquet"
    command = ["sweep", write(""), "--vary", "height=0.5:1:2", "--batch", "1", "--duration", "0.1", "--device", "cpu"]
    assert cli.main([*command, "-o", str(table)]) == 2
    *_, stopped, reason = capsys.readouterr().err.splitlines()
    assert stopped.startswith(f"stopped: {table} has the runs finished so far; to continue: warp-rigid sweep")
    assert reason == f"warp-rigid: {table}: No space left on device"


def test_a_file_that_changes_is_read_anew(tmp_path, monkeypatch):
    """Also within a second, and without a folder of bytecode beside it."""
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    file = tmp_path / "mine.py"
    for value in (1, 2):
        file.write_text(f"value = {value}\n")
        os.utime(file, (1e9, 1e9))
        assert user_code.module_of_file(file).value == value
    assert list(tmp_path.iterdir()) == [file]
