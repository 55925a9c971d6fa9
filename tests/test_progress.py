"""Progress: within batches, in terminals and notebooks only, and without effect on results."""

import contextlib
import io
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid import progress_bar
from warp_rigid.commands import cli
from warp_rigid.sweep import batch_run, workers

AXES = {"friction": [0.2, 0.3, 0.4]}
OPTIONS = {"duration": 0.1, "fps": 40.0, "device": "cpu"}


class Terminal(io.StringIO):
    """A stream that is a terminal."""

    def isatty(self):
        return True


@pytest.fixture
def told(monkeypatch):
    """What each use of progress is told, (done, total)."""
    found = []

    @contextlib.contextmanager
    def progress(name, total, wanted=True):
        yield lambda done, total=total: found.append((done, total))

    monkeypatch.setattr(progress_bar, "progress", progress)
    return found


def test_a_sweep_advances_within_a_batch(told):
    """Three runs with 4 samples each in one batch: a quarter of three runs a sample."""
    wr.sweep("incline", AXES, **OPTIONS)
    assert [done for done, _ in told] == pytest.approx([0.75, 1.5, 2.25, 3.0, 3.0])
    assert {total for _, total in told} == {3}


def test_batches_follow_each_other(told):
    wr.sweep("incline", AXES, batch=2, **OPTIONS)
    assert [done for done, _ in told] == pytest.approx([0.5, 1.0, 1.5, 2.0, 2.0, 2.25, 2.5, 2.75, 3.0, 3.0])


def test_a_batch_that_is_split_goes_on_where_its_first_half_ended(told, monkeypatch):
    prepare = batch_run.prepare

    def only_two(job, runs):
        if len(runs) > 2:
            raise MemoryError
        return prepare(job, runs)

    monkeypatch.setattr(batch_run, "prepare", only_two)
    wr.sweep("incline", AXES, **OPTIONS)
    assert [done for done, _ in told] == pytest.approx([0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 3.0])


@pytest.mark.long
def test_workers_tell_parts_of_their_batches(told, monkeypatch):
    """The process that started them looks often enough to see a batch of many samples in the middle."""
    monkeypatch.setattr(workers, "DONE_PERIOD", 0.01)
    wr.sweep("incline", AXES, duration=4.0, fps=240.0, cluster="local", workers=1, batch=3)
    done = [value for value, _ in told]
    assert done[-1] == 3 and sorted(done) == done
    assert any(0.0 < value < 3.0 for value in done)


def test_a_recording_advances_by_frames(told):
    wr.record(wr.Simulator(wr.scenes.load("incline"), device="cpu"), frames=3)
    assert told == [(0, 3), (1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize("place", ["terminal", "notebook"])
def test_a_terminal_and_a_notebook_show_a_bar_and_get_the_same_rows(place, monkeypatch):
    plain = wr.sweep("incline", AXES, **OPTIONS)
    monkeypatch.setattr(progress_bar, "DELAY", 0.0)
    stream = Terminal() if place == "terminal" else io.StringIO()
    if place == "notebook":
        monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=1)))
    monkeypatch.setattr(sys, "stderr", stream)
    with_bar = wr.sweep("incline", AXES, **OPTIONS)
    assert "incline" in stream.getvalue() and "%" in stream.getvalue()
    measured = [name for name in plain.names if name != "wall_time"]
    for name in measured:
        np.testing.assert_array_equal(plain.column(name), with_bar.column(name))
    stream.seek(0)
    stream.truncate()
    wr.sweep("incline", AXES, progress=False, **OPTIONS)
    assert stream.getvalue() == ""


def test_nothing_is_shown_elsewhere(capsys):
    wr.record(wr.Simulator(wr.scenes.load("incline"), device="cpu"), frames=3)
    wr.sweep("incline", AXES, **OPTIONS)
    assert capsys.readouterr() == ("", "")


def test_a_command_with_redirected_output_prints_lines_within_a_batch(monkeypatch, capsys):
    monkeypatch.setattr(progress_bar, "LINE_PERIOD", 0.0)
    arguments = [
        "sweep",
        "incline",
        "--vary",
        "friction=0.2,0.4",
        "--duration",
        "0.1",
        "--fps",
        "40",
        "--device",
        "cpu",
    ]
    assert cli.main(arguments) == 0
    lines = [line.partition(" after")[0] for line in capsys.readouterr().err.splitlines() if "%" in line]
    assert lines == ["incline: 25 %", "incline: 50 %", "incline: 75 %"]
