"""Benchmarks: the same start for every engine, figures that add up, and faults told in one line."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from PIL import Image

from warp_rigid import Settings, Simulator
from warp_rigid.bench import measure, notes, peers
from warp_rigid.bench.cases import STANDARD, BenchmarkCase, find_case, moving
from warp_rigid.commands import cli
from warp_rigid.rotations import rotate
from warp_rigid.scenes.builders import arms, stacks

NAMES = [find_case(text) for text in STANDARD]

FAKE = '''"""An engine that lets everything fall without contacts, or fails."""
import sys
from problem import timed

def run(problem):
    import numpy as np
    done = []
    seconds = timed(problem, done.append)
    time = problem.dt * problem.substeps * sum(done)
    if problem.num_envs == 3:
        raise RuntimeError("three is too many")
    if problem.num_envs == 4:
        import an_engine_that_is_missing
    if problem.num_envs == 5:
        print("Warning: Triangle pair buffer overflowed 2000 > 1000.")
    gravity = np.array(problem.gravity)
    velocity = np.broadcast_to(gravity * time, problem.position.shape)
    figures = {"version": "1", "device": "cpu", "collider": "none", **seconds}
    return figures, problem.position + 0.5 * gravity * time**2, problem.orientation, velocity
'''


@pytest.fixture
def fake_peer(tmp_path, monkeypatch):
    """A folder of programs with one for the name mujoco that needs no engine."""
    for name in ("run.py", "problem.py"):
        (tmp_path / name).write_text((peers.FOLDER / name).read_text())
    (tmp_path / "run_mujoco.py").write_text(FAKE)
    monkeypatch.setattr(peers, "FOLDER", tmp_path)


def bench(capsys, *arguments):
    status = cli.main(["bench", *map(str, arguments), "--device", "cpu", "--json"])
    captured = capsys.readouterr()
    return status, captured.out and json.loads(captured.out), captured.err


@pytest.mark.parametrize("case", NAMES, ids=str)
def test_bodies_start_apart_and_every_environment_in_its_own_way(case):
    """Nothing overlaps at the start, so that what is found at the end came about on the way."""
    sim = Simulator(case.build(), 2, device="cpu")
    case.scatter(sim)
    rows = moving(sim.scene)
    position = sim.get("position")[:, rows]
    assert len(rows) == case.bodies
    assert sim.penetration().max() == 0.0
    assert case.escaped(position) == 0
    alike = np.array_equal(position[0], position[1])
    assert alike == (case.name == "stack")
    # The scene by itself is environment 0.
    assert position[0] == pytest.approx(np.array([sim.scene.bodies[i].position for i in rows]), abs=1e-5)


@pytest.mark.parametrize("name, bodies", [("pyramid", 21), ("pyramid", 23), ("kapla", 180), ("kapla", 400)])
def test_structures_start_at_rest_and_stay(name, bodies):
    """Pyramids and towers, with an unfinished row or layer too: they touch without overlap, and nothing moves."""
    case = BenchmarkCase(name, bodies)
    sim = Simulator(case.build(), 1, device="cpu")
    rows = moving(sim.scene)
    start = sim.get("position")[:, rows].astype(np.float64)
    assert len(rows) == bodies
    assert sim.penetration().max() < 1e-8
    moved = np.abs(case.displacement(start))
    assert moved[..., :2].max() < 1e-6 and moved[..., 2].max() < 1e-7
    sim.step(60)
    assert sim.counts()["levels"] >= 2
    assert np.abs(sim.get("position")[:, rows] - start).max() < 1e-6


def test_pyramid_is_that_of_the_other_engine():
    """Box3D, large_pyramid: 100 rows of cubes of 1 m, 5050 in all, density 100, friction 0.6."""
    scene = BenchmarkCase("pyramid", 5050).build()
    cubes = [scene.bodies[i] for i in moving(scene)]
    assert (
        len(cubes) == 5050 and {body.mass for body in cubes} == {100.0} and {b.friction for b in scene.bodies} == {0.6}
    )
    assert cubes[99].position == (49.5, 0.0, 0.5) and cubes[-1].position == (0.0, 0.0, 99.5)
    assert sum(body.position[2] == 0.5 for body in cubes) == 100


@pytest.mark.parametrize("sectors", [36, 60])
def test_bricks_of_a_tower_rest_on_two_others(sectors):
    """Seen from above, a brick covers points of the faces of two bricks below, on either side of its middle."""
    count = 6 * sectors
    position, orientation = stacks.brick_tower(count, sectors)
    length, width, thickness = stacks.BRICK
    along = rotate(orientation, np.tile([1.0, 0.0, 0.0], (count, 1)))
    across = rotate(orientation, np.tile([0.0, 1.0, 0.0], (count, 1)))
    assert np.unique(np.round(position[:, 2] / thickness)).tolist() == [1.0, 3.0, 5.0, 7.0]
    u, v = (n.ravel() for n in np.meshgrid(np.linspace(-length, length, 31), np.linspace(-width, width, 7)))
    faces = position[:, None] + u[:, None] * along[:, None] + v[:, None] * across[:, None]
    for k in range(sectors, count):
        below = np.isclose(position[:, 2], position[k, 2] - 2.0 * thickness)
        place = (faces[below] - position[k]) @ np.stack([along[k], across[k]], axis=1)
        covered = (np.abs(place) < [length, width]).all(axis=-1)
        assert covered.any(axis=1).sum() >= 2
        assert place[covered][:, 0].min() < 0.0 < place[covered][:, 0].max()


def test_piles_start_where_their_seed_says():
    """Drawn here by hand: jitter first, then quaternions with the real part first."""
    sim = Simulator(BenchmarkCase("pile_box", 8).build(), 2, device="cpu")
    BenchmarkCase("pile_box", 8).scatter(sim)
    draws = np.random.default_rng(1001)
    jitter, turned = draws.uniform(-0.02, 0.02, (8, 3)), draws.normal(size=(8, 4))
    lattice = np.array([[x, y, z] for z in (0.25, 0.63) for y in (-0.19, 0.19) for x in (-0.19, 0.19)])
    rows = moving(sim.scene)
    assert sim.get("position")[1, rows] == pytest.approx(lattice + jitter, abs=1e-6)
    expected = turned[:, [1, 2, 3, 0]] / np.linalg.norm(turned, axis=1, keepdims=True)
    assert sim.get("orientation")[1, rows] == pytest.approx(expected, abs=1e-6)


def test_measured_figures_add_up(device):
    case, conditions = BenchmarkCase("stack", 3), measure.Conditions(envs=2, substeps=2, settle=40, frames=10)
    row, sim = measure.measure(case, conditions, wp.get_device(device))
    assert row["env_frames_per_second"] == pytest.approx(20 / row["seconds"])
    assert row["env_steps_per_second"] == pytest.approx(40 / row["seconds"])
    assert row["body_steps_per_second"] == pytest.approx(120 / row["seconds"])
    assert sim.time == pytest.approx(50 / 60)
    # Four corners a face, or more samples of it; three faces in each environment.
    assert row["contacts"] >= 2 * 3 * 4 and row["levels"] == 3
    assert 0.0 < row["contact_capacity_used"] <= 1.0
    assert row["quality"]["height_error"] < 1e-3 and row["quality"]["drift"] < 1e-4
    assert row["quality"]["max_speed"] < 1e-2 and row["quality"]["escaped"] == row["failed_envs"] == 0


def test_phases_are_parts_of_one_run(device):
    """The states and times to rest are those of an ordinary run: neither rehearsal nor measurements leave a trace."""
    case, conditions = BenchmarkCase("pile_box", 4), measure.Conditions(envs=3, substeps=1, settle=0, frames=0)
    rows = measure.measure_phases(case, conditions, wp.get_device(device), until=4.0)
    sim = Simulator(case.build(), 3, Settings(dt=1 / 60), device=device)
    case.scatter(sim)
    bodies = moving(sim.scene)
    overlap, speed, drops = [], [], []
    for _ in range((rows[2]["settle"] + 60) // 6):
        sim.step(6)
        overlap.append(sim.penetration())
        speed.append(np.linalg.norm(sim.get("linear_velocity")[:, bodies], axis=-1).max(axis=1))
    awake = np.array(speed) > 0.01
    drops = [0.1 * (np.flatnonzero(column).max() + 2) for column in awake.T]
    assert [row["phase"] for row in rows] == ["first second", "second second", "at rest"]
    assert [row["settle"] for row in rows[:2]] == [0, 60] and rows[2]["settle"] >= 120
    for row, first in zip(rows, (0, 10, rows[2]["settle"] // 6), strict=True):
        assert row["env_frames_per_second"] == pytest.approx(3 * row["frames"] / row["seconds"])
        assert row["quality"]["deepest_overlap_during"] == np.max(overlap[first : first + 10])
        assert row["quality"]["deepest_overlap"] == overlap[first + 9].max()
        assert row["quality"]["max_speed"] == pytest.approx(speed[first + 9].max())
    rest = rows[2]["rest"]
    assert rest["resting_envs"] == 3 and rest["rest_seconds"] > 0.0
    assert rest["rest_time"] == pytest.approx(max(drops)) and rest["median_rest_time"] == pytest.approx(
        np.median(drops)
    )
    # A box that falls by less than its lowest start cannot be at rest earlier.
    assert rest["rest_time"] > (2.0 * 0.05 / 9.81) ** 0.5


def test_a_ring_that_moves_is_not_at_rest(capsys):
    """It falls from 12 m, bounces off a pole, and rolls for more than three seconds."""
    status, told, _ = bench(capsys, "rings:1", "--substeps", 2, "--phases", "--until", 2)
    assert status == 0 and [row["phase"] for row in told["rows"]] == ["first second", "second second", "last second"]
    assert told["rows"][2]["rest"] == {
        "resting_envs": 0,
        "median_rest_time": None,
        "rest_time": None,
        "rest_seconds": None,
    }
    assert told["rows"][2]["quality"]["max_speed"] > measure.RESTING


def test_bodies_sleep_if_they_may(device):
    case = BenchmarkCase("stack", 2)
    for sleeping in (False, True):
        conditions = measure.Conditions(envs=1, substeps=1, settle=90, frames=10, sleeping=sleeping)
        row, sim = measure.measure(case, conditions, wp.get_device(device))
        assert row["sleeping"] == sleeping
        assert sim.get("asleep")[0, moving(sim.scene)].all() == sleeping


def test_quality_sees_what_is_wrong():
    """Cubes moved by hand: the figures are the moves."""
    case = BenchmarkCase("stack", 2)
    sim = Simulator(case.build(), 2, device="cpu")
    position = np.zeros((2, 2, 3))
    position[..., 2] = [0.1, 0.3]
    position[1, 1] = [0.003, 0.004, 0.298]
    rows = moving(sim.scene)
    sim.set("position", position, bodies=rows)
    found = measure.quality(case, sim, position, np.full((2, 2, 3), 0.1))
    assert found["height_error"] == pytest.approx(0.002, abs=1e-6)
    assert found["top_height_error"] == pytest.approx(-0.001, abs=1e-6)
    assert found["drift"] == pytest.approx(0.005, abs=1e-6)
    assert found["deepest_overlap"] == pytest.approx(0.002, abs=1e-5)
    assert found["median_overlap"] == pytest.approx(0.001, abs=1e-5)
    assert found["max_speed"] == pytest.approx(0.1 * 3**0.5)
    position[0, 0, 0], position[1, 1, 0] = np.nan, 0.2
    found = measure.quality(case, sim, position, np.zeros((2, 2, 3)))
    assert found["escaped"] == 2 and found["deepest_overlap"] is None
    pile = BenchmarkCase("pile_box", 1)
    beside = np.array([[[0.0, 0.0, 0.1]], [[0.5, 0.0, 0.1]], [[0.0, 0.0, -0.1]], [[np.nan, 0.0, 0.1]]])
    assert pile.escaped(beside) == 3


def test_stages_are_timed_without_a_trace(device):
    """The steps that are timed are undone, and the recorded step is as it was."""
    scene = BenchmarkCase("stack", 3).build()
    timed, plain = (Simulator(scene, 2, Settings(sleeping=True), device=device) for _ in range(2))
    timed.step(20), plain.step(20)
    seconds = timed.stage_times(3)
    assert {"predict", "find_contacts", "solve_contacts", "update_sleep"} <= set(seconds)
    assert all(taken > 0.0 for taken in seconds.values())
    timed.step(20), plain.step(20)
    for name in ("position", "orientation", "linear_velocity", "asleep"):
        assert np.array_equal(timed.get(name), plain.get(name))
    assert timed.counts() == plain.counts()


def test_command_writes_lines_and_a_picture(capsys, tmp_path):
    lines, drawn = tmp_path / "out" / "lines.jsonl", tmp_path / "out" / "bench.png"
    few = ("--frames", 2, "--settle", 1, "--json-lines", lines, "-o", drawn)
    status, told, _ = bench(capsys, "stack:2", "pile_box:2", "--envs", "1,2", "--substeps", "1,2", *few)
    assert status == 0 and told["files"] == [str(lines), str(drawn)]
    written = [json.loads(line) for line in lines.read_text().splitlines()]
    assert written == told["rows"]
    assert {(r["scene"], r["envs"], r["substeps"]) for r in written} == {
        (scene, envs, steps) for scene in ("stack", "pile_box") for envs in (1, 2) for steps in (1, 2)
    }
    assert all(row["versions"]["warp-lang"] and row["device"] == "cpu" and "commit" in row for row in written)
    assert np.asarray(Image.open(drawn)).std() > 10


def test_a_run_that_is_broken_off_keeps_its_lines(capsys, tmp_path, monkeypatch):
    lines, real = tmp_path / "lines.jsonl", measure.measure

    def fail_at_two(case, conditions, device):
        if conditions.envs == 2:
            raise RuntimeError("CUDA error: lost")
        return real(case, conditions, device)

    monkeypatch.setattr(measure, "measure", fail_at_two)
    status, _, error = bench(capsys, "stack:1", "--envs", "1,2", "--frames", 1, "--settle", 0, "--json-lines", lines)
    assert status != 0 and "lost" in error
    assert [json.loads(line)["envs"] for line in lines.read_text().splitlines()] == [1]


def test_other_engines_get_the_same_start_and_the_same_judge(capsys, fake_peer):
    """The fake engine lets two cubes fall through the ground: where they end and how deep is known."""
    few = ("--frames", 2, "--settle", 4, "--peers", "mujoco", "--peer-python", f"mujoco={sys.executable}")
    status, told, _ = bench(capsys, "stack:2", "--envs", 2, *few)
    own, other = told["rows"]
    assert status == 0
    fallen = 0.5 * 9.81 * 0.1**2
    assert other["quality"]["height_error"] == pytest.approx(fallen - 0.001, abs=1e-5)
    assert other["quality"]["max_speed"] == pytest.approx(0.981, rel=1e-5)
    # The upper cube has its first touch with nothing: the lower one fell along with it.
    assert other["quality"]["deepest_overlap"] == pytest.approx(fallen - 0.001, abs=1e-4)
    assert other["ratio"] == pytest.approx(other["processor_seconds"] / own["processor_seconds"])


def test_arms_turn_to_targets_of_their_own():
    """A drive holds its target angle but for the weight: stiffness times what is missing is gravity's torque."""
    case = find_case("arm:1")
    row, sim = measure.measure(case, measure.Conditions(3, 4, 180, 1), wp.get_device("cpu"))
    target = np.array([case_targets(1, env) for env in range(3)])
    assert len(np.unique(target)) == 3
    angle = sim.get("joint_position").astype(np.float64)
    mass = sim.scene.bodies[moving(sim.scene)[0]].mass
    weight = mass * 9.81 * 0.5 * arms.PITCH * np.sin(angle)
    assert arms.STIFFNESS * (target - angle) == pytest.approx(weight, abs=1e-4)
    assert 0.0 < row["quality"]["joint_error"] < 1e-6 and row["quality"]["escaped"] == 0


def test_other_engines_get_the_hinges_and_their_targets(tmp_path):
    case = find_case("arm:3")
    sim = Simulator(case.build(), 2, device="cpu")
    peers.write_problem(tmp_path / "problem.npz", "mujoco", case, measure.Conditions(2, 4, 0, 1), sim)
    with np.load(tmp_path / "problem.npz") as file:
        problem = {name: file[name] for name in file.files}
    hinges = json.loads(str(problem["figures"]))["hinges"]
    assert [hinge["parent"] for hinge in hinges] == [-1, 0, 1] and [hinge["child"] for hinge in hinges] == [0, 1, 2]
    for hinge in hinges:
        base = np.zeros(3) if hinge["parent"] < 0 else problem["position"][0, hinge["parent"]]
        ends = base + hinge["in_parent"][0], problem["position"][0, hinge["child"]] + hinge["in_child"][0]
        assert ends[0] == pytest.approx(ends[1], abs=1e-6)
    axes = [rotate(np.array(hinge["in_child"][1]), np.array([1.0, 0.0, 0.0])) for hinge in hinges]
    assert axes == [pytest.approx(axis) for axis in ([1, 0, 0], [0, 1, 0], [1, 0, 0])]
    assert problem["targets"] == pytest.approx(np.array([case_targets(3, 0), case_targets(3, 1)]), abs=1e-6)


def case_targets(links, env):
    """Drawn here by hand: within half a radian, from seed 1000 + environment."""
    return np.random.default_rng(1000 + env).uniform(-0.5, 0.5, links)


def test_an_engine_without_joints_is_told(capsys):
    status, told, error = bench(capsys, "arm:2", "--frames", 1, "--settle", 0, "--peers", "rapier")
    assert status == 0 and told["rows"][1]["fault"] == "its program sets up no joints"
    assert "rapier: arm:2: its program sets up no joints" in error


def test_an_engine_that_is_missing_or_fails_is_told(capsys, fake_peer):
    few = ("--frames", 1, "--settle", 0, "--peers", "mujoco")
    status, told, error = bench(capsys, "stack:1", "--envs", "3,4,5,4", *few)
    assert status == 0
    assert [row.get("fault") for row in told["rows"]] == [
        None,
        "RuntimeError: three is too many",
        None,
        "not installed: pip install mujoco, or give its interpreter by --peer-python",
        None,
        "contacts are missing: Warning: Triangle pair buffer overflowed 2000 > 1000.",
        None,
        "not installed: pip install mujoco, or give its interpreter by --peer-python",
    ]
    assert error.count("mujoco: stack:1: not installed") == 1


def commands_of_the_page():
    """Commands of docs/bench.md, with a thousandth of the bodies, rounded up."""
    page = (Path(__file__).resolve().parents[1] / "docs" / "bench.md").read_text()
    commands = [line for line in page.splitlines() if line.startswith("warp-rigid bench ")]
    return [re.sub(r":(\d+)", lambda count: f":{-(-int(count[1]) // 1000)}", command) for command in commands]


@pytest.mark.long
@pytest.mark.parametrize("command", commands_of_the_page())
def test_command_of_the_page_runs(capsys, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = command.split()[2:]
    cut = ["--envs", "1,2"] if "--envs" in arguments else []
    cut += ["--until", "2"] if "--phases" in arguments else ["--settle", "0", "--frames", "1"]
    status, told, _ = bench(capsys, *arguments, *cut)
    assert status == 0 and told["files"] and all((tmp_path / path).stat().st_size > 0 for path in told["files"])


@pytest.mark.parametrize("name", peers.PACKAGES)
def test_every_program_tells_that_its_engine_is_missing(name, tmp_path):
    """Isolated from all installed packages but numpy, none finds its engine."""
    case = BenchmarkCase("stack", 1)
    sim = Simulator(case.build(), 1, device="cpu")
    blocked = tmp_path / "python"
    hide = "import sys; sys.modules.update(dict.fromkeys(['newton', 'mujoco', 'mujoco_warp', 'rapier3d', 'pybullet']))"
    code = f"{hide}; import runpy; sys.argv = sys.argv[1:]; sys.path.insert(0, sys.argv[0].rsplit('/', 1)[0])"
    blocked.write_text(
        f'#!/bin/sh\nexec {sys.executable} -c "{code}; runpy.run_path(sys.argv[0], run_name=\'__main__\')" "$@"\n'
    )
    blocked.chmod(0o755)
    row = peers.run_peer(name, str(blocked), case, measure.Conditions(1, 1, 0, 1), sim)
    assert row["fault"].startswith("not installed: pip install ")


def test_table_fits_and_tells_the_cold_start(capsys, monkeypatch, fake_peer):
    asked = []

    def first_frame(case, device, variables):
        asked.append((case, device, *sorted(variables.values())))
        return {"seconds": 9.0 / len(asked), "processor_seconds": 1.5, "modules": 17}

    monkeypatch.setattr("warp_rigid.bench.startup.first_frame", first_frame)
    arguments = ["stack:2", "--frames", "1", "--settle", "0", "--cold", "--device", "cpu", "--peers", "mujoco"]
    assert cli.main(["bench", *arguments]) == 0
    out = capsys.readouterr().out
    assert "first frame of stack:2: cold 9.00 s (1.50 s processor time), warm 4.50 s" in out and "17 modules" in out
    # Both found the same folders for their caches, empty ones for the first.
    assert len(asked) == 2 and asked[0] == asked[1]
    assert "…" not in out and max(map(len, out.splitlines())) <= 120
    heading, own, other = out.splitlines()[:3]
    assert heading.split()[-1] == "ratio" and own.split()[3] == "warp_rigid" and other.split()[3] == "mujoco"


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["tower:3"], "got 'tower:3'; all names: stack, pile_box, "),
        (["stack"], "SCENE: must be a name and a number of bodies, such as stack:10, got 'stack'"),
        (["stack:0"], "SCENE: bodies of stack: must be a whole number from 1"),
        (["stack:1", "--envs", "1,x"], "--envs: must be whole numbers >= 1"),
        (["stack:1", "--substeps", "0"], "--substeps: must be whole numbers >= 1"),
        (["stack:1", "--frames", "0"], "--frames: must be from 1 to 1000000, got 0"),
        (["stack:1", "--settle", "-1"], "--settle: must be from 0 to 1000000, got -1"),
        (["stack:1", "--phases", "--until", "1"], "--until: must be from 2 to 1000000, got 1"),
        (["stack:1", "--phases", "--settle", "0"], "--phases: cannot be combined with --frames, --settle, --peers"),
        (["stack:1", "--phases", "--peers", "mujoco"], "--phases: cannot be combined with"),
        (["stack:1", "--until", "3"], "--until: needs --phases"),
        (["stack:1", "-o", "bench.pdf"], "bench.pdf: must end in .png"),
        (["stack:1", "--peers", "chrono"], "--peers: must be one of newton_steel, newton_xpbd"),
        (["stack:1", "--peers", "mujoco", "--peer-python", "mujoco=/nowhere"], "no interpreter at '/nowhere'"),
        (["stack:1", "--peer-python", "rapier=/bin/sh"], "--peer-python: must be one of an engine of --peers"),
    ],
)
def test_bad_input_is_one_line(capsys, arguments, message):
    status, _, error = bench(capsys, *arguments)
    assert status == 2 and message in error and error.count("\n") == 1


def row_of(engine, envs, seconds, **more):
    """A row of 10 frames; processor time is wall-clock time."""
    figures = {"scene": "s", "bodies": 2, "substeps": 4, "frames": 10, "device": "cpu", "contacts": 8 * envs}
    times = {"seconds": seconds, "processor_seconds": seconds, "pairs": 2 * envs, "pairs_of_environments": [2, 2]}
    return {"engine": engine, "envs": envs, **figures, **times, "quality": {"max_speed": 0.0}, **more}


def test_notes_separate_launches_from_environments():
    """A frame of n environments takes 90 + 10 n us: 100 us for one alone and 32.5 us for each of four."""
    rows = [row_of("warp_rigid", n, 10 * (90e-6 + 10e-6 * n)) for n in (1, 2, 4)]
    head, line = notes.notes(rows)
    assert "s:2" in line and "1 to 4" in line and "100 µs to 32.5 µs" in line and "90 µs of a frame" in line
    assert notes.notes(rows[:1]) == []
    assert "of a frame" not in notes.notes([row_of("warp_rigid", n, 10e-6 * n) for n in (1, 4)])[1]


def test_notes_say_what_larger_batches_have_more_of():
    """Of another engine, one environment of four takes 1 ms a frame, the others 20 us."""
    ours = [row_of("warp_rigid", n, 1e-3 * n, pairs_of_environments=[1, n]) for n in (1, 4)]
    others = [
        row_of("mujoco", 1, 200e-6, ratio=0.2, environment_seconds=[200e-6]),
        row_of("mujoco", 4, 10.6e-3, ratio=2.65, contacts=80, quality={"max_speed": 0.5},
               environment_seconds=[200e-6, 200e-6, 10e-3, 200e-6]),
    ]  # fmt: skip
    (line,) = (line for line in notes.notes([*ours, *others]) if "mujoco" in line)
    assert "20 µs to 265 µs" in line and "ratio 0.2 to 2.6" in line and "20 µs to 1 ms by its start" in line
    assert "contacts of an environment: 8 to 20" in line and "1 to 4 pairs" in line and "0.5 m/s" in line


def test_each_environment_of_another_engine_is_timed(monkeypatch):
    monkeypatch.syspath_prepend(str(peers.FOLDER))
    import problem

    class Problem:
        settle, frames, num_envs = 3, 5, 4

    done = []
    found = problem.timed_one_by_one(Problem(), lambda env, frames: done.append((env, frames)))
    assert done == [(env, frames) for env in range(4) for frames in (3, 5)]
    assert len(found["environment_seconds"]) == 4
    assert found["processor_seconds"] == pytest.approx(sum(found["environment_seconds"]))


def test_every_row_has_steps_contacts_and_overlap(capsys):
    """The overlap is that of penetration() in the final state, which the row's own simulation reaches again."""
    status, told, _ = bench(capsys, "pile_box:2", "--envs", "1,3", "--substeps", 2, "--frames", 3, "--settle", 12)
    assert status == 0 and [(row["envs"], row["substeps"]) for row in told["rows"]] == [(1, 2), (3, 2)]
    for row in told["rows"]:
        sim = Simulator(BenchmarkCase("pile_box", 2).build(), row["envs"], Settings(dt=1 / 120), device="cpu")
        BenchmarkCase("pile_box", 2).scatter(sim)
        sim.step(30)
        assert row["contacts"] == sim.counts()["contacts"]
        assert row["quality"]["deepest_overlap"] == sim.penetration().max()
