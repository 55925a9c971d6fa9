"""Sweeps: batches that are shared, rows that depend on their parameters alone, and what is measured."""

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid import scenes
from warp_rigid.scenes import Demo
from warp_rigid.sweep import batch_run as batch_module
from warp_rigid.sweep.columns import BOOKKEEPING
from warp_rigid.sweep.job import resolve_scene, structure

GRAVITY = 9.81


def ball(height: float = 1.0, speed: float = 0.0, mass: float = 1.0, count: int = 1, tilt: float = 0.0, seed: int = 0):
    """A ball above the ground, and `count` - 1 boxes that stand on it, some way off."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(normal=(0, 0, 1), offset=0.0), name="ground")
    velocity = (speed, 0, 0)
    scene.add_body(wr.Sphere(0.1), position=(0, 0, height), linear_velocity=velocity, mass=mass, name="ball")
    for i in range(count - 1):
        turned = (0, 0, np.sin(0.5 * tilt), np.cos(0.5 * tilt))
        place = (2.0 + i + 1e-3 * seed, 0, 0.1)
        scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=place, orientation=turned, name=f"box_{i}")
    return scene


def values(result):
    """Rows without what tells how they came about."""
    return [{name: value for name, value in row.items() if name not in BOOKKEEPING} for row in result.rows]


def quick(axes, scene=ball, **options):
    return wr.sweep(scene, axes, **{"duration": 0.1, "device": "cpu", **options})


POSES = {"metrics": ["final_pose"]}


def test_rows_are_those_of_a_simulation_alone(device):
    """Poses, velocities and masses of the scene, and all that Simulator.set takes, differ within one batch."""
    axes = {
        "height": [0.1, 0.3], "speed": [0.5, 1.0], "mass": [0.5, 7.0], "tilt": [0.1, 0.9],
        "restitution": [0.9, 0.2], "friction": [0.3, 0.6], "gravity": [(0, 0, -3.0), (0, 0.5, -9.0)],
        "contact_iterations": [3, 10], "shock_propagation": ["off", "two_pass"], "mass[box_0]": [2.0, 3.0],
    }  # fmt: skip
    result = quick(axes, count_of(2), design="zip", duration=0.5, device=device, **POSES)
    assert [row["environment"] for row in result.rows] == [0, 1]
    for i, row in enumerate(result.rows):
        given = {name: listed[i] for name, listed in axes.items()}
        scene = ball(*(given[name] for name in ("height", "speed", "mass")), 2, given["tilt"])
        settings = wr.Settings(
            contact_iterations=given["contact_iterations"], shock_propagation=given["shock_propagation"]
        )
        sim = wr.Simulator(scene, settings=settings, device=device)
        for name in ("restitution", "friction"):
            sim.set(name, given[name])
        sim.set("gravity", given["gravity"])
        sim.set("mass", given["mass[box_0]"], bodies=[2])
        sim.step(120)
        assert sim.get("position").ravel().tolist() == row["final_position"]
        assert sim.get("orientation").ravel().tolist() == row["final_orientation"]
    again = result.replay(result.rows[1], device=device)
    again.step(120)
    assert again.get("position").ravel().tolist() == result.rows[1]["final_position"]


def count_of(count):
    """The scene with so many bodies."""

    def scene(height=1.0, speed=0.0, mass=1.0, tilt=0.0):
        return ball(height, speed, mass, count, tilt)

    return scene


def test_reset_returns_to_each_start():
    made = [ball(height=h, mass=h) for h in (1.0, 2.0)]
    sim = wr.Simulator([made[1], made[0], made[1]], device="cpu")
    sim.step(24)
    sim.reset()
    assert sim.get("position")[:, 1, 2].tolist() == [2, 1, 2]
    assert sim.get("mass")[:, 1].tolist() == [2, 1, 2]


def test_rows_do_not_depend_on_batches_shards_or_order():
    axes = {"height": [0.1, 0.5, 0.9], "friction": [0.2, 0.8]}
    whole = values(quick(axes, **POSES))
    for size in (1, 4):
        assert values(quick(axes, batch=size, **POSES)) == whole
    shards = [values(quick(axes, shard=(i, 2), **POSES)) for i in (1, 2)]
    assert sorted(sum(shards, []), key=lambda row: row["run"]) == whole
    backwards = quick({name: listed[::-1] for name, listed in axes.items()}, **POSES)
    assert {row["id"]: row["final_position"] for row in backwards.rows} == {
        row["id"]: row["final_position"] for row in whole
    }


def test_large_scenes_come_first_and_equal_settings_share_warps():
    """The order of the environments, from which a GPU makes its warps; that of the rows is the order of the design."""

    def stack(count: int = 1):
        scene = wr.Scene()
        scene.add_static(wr.Plane())
        for i in range(count):
            scene.add_body(wr.Box((0.1,) * 3), position=(0, 0, 0.1 + 0.2 * i))
        return scene

    axes = {"count": [1, 3, 2], "contact_iterations": [10, 40], "friction": [0.2, 0.6]}
    rows = wr.sweep(stack, axes, duration=0.01, device="cpu", batch=12).rows
    assert [row["run"] for row in rows] == list(range(12))
    launched = sorted(rows, key=lambda row: row["environment"])
    assert [row["count"] for row in launched] == [3] * 4 + [2] * 4 + [1] * 4
    assert [row["contact_iterations"] for row in launched] == [10, 10, 40, 40] * 3
    assert [row["friction"] for row in launched] == [0.2, 0.6] * 6


def test_only_time_steps_split_a_batch(monkeypatch):
    sizes = []
    monkeypatch.setattr(batch_module, "Simulator", lambda *a, **k: sizes.append(len(a[0])) or wr.Simulator(*a, **k))
    result = quick({"count": [1, 2], "dt": [1 / 240, 1 / 120], "height": [0.5, 0.6, 0.7]}, **POSES)
    assert sizes == [6, 6] and not result.failed
    assert {(row["count"], len(row["final_position"])) for row in result.rows} == {(1, 6), (2, 9)}
    assert structure(ball(height=1.0)) == structure(ball(height=2.0, mass=3.0)) != structure(ball(count=2))
    jointed, driven = ball(), ball()
    for scene in (jointed, driven):
        hinge = scene.add_joint(wr.RevoluteJoint(axis=(0, 1, 0)), 1, None, anchor=(0, 0, 2.0))
    driven.add_drive(hinge, stiffness=1.0)
    assert len({structure(scene) for scene in (ball(), jointed, driven)}) == 3


def test_free_fall_and_flight_have_closed_forms():
    result = quick({"height": [3.0, 5.0], "speed": [0.0, 2.0], "mass": [2.0]})
    steps, dt = 24, 1 / 240
    fall = GRAVITY * dt * dt * steps * (steps + 1) / 2  # velocity first, then position
    for row in result.rows:
        drift = np.hypot(fall, row["speed"] * 0.1)
        # Position and velocity at the middle of steps differ by half a step of gravity at most.
        assert row["drift"] == pytest.approx(drift, abs=0.5 * GRAVITY * dt * 0.1 + 1e-5)
        assert row["top_height"] == pytest.approx(row["height"] - fall, abs=0.5 * GRAVITY * dt * 0.1 + 1e-5)
        assert row["kinetic_energy"] == pytest.approx(0.5 * 2.0 * (row["speed"] ** 2 + (GRAVITY * 0.1) ** 2), rel=1e-5)
        assert (row["contacts"], row["escaped"], row["toppled"]) == (0, 0, False)
        assert row["settle_time"] is None and row["deepest_overlap"] == 0.0
        assert row["status"] == "ok" and row["reason"] is None and row["wall_time"] > 0.0


def test_rest_topple_and_escape_are_told():
    rest = quick({"height": [0.1]}, count_of(2)).rows[0]
    assert rest["settle_time"] == 0.0 and rest["contacts"] == 5 and rest["most_contacts"] == 5
    assert rest["drift"] < 1e-4 and not rest["toppled"]
    # The ball comes from 1 m to the box at 0.1 m: below half of its height above the box.
    fallen = quick({"height": [1.0]}, count_of(2), duration=0.6).rows[0]
    assert fallen["toppled"] and fallen["top_height"] == pytest.approx(0.1, abs=2e-3)
    flown = quick({"speed": [0.0, 300.0]}).rows
    assert [row["escaped"] for row in flown] == [0, 1]


def test_overlap_is_that_at_the_worst_look():
    sunk = quick({"height": [0.07]}, duration=0.5).rows[0]
    assert 0.0 < sunk["deepest_overlap"] <= 0.03


def test_settling_is_timed():
    """A ball without restitution stops when it meets the ground, at sqrt(2 h / g)."""
    row = quick({"height": [0.6]}, duration=1.0, fps=60).rows[0]
    assert row["settle_time"] == pytest.approx(np.sqrt(2 * 0.5 / GRAVITY), abs=1 / 60 + 1 / 240)


def sliding(friction):
    scene = wr.Scene()
    scene.add_static(wr.Plane(normal=(0, 0, 1), offset=0.0), friction=friction)
    scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1), linear_velocity=(1, 0, 0), friction=friction)
    return scene


def test_a_body_settles_at_a_sample_after_it_has_stopped():
    """A box that slides comes to rest after v / (mu g) = 0.24 s; the samples are 0.25 s apart."""
    row = quick({"friction": [0.4]}, sliding, duration=1.0, fps=4).rows[0]
    assert row["settle_time"] == 0.25


def leaving(speed: float = 3.0):
    """A ball leaves the scene and is removed; a box stands beside it, and bodies of a pool wait high up."""
    scene = wr.Scene(bounds=((-1, -1, -1), (1, 1, 9)), out_of_bounds="remove")
    scene.add_static(wr.Plane(), friction=0.5)
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 0.1), linear_velocity=(speed, 0, 0), friction=0.0)
    scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0.5, 0.1))
    scene.add_pool(wr.Sphere(0.1), 2, "spare", position=(0, 0, 5), linear_velocity=(0, 0, -1))
    return scene


def test_bodies_that_are_not_simulated_are_neither_high_nor_fast():
    """The ball is at 1 m after a third of a second, and keeps its velocity of 3 m/s."""
    row = quick({"speed": [3.0]}, leaving, duration=1.0, fps=60).rows[0]
    assert row["settle_time"] == pytest.approx(1 / 3, abs=1 / 60 + 1 / 240)
    assert row["top_height"] == pytest.approx(0.1, abs=1e-3) and not row["toppled"]


def flying_apart():
    """Two balls, one above the other, of which neither stays in the scene."""
    scene = wr.Scene(gravity=(0, 0, 0), bounds=((-1, -1, -1), (1, 1, 2)), out_of_bounds="remove")
    for height in (0.0, 1.0):
        scene.add_body(wr.Sphere(0.1), position=(0, 0, height), linear_velocity=(5, 0, 0))
    return scene


def waiting():
    """The bodies of a pool, none of which is simulated."""
    scene = wr.Scene()
    scene.add_pool(wr.Sphere(0.1), 2, "spare")
    return scene


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("scene", [flying_apart, waiting])
def test_nothing_topples_where_no_body_is_left(scene):
    """Without bodies, the highest one is at -infinity, and the lowest one at infinity."""
    row = quick({"seed": [0]}, lambda seed: scene(), duration=0.5, metrics=["toppled", "top_height"]).rows[0]
    assert row["toppled"] is False and row["top_height"] is None


def test_a_run_that_fails_is_a_row_and_harms_no_other():
    fixed = {"mass": 1e-3}
    good = values(quick({"force": [(1, 0, 0)]}, fixed=fixed))[0]
    result = quick({"force": [(1, 0, 0), (3e38, 0, 0)]}, fixed=fixed)
    bad = result.rows[1]
    assert values(result)[0] == good | {"run": 0}
    assert bad["status"] == "non-finite" and "body 1 (ball)" in bad["reason"]
    assert bad["drift"] is None and result.failed == [bad]
    assert np.isnan(result.column("drift")[1])


def test_metrics_can_be_functions_and_files(tmp_path):
    def measured_speed(sim):
        return np.linalg.norm(sim.get("linear_velocity")[:, 1], axis=-1)

    (tmp_path / "mine.py").write_text(
        "import numpy as np\n\n\ndef _helper(sim):\n    return 1 / 0\n\n\n"
        "def place(sim):\n    return sim.get('position')[:, 1]\n"
    )
    axes = {"speed": [1.0, 2.0], "gravity": [(0, 0, 0)]}
    rows = quick(axes, metrics=[measured_speed, str(tmp_path / "mine.py"), "drift"]).rows
    assert [row["measured_speed"] for row in rows] == [1.0, 2.0]
    assert rows[1]["place"] == pytest.approx([0.2, 0, 1])


def test_a_metric_that_fails_gives_rows_with_the_reason():
    rows = quick({"height": [1.0, 2.0]}, metrics=[lambda sim: 3.0]).rows
    assert [row["status"] for row in rows] == ["error"] * 2
    assert "must return (2,) or (2, n) values, got shape ()" in rows[0]["reason"]


def test_a_batch_that_does_not_fit_is_halved(monkeypatch):
    inner = batch_module._run

    def small_memory(job, prepared, start, on_done):
        if len(prepared.runs) > 2:
            raise RuntimeError("Failed to allocate 123 bytes on device")
        return inner(job, prepared, start, on_done)

    axes = {"height": [1.0, 2.0, 3.0, 4.0, 5.0]}
    expected = values(quick(axes))
    monkeypatch.setattr(batch_module, "_run", small_memory)
    result = quick(axes)
    assert values(result) == expected
    assert [row["environment"] for row in result.rows] == [0, 1, 2, 3, 4]


def test_a_value_that_is_refused_late_fails_its_own_runs_only(monkeypatch):
    """Such as an event of a scene that sets a mass: nothing can check it before the simulator is there."""
    inner = batch_module.set_each

    def particular(sim, name, values):
        if 4.0 in values:
            raise ValueError("friction: must not be 4")
        inner(sim, name, values)

    monkeypatch.setattr(batch_module, "set_each", particular)
    result = quick({"friction": [1.0, 2.0, 3.0, 4.0, 5.0]})
    assert [row["status"] for row in result.rows] == ["ok", "ok", "ok", "error", "ok"]
    assert result.rows[3]["reason"] == "ValueError: friction: must not be 4"


def test_only_rows_and_numbers_of_runs_are_replayed():
    result = quick({"height": [1.0, 2.0, 3.0]}, shard=(2, 2))
    for row in (result.rows[0], 1, np.int64(1)):
        assert result.replay(row).get("position")[0, 1, 2] == 2.0
    for row in (0, 1.0, True, "1"):
        with pytest.raises(ValueError, match=f"^row: must be one of the rows or the number of a run, 1, got {row!r}$"):
            result.replay(row)


def test_a_velocity_of_zero_stands_beside_vectors():
    rows = quick({"linear_velocity[ball]": [0, (1.0, 0.0, 0.0)], "gravity": [(0, 0, 0)]}, **POSES).rows
    assert [row["final_position"][3] for row in rows] == pytest.approx([0.0, 0.1], abs=1e-6)


def test_a_run_that_needs_too_much_has_status_capacity(monkeypatch):
    monkeypatch.setattr("warp_rigid.engine.memory.device_memory", lambda device: (2**40, 10_000))
    rows = quick({"height": [1.0, 2.0]}, batch=2).rows
    assert [row["status"] for row in rows] == ["capacity"] * 2 and "are free" in rows[0]["reason"]


def test_events_and_outcomes_belong_to_their_own_scene():
    class Outcome:
        def __init__(self, scene):
            self.start = scene.bodies[1].position[2]

        def observe(self, sim):
            assert sim.get("position").shape[0] == sim.num_envs

        def verdicts(self, sim):
            climbed = sim.get("position")[:, 1, 2] - self.start
            return [wr.scenes.Verdict("climbed", climbed, "climbs", climbed > 0, {})]

    def events(scene):
        speed = scene.bodies[1].position[2]
        return [(0.0, lambda sim: sim.set("linear_velocity", (0, 0, speed), bodies=[1]))]

    demo = Demo("thrown", "", ball, Outcome, 0.1, {}, events=events)
    axes = {"height": [2.0, 3.0], "gravity": [(0, 0, 0), (0, 0, -100.0)]}
    rows = quick(axes, demo, metrics=["outcome"]).rows
    assert [row["outcome_climbed_ok"] for row in rows] == [True, False, True, False]
    assert [rows[i]["outcome_climbed"] for i in (0, 2)] == pytest.approx([0.2, 0.3], abs=1e-5)


def test_repeats_have_their_own_seeds():
    result = quick({"count": [2]}, repeats=3, seed=7, **POSES)
    assert result.column("seed").tolist() == [7, 8, 9]
    places = [row["final_position"][6] for row in result.rows]
    assert places == pytest.approx([2.007, 2.008, 2.009], abs=1e-6)
    drawn = quick({"height": wr.Uniform(1, 2)}, repeats=4, seed=3)
    assert len(set(drawn.column("height").tolist())) == 4
    assert values(quick({"height": wr.Uniform(1, 2)}, repeats=4, seed=3)) == values(drawn)
    twice = quick({"height": [1.0, 1.0]})
    assert len(twice) == 2 and len({row["id"] for row in twice.rows}) == 2


def test_scenes_come_in_five_forms(tmp_path):
    (tmp_path / "mine.py").write_text(
        "import warp_rigid as wr\n\n\ndef scene(height=1.0):\n    made = wr.Scene()\n"
        "    made.add_body(wr.Sphere(0.1), position=(0, 0, height))\n    return made\n"
    )
    for scene in (str(tmp_path / "mine.py"), ball, ball(), scenes.get("incline"), "incline"):
        rows = quick({"friction": [0.1, 0.5]}, scene, duration=0.02).rows
        assert [row["status"] for row in rows] == ["ok", "ok"]
    ids = [resolve_scene(scene)[1] for scene in (ball(), ball(height=2.0), ball(), ball, "incline")]
    assert len(set(ids)) == 4 and ids[0] == ids[2]


@pytest.mark.parametrize("suffix", [".py", ".usda"])
def test_the_id_of_a_scene_in_a_file_depends_on_its_content(tmp_path, suffix):
    path, ids = tmp_path / f"scene{suffix}", []
    for height in (1.0, 2.0, 1.0):
        if suffix == ".py":
            path.write_text(f"import warp_rigid as wr\ndef scene():\n    return wr.Scene(gravity=(0, 0, -{height}))\n")
        else:
            wr.export_usd(wr.record(wr.Simulator(ball(height), device="cpu"), frames=0), path)
        ids.append(resolve_scene(path)[1])
    assert ids[0].startswith("scene:") and ids[0] == ids[2] != ids[1]


@pytest.mark.parametrize(
    ("axes", "options", "message"),
    [
        ({"heigth": [1]}, {}, "axis heigth: unknown name; did you mean height"),
        ({"friction": [-1.0]}, {}, "friction: must be a finite number >= 0"),
        ({"restitution": [2.0]}, {}, "restitution: must be a number from 0 to 1"),
        ({"mass[ball]": [0.0]}, {}, r"mass\[ball\]: must be a number from 1e-17 to 1e\+15, got 0"),
        ({"mass[ball]": [1.0, 0.0], "speed": [0.5]}, {}, r"^run 1 \(mass\[ball\]=0.0, speed=0.5\): mass"),
        ({"speed": [0.5, np.inf]}, {}, r"^run 1 \(speed=inf\): linear_velocity: must be"),
        ({"mass[ground]": [1.0]}, {}, r"mass\[ground\]: ground is not dynamic and has no mass"),
        ({"mass[ball]": [1.0, 1e8], "count": [2]}, {}, "the heaviest dynamic body must have at most"),
        ({"mass": [1.0, 1e8], "count": [2]}, {}, "the heaviest dynamic body must have at most"),
        ({"linear_velocity[ground]": [(1, 0, 0)]}, {}, "must be 0 for ground, which is static"),
        ({"gravity": [-9.81]}, {}, "gravity: must be vectors of 3 numbers, got -9.81"),
        ({"active[ball]": [1]}, {}, "must be True or False, got 1"),
        ({"mass[cone]": [1.0]}, {}, r"mass\[cone\]: selects no body; bodies are ground, ball"),
        ({"dt[ball]": [0.1]}, {}, "cannot select bodies"),
        ({"shock_propagation": ["on"]}, {}, "shock_propagation: must be one of"),
        ({"count": [1, 0.5]}, {}, "'float' object cannot be interpreted|count"),
        ({"height": [1]}, {"duration": 0.0}, "duration: must be"),
        ({"height": [1]}, {"batch": 0}, "batch: must be"),
        ({"height": [1]}, {"metrics": ["speed"]}, "metrics: must be"),
        ({"height": [1]}, {"metrics": ["drift", "drift"]}, "drift is given twice"),
        ({"height": [1]}, {"fixed": {"widht": 1}}, "^fixed widht: unknown"),
        ({"heigt": [1]}, {}, "^axis heigt: unknown"),
        ({"height": [1]}, {"shard": (3, 2)}, "shard: must be"),
        ({"height": [1]}, {"output": "a.csv"}, "output: must end in .parquet, got a.csv; for CSV use"),
        ({"height": [1]}, {"trajectories": "a.h5"}, "trajectories: must end in .zarr"),
    ],
)
def test_mistakes_are_named_before_anything_runs(axes, options, message, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(batch_module, "_run", lambda *_: pytest.fail("it ran"))
    with pytest.raises((ValueError, TypeError), match=message):
        quick(axes, **options)
    assert list(tmp_path.iterdir()) == []


def test_tower_falls_where_statics_says_except_for_one_pass():
    """Ten boxes, each shifted by d of a width w: all balance while N d <= w, that is d <= 0.1."""
    axes = {"offset": [0.08, 0.13], "shock_propagation": ["off", "one_pass", "two_pass"]}
    result = wr.sweep("leaning_tower", axes, device="cpu", metrics=["toppled", "outcome"])
    toppled = {(row["offset"], row["shock_propagation"]): row["toppled"] for row in result.rows}
    assert toppled == {
        (0.08, "off"): False, (0.08, "one_pass"): False, (0.08, "two_pass"): False,
        (0.13, "off"): True, (0.13, "one_pass"): False, (0.13, "two_pass"): True,
    }  # fmt: skip
    # What the scene sets besides is told in the rows, and yields to what the user says.
    assert [row["warm_starting"] for row in result.rows] == [True, False, True] * 2
    assert [row["outcome_moved_ok"] for row in result.rows] == [True, True, True, True, False, True]
    told = wr.sweep("leaning_tower", axes, device="cpu", duration=0.01, fixed={"warm_starting": True})
    assert "warm_starting" not in told.rows[0] and told.rows[0]["contact_iterations"] == 40
