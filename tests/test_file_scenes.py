"""Scenes of users' files: parameters, events, outcome, variants and starts, in run, compare, sweep, view and bench."""

import json

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid.commands import cli
from warp_rigid.runs.progress import Checkpoints
from warp_rigid.runs.runner import execute, find_scene, plan_run
from warp_rigid.viewer import hud
from warp_rigid.viewer.session import Session

SCENE = '''"""A ball is kicked, pellets rain on it."""

import numpy as np

import warp_rigid as wr

DURATION = 0.5
SETTINGS = {"dt": 1 / 120}
VARIANTS = {"off": {"shock_propagation": "off"}}


def scene(height: float = 1.0, pellets: int = 2):
    made = wr.Scene(gravity=(0, 0, 0))
    made.add_body(wr.Sphere(0.1), position=(0, 0, height), name="ball")
    made.add_pool(wr.Sphere(0.02), pellets, "pellet")
    return made


def events(sim, frame):
    if frame == 6:
        sim.set("linear_velocity", (1.0, 0, 0), bodies="ball")
    if frame % 10 == 0:
        sim.spawn("pellet", (0, 3.0, 0.1 * frame), linear_velocity=(0, 0, 1.0))


def vary(sim, height, pellets):
    sim.set("position", [[(0, env, height)] for env in range(sim.num_envs)], bodies=["ball"])


def outcome(sim):
    x = sim.get("position")[:, 0, 0]
    return {"travel": (x, np.abs(x - 0.4) < 1e-3), "active": sim.get("active").sum(axis=1)}
'''


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "kick.py"
    file.write_text(SCENE)
    return str(file)


def test_run_calls_what_the_file_defines(path):
    """0.5 s at 1 m/s from frame 6 on; pellets at frames 0, 10 and, of two, no third at 20."""
    demo = find_scene(path)
    assert (demo.duration, demo.settings) == (0.5, {"dt": 1 / 120})
    plan = plan_run(demo, ["height=2"], num_envs=3, device="cpu")
    result = execute(plan)
    travel, active = result.verdicts
    np.testing.assert_allclose(travel.values, 0.4, atol=1e-6)
    assert travel.passed.all() and active.values.tolist() == [3, 3, 3] and active.passed is None
    np.testing.assert_allclose(plan.sim.get("position")[:, 0, 1:], [[0, 2], [1, 2], [2, 2]], atol=1e-6)
    np.testing.assert_allclose(plan.sim.get("position")[0, 1:, 2], [0.5, 1 + 20 / 60], atol=1e-4)


LEVERS = """
import numpy as np

import warp_rigid as wr


def scene(speed: float = 1.0, balls: int = 2):
    made = wr.Scene(gravity=(0, 0, 0))
    for i in range(balls):
        made.add_body(wr.Sphere(0.1), position=(0, i, 0), name=f"ball_{i}")
    return made


def events(sim, frame, parameters):
    if frame == 0:
        sim.set("linear_velocity", (parameters["speed"], 0, 0), bodies=f"ball_{parameters['balls'] - 1}")


def outcome(sim, parameters):
    x = sim.get("position")[:, parameters["balls"] - 1, 0]
    expected = parameters["speed"] * sim.time
    return {
        "count": sim.get("active").sum(axis=1),
        "travel": (x, "mm"),
        "error": (x - expected, np.abs(x - expected) < 1e-5, "mm"),
        "moved": x > 0,
    }
"""


def test_scripts_get_their_parameters(tmp_path, capsys):
    """Defaults and what was set, in runs, sweeps of several scenes and the viewer."""
    path = tmp_path / "levers.py"
    path.write_text(LEVERS)
    assert cli.main(["run", str(path), "--set", "speed=2", "--frames", "30", "--device", "cpu", "--json"]) == 0
    count, travel, error, moved = json.loads(capsys.readouterr().out)["verdicts"]
    assert (count["values"], count["passed"], count["unit"]) == ([2.0], None, "")
    np.testing.assert_allclose(travel["values"], [1.0], atol=1e-5)
    assert (travel["passed"], travel["unit"]) == (None, "mm")
    assert (error["passed"], error["unit"], moved["values"], moved["passed"]) == ([True], "mm", [True], [True])
    table = wr.sweep(str(path), {"balls": [1, 3], "speed": [1.0, 2.0]}, metrics=["outcome"], duration=0.5, device="cpu")
    np.testing.assert_allclose([row["outcome_travel"] for row in table.rows], [0.5, 1, 0.5, 1], atol=1e-5)
    assert [row["outcome_count"] for row in table.rows] == [1, 1, 3, 3]
    session = Session(str(path), assignments=["balls=1"], device="cpu")
    session.step(24)
    np.testing.assert_allclose(session.sim.get("position")[0, 0, 0], 0.1, atol=1e-5)


def test_verdicts_are_shown_where_the_outcome_has_some(tmp_path, capsys):
    """Lengths in the unit of the outcome; a run with measured values alone is not judged."""
    path = tmp_path / "levers.py"
    path.write_text(LEVERS)
    assert cli.main(["run", str(path), "--frames", "30", "--device", "cpu"]) == 0
    out = capsys.readouterr().out
    assert "2 of 2 verdicts are yes" in out
    lines = {line.split()[0]: line.split()[1:] for line in out.splitlines() if line}
    assert (lines["count"], lines["travel"], lines["moved"]) == (["2"], ["500", "mm"], ["yes"])
    assert lines["error"][1:] == ["mm", "yes"]
    session = Session(str(path), device="cpu")
    session.step(120)
    shown = hud._text(session, np.array([0]), 0.0, 0.0, 0.0, session.verdicts).split("\n\n")
    assert {"count: **2**", "travel: **500 mm**", "moved: **yes**"} <= set(shown)
    path.write_text(LEVERS + '\n\ndef outcome(sim):\n    return {"count": sim.get("mass")[:, 0]}\n')
    assert cli.main(["run", str(path), "--frames", "1", "--device", "cpu"]) == 0
    out = capsys.readouterr().out
    assert "verdict" not in out and "yes" not in out


@pytest.mark.parametrize("form", ["def events(sim, frame, step=0.5)", "def events(sim, frame, *others)"])
def test_other_arguments_with_defaults_stay_the_users_own(path, form):
    with open(path, "a") as file:
        file.write(f"\n\n{form}:\n    assert 'height' not in str(locals())\n")
    execute(plan_run(find_scene(path), frames=1, device="cpu"))


def test_compare_has_the_variants(path, capsys):
    assert cli.main(["run", path, "--compare", "--device", "cpu", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["labels"] == ["default", "off"]
    assert summary["variants"] == {"default": {}, "off": {"shock_propagation": "off"}}
    assert [verdict["name"] for verdict in summary["verdicts"]] == ["travel", "active"]
    assert cli.main(["run", path, "--compare", "--frames", "1", "--device", "cpu"]) == 0
    assert "off: shock_propagation=off" in capsys.readouterr().out


def test_sweep_applies_events_and_outcome_to_each_scene(path):
    """Environments with different numbers of pellets in one batch, with the rows of batches of one."""
    axes = {"pellets": [1, 4], "height": [1.0, 2.0]}
    results = [wr.sweep(path, axes, metrics=["outcome"], batch=batch, device="cpu") for batch in ("auto", 1)]
    for result in results:
        assert not result.failed and all(row["outcome_travel_ok"] for row in result.rows)
        assert [row["outcome_active"] for row in result.rows] == [2, 2, 4, 4]
        assert not any("outcome_active_ok" in row for row in result.rows)
    assert [row["outcome_travel"] for row in results[0].rows] == [row["outcome_travel"] for row in results[1].rows]


def test_a_resumed_run_goes_on_with_its_events(path, tmp_path):
    demo = find_scene(path)
    whole = execute(plan_run(demo, device="cpu")).verdicts

    class Stopped(Exception):
        pass

    def stop(frame):
        if frame == 12:
            raise Stopped

    checkpoints = Checkpoints(tmp_path / "half.ckpt", every=1, resuming=True)
    with pytest.raises(Stopped):
        execute(plan_run(demo, device="cpu"), on_frame=stop, checkpoints=checkpoints)
    again = execute(plan_run(demo, device="cpu"), checkpoints=checkpoints)
    assert [one.values.tolist() for one in again.verdicts] == [one.values.tolist() for one in whole]


def test_view_and_bench_take_the_file(path, capsys):
    session = Session(path, compare=True, device="cpu")
    session.step(16)
    assert session.sim.get("linear_velocity")[0, 0, 0] == 1.0
    assert cli.main(["bench", path, "--frames", "2", "--settle", "8", "--device", "cpu", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["bodies"] == 3 and row["quality"]["escaped"] == 0


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("def scene(size):\n    pass", "parameter size of scene() must have a default"),
        ("events = 3", "events must be a function, got 3"),
        ("VARIANTS = [1]", "VARIANTS must be a dictionary of settings by name, got [1]"),
        ("VARIANTS = {'a': {'dt': 1}}", "VARIANTS a must have names of settings, got 'dt'"),
        ("VARIANTS = {'a': {'sleeping': 2}}", "VARIANTS a: sleeping: must be True or False, got 2"),
        ("DURATION = 0", "DURATION: must be a finite number > 0, got 0"),
        ("def events(sim):\n    pass", "events(sim, frame) or events(sim, frame, parameters), got events(sim)"),
        (
            "def events(frame, sim):\n    pass",
            "events(sim, frame) or events(sim, frame, parameters), got events(frame, sim)",
        ),
        ("def outcome(parameters, sim):\n    pass", "outcome(sim, parameters), got outcome(parameters, sim)"),
        ("def outcome(sim, frame, q):\n    pass", "must define outcome(sim) or outcome(sim, parameters), got outcome("),
        ("def vary(sim):\n    pass", "must define vary(sim, height, pellets), got vary(sim)"),
    ],
)
def test_bad_definitions_are_named(path, more, message):
    with open(path, "a") as file:
        file.write("\n\n" + more + "\n")
    with pytest.raises(ValueError) as error:
        find_scene(path)
    assert message in str(error.value) and path in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("value", ["3", "{'travel': [1, 2, 3]}", "{'travel': (1.0, 2.0)}", "{'travel': ['a']}"])
def test_a_bad_outcome_is_named(path, value):
    with open(path, "a") as file:
        file.write(f"\n\ndef outcome(sim):\n    return {value}\n")
    with pytest.raises(ValueError, match=r"kick.py:\d+: outcome\(\) must return"):
        execute(plan_run(find_scene(path), frames=1, device="cpu"))
