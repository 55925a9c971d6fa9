"""Warnings: what is wrong although all numbers are finite, and what looks alike and is right."""

import json

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid.commands import cli
from warp_rigid.engine import health_checks

HALF = 0.1
CUBE = wr.Box((HALF,) * 3)


def found(sim):
    """The warnings as (warning, body)."""
    return [(str(record["warning"]), int(record["body"])) for record in sim.warnings()]


def squeezed():
    """A cube between a floor and a ceiling whose distance is three quarters of its height."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    scene.add_static(wr.Plane(normal=(0, 0, -1), offset=-1.5 * HALF))
    scene.add_body(CUBE, position=(0, 0, 0.75 * HALF))
    return scene


def tower(ratio, count=8, gap=0.0):
    """Cubes of which every second one is heavier, and the gaps below them [m]."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    for k in range(count):
        place = (0, 0, HALF + 2 * HALF * k + gap * (k + 1))
        scene.add_body(CUBE, position=place, mass=ratio if k % 2 else 1.0)
    return scene


def test_an_overlap_that_does_not_shrink_is_reported(device):
    sim = wr.Simulator([squeezed(), tower(1.0, 3)], device=device)
    sim.step(960)
    assert found(sim) == [("overlap", 2)]
    (record,) = sim.warnings()
    assert record["env"] == 0 and record["step"] % health_checks.EVERY == 0
    assert record["time"] == record["step"] * sim.settings.dt
    status = sim.status()
    assert status["warning"].tolist() == ["overlap", ""] and status["status"].tolist() == ["ok", "ok"]


def test_an_overlap_that_is_pushed_apart_is_not(device):
    scene = wr.Scene(gravity=(0, 0, 0))
    for x in (0.0, 0.5 * HALF):
        scene.add_body(CUBE, position=(x, 0, 0))
    sim = wr.Simulator(scene, device=device)
    assert sim.penetration()[0] > HALF
    sim.step(480)
    assert sim.penetration()[0] < 0.01 * HALF and found(sim) == []


@pytest.mark.parametrize("ratio, expected", [(1e3, set()), (7e4, {"load"})])
def test_a_tower_of_unequal_masses_stands_or_is_reported(device, ratio, expected):
    sim = wr.Simulator(tower(ratio), device=device)
    sim.step(960)
    start = np.array([HALF + 2 * HALF * k for k in range(8)])
    stands = np.abs(sim.get("position")[0, 1:, 2] - start).max() < 0.01 * HALF
    warned = {warning for warning, _ in found(sim)}
    assert expected <= warned and stands == (not warned)


def test_towers_of_very_unequal_masses_are_all_reported(device):
    """How such a tower falls hangs on rounding: each is reported, for its load or for the energy that it gains."""
    ratios = (2e5, 3e5, 5e5, 6e5, 8e5, 1e6)
    sim = wr.Simulator([tower(ratio) for ratio in ratios], device=device)
    sim.step(960)
    warned = {(int(record["env"]), str(record["warning"])) for record in sim.warnings()}
    assert {env for env, _ in warned} == set(range(len(ratios)))
    assert "energy" in {warning for _, warning in warned}


def test_loads_that_last_a_few_steps_are_reported(device):
    """Towers that fall into place burst between two checks: these four were not reported."""
    towers = [(1e6, 1e-4), (1e5, 0.01), (3e5, 0.05), (9e5, 0.05)]
    sim = wr.Simulator([tower(ratio, gap=gap) for ratio, gap in towers], device=device)
    sim.step(960)
    assert (sim.get("position")[:, 8, 2] < 10 * HALF).all()
    assert {int(record["env"]) for record in sim.warnings() if record["warning"] == "load"} == set(range(len(towers)))


def test_loads_are_checked_in_every_step_only_where_masses_allow_them(device):
    """A mass that is set counts, too."""
    sim = wr.Simulator(tower(1e3, 3), device=device)
    shards = list(sim._world.shards)
    assert not any(shard._overload for shard in shards)
    sim.set("mass", 5e5, bodies=[2])
    assert all(shard._overload for shard in shards)


def test_positions_too_coarse_for_a_body_are_reported(device):
    """In single precision, positions at 1e4 m are 1 mm apart."""
    scene = wr.Scene(gravity=(0, 0, 0))
    for number, half in enumerate(((0.3,) * 3, (0.05,) * 3, (0.3, 0.3, 1e-4), (0.3, 0.3, 1e-2))):
        scene.add_body(wr.Box(half), position=(1e4, 2.0 * number, 0))
    sims = []
    for body in range(4):
        sims.append(wr.Simulator(scene, device=device))
        sims[-1].set("active", False, bodies=[other for other in range(4) if other != body])
        sims[-1].step(health_checks.EVERY)
    assert [found(sim) for sim in sims] == [[], [("precision", 1)], [("precision", 2)], []]


def work_scene(**options):
    scene = wr.Scene(gravity=(0, 0, 0), **options)
    scene.add_body(CUBE, position=(0, 0, 0))
    return scene


def by_force(sim):
    sim.set("force", (50.0, 0, 0))
    sim.set("torque", (3.0, 2.0, 1.0))


def by_fields(sim):
    sim.set("gravity", (0, 3.0, -9.81))


def by_velocity(sim):
    sim.set("linear_velocity", (30.0, 0, 0))
    sim.set("angular_velocity", (30.0, 5, 1))


def by_array(sim):
    sim.array("linear_velocity").fill_(30.0)


def by_impulse(sim):
    sim.apply_impulse((20.0, 5.0, 0), (0.05, 0.02, 0), 0)


@pytest.mark.parametrize("change", [by_force, by_fields, by_velocity, by_array, by_impulse])
def test_energy_that_a_user_gives_is_not_reported(device, change):
    sim = wr.Simulator(work_scene(), device=device)
    sim.step(100)
    change(sim)
    sim.step(400)
    change(sim)
    sim.step(400)
    assert sim.get("kinetic_energy").sum() > 10.0 and found(sim) == []


def test_energy_that_a_kinematic_body_gives_is_not_reported(device):
    """A moving wall hits a ball: it is a bat."""
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_kinematic(wr.Box((0.1, 0.5, 0.5)), position=(-1, 0, 0), linear_velocity=(10, 0, 0), restitution=1.0)
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 0), restitution=1.0)
    sim = wr.Simulator(scene, device=device)
    sim.step(300)
    assert sim.get("linear_velocity")[0, 1, 0] > 15.0 and found(sim) == []


def test_the_energy_gained_without_work_is_that_of_the_motion(device):
    """What is recorded equals the change of the kinetic energy plus that of the potential energy, in float64."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), friction=0.5)
    scene.add_body(wr.Box((0.1, 0.2, 0.05)), position=(0, 0, 1), angular_velocity=(3, 2, 1), friction=0.5)
    sim = wr.Simulator(scene, device=device)

    def energy():
        return float(sim.get("kinetic_energy").sum() + sim.get("potential_energy")[0, 1])

    def gained():
        return float(sim._world.state.health.numpy()[1, 0])

    before = energy()
    sim.step(40)  # in the air
    assert gained() == pytest.approx(0.0, abs=1e-5 * before)
    sim.step(800)
    assert sim.get("kinetic_energy").sum() < 1e-6
    assert gained() == pytest.approx(energy() - before, rel=0.02)


def test_warnings_survive_a_checkpoint_and_end_with_a_reset(device, tmp_path):
    sim = wr.Simulator(squeezed(), num_envs=2, device=device)
    sim.step(960)
    sim.save(tmp_path / "a.ckpt")
    again = wr.Simulator.load(tmp_path / "a.ckpt", device=device)
    assert again.warnings().tolist() == sim.warnings().tolist() != []
    sim.reset(envs=[0])
    assert sim.status()["warning"].tolist() == ["", "overlap"]
    sim.reset()
    assert len(sim.warnings()) == 0


def test_warnings_do_not_depend_on_how_steps_are_counted_or_repeated(device):
    """Single steps, growing pools that repeat steps, and one call."""
    whole = wr.Simulator(squeezed(), device=device)
    whole.step(700)
    single = wr.Simulator(squeezed(), device=device, capacity={"pairs": 1, "contacts": 1})
    for _ in range(70):
        single.step(10)
    assert whole.warnings().tolist() == single.warnings().tolist() != []
    assert whole._world.state.health.numpy().tobytes() == single._world.state.health.numpy().tobytes()


def test_a_sweep_tells_what_the_warning_is(device):
    def scene(height: float):
        made = wr.Scene()
        made.add_static(wr.Plane())
        made.add_static(wr.Plane(normal=(0, 0, -1), offset=-height))
        made.add_body(CUBE, position=(0, 0, 0.5 * height))
        return made

    table = wr.sweep(scene, {"height": [0.15, 0.5]}, duration=4.0, device=device)
    assert [(row["status"], row["reason"]) for row in table.rows] == [("ok", "warning: overlap"), ("ok", None)]


def test_the_command_prints_warnings(capsys, tmp_path):
    path = tmp_path / "squeezed.py"
    path.write_text(
        "import warp_rigid as wr\n"
        "def scene():\n"
        "    made = wr.Scene()\n"
        "    made.add_static(wr.Plane())\n"
        "    made.add_static(wr.Plane(normal=(0, 0, -1), offset=-0.15))\n"
        "    made.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.075))\n"
        "    return made\n"
    )
    assert cli.main(["run", str(path), "--frames", "240", "--device", "cpu", "--json"]) == 0
    (warning,) = json.loads(capsys.readouterr().out)["warnings"]
    assert (warning["env"], warning["warning"], warning["body"]) == (0, "overlap", 2)
    assert cli.main(["run", str(path), "--frames", "240", "--device", "cpu"]) == 0
    line = f"environment 0: warning: overlap since step {warning['step']}, body 2"
    assert line in capsys.readouterr().out


def test_energy_that_a_motor_gives_is_not_reported(device):
    scene = wr.Scene(gravity=(0, 0, 0))
    scene.add_body(CUBE, name="wheel")
    axle = scene.add_joint(wr.RevoluteJoint(axis=(0, 0, 1)), "wheel")
    scene.add_drive(axle, damping=10.0, target_velocity=50.0)
    sim = wr.Simulator(scene, device=device)
    sim.step(600)
    assert sim.get("angular_velocity")[0, 0, 2] > 40.0 and found(sim) == []
