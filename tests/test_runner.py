"""Runs of scenes: settings reach their environments, events their times, outcomes their frames."""

import dataclasses

import numpy as np
import pytest

from tests.fakes import FakeSimulator
from warp_rigid import Box, Plane, Scene, scenes
from warp_rigid.runs.runner import Plan, execute, find_scene, plan_run
from warp_rigid.scenes import Demo, Verdict
from warp_rigid.scenes.demo import OverlapOutcome


def small_scene(boxes: int = 2, seed: int = 7) -> Scene:
    scene = Scene()
    scene.add_static(Plane(), name="ground")
    for i in range(boxes):
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1 + 0.2 * i), name=f"seed_{seed}")
    return scene


class Witness:
    """An outcome that notes when it was asked."""

    def __init__(self, scene):
        self.times = []

    def observe(self, sim):
        self.times.append(sim.time)

    def verdicts(self, sim):
        values = np.arange(sim.num_envs, dtype=float)
        expected = {"default": True, "off": False}
        return [Verdict("rank", values, "rank < 1", values < 1, expected)]


DEMO = Demo(
    name="small",
    summary="two boxes",
    build=small_scene,
    outcome=Witness,
    duration=0.1,
    variants={"default": {}, "off": {"shock_propagation": "off", "contact_iterations": 3}},
    settings={"collision_iterations": 6},
)


def run_fake(demo, frames=6, num_envs=2, envs=None):
    """Run a demo on the stand-in simulator, whose steps are counted."""
    scene = demo.build()
    sim = FakeSimulator(scene, num_envs)
    names = tuple(demo.variants)
    plan = Plan(demo, scene, sim, names, names, 60.0, frames, {})
    return sim, execute(plan, envs)


def test_events_come_at_their_times_even_inside_a_frame():
    fired = []

    def events(scene):
        # Given out of order; the second lies between two frames, the third between two steps.
        times = (0.05, 0.0, 0.05 + 2 / 240, 0.0701)
        return [(time, lambda sim, time=time: fired.append((time, sim.steps))) for time in times]

    sim, _ = run_fake(dataclasses.replace(DEMO, events=events))
    assert fired == [(0.0, 0), (0.05, 12), (0.05 + 2 / 240, 14), (0.0701, 17)]
    assert sim.steps == 24


def test_outcome_observes_every_frame_once():
    witness = []
    demo = dataclasses.replace(DEMO, outcome=lambda scene: witness.append(Witness(scene)) or witness[0])
    run_fake(demo)
    np.testing.assert_allclose(witness[0].times, np.arange(1, 7) / 60.0)


class Judge(OverlapOutcome):
    """An outcome that judges the overlap."""

    def verdicts(self, sim):
        return self.overlap_verdicts(sim, 0.1, 0.1)


def test_the_overlap_of_a_frame_is_measured_once(monkeypatch):
    """It takes most of the time of a run with meshes."""
    measured = []
    penetration = FakeSimulator.penetration
    monkeypatch.setattr(FakeSimulator, "penetration", lambda sim: measured.append(sim.steps) or penetration(sim))
    _, result = run_fake(dataclasses.replace(DEMO, outcome=Judge))
    assert measured == [4, 8, 12, 16, 20, 24, 24, 24]  # in each frame, for the verdicts and for the summary
    assert result.summary["deepest_penetration"] == [0.024, 0.024]


def test_summary_holds_verdicts_and_what_is_expected():
    _, result = run_fake(DEMO)
    summary = result.summary
    assert summary["verdicts"] == [
        {
            "name": "rank",
            "limit": "rank < 1",
            "unit": "",
            "values": [0.0, 1.0],
            "passed": [True, False],
            "expected": [True, False],
        }
    ]
    assert summary["deepest_penetration"] == [0.024, 0.024]
    assert (summary["frames"], summary["envs"], summary["bodies"]) == (6, 2, 3)
    assert summary["time"] == pytest.approx(0.1)
    assert summary["failed"] == []


def test_recording_holds_the_chosen_environments():
    _, result = run_fake(DEMO, envs=[1])
    assert result.recording.envs.tolist() == [1]
    assert result.recording.labels == ("off",)
    assert result.recording.position.shape == (7, 1, 3, 3)


def test_compare_gives_each_variant_its_environment():
    plan = plan_run(DEMO, compare=True, device="cpu")
    assert plan.labels == plan.variants == ("default", "off")
    assert plan.sim.get("shock_propagation").tolist() == ["two_pass", "off"]
    assert plan.sim.get("contact_iterations").tolist() == [10, 3]
    assert plan.sim.get("collision_iterations").tolist() == [6, 6]
    assert plan.frames == 6


def test_lists_give_each_environment_its_value():
    plan = plan_run(
        DEMO, ["friction=0.1,0.2,0.3", "warm_starting=false", "gravity=(0,0,-1),(0,0,-2),(0,0,-3)"], device="cpu"
    )
    assert plan.sim.num_envs == 3
    np.testing.assert_allclose(plan.sim.get("friction"), [[0.1] * 3, [0.2] * 3, [0.3] * 3], rtol=1e-6)
    assert plan.sim.get("warm_starting").tolist() == [False] * 3
    assert plan.sim.get("gravity")[:, 2].tolist() == [-1, -2, -3]
    assert plan.labels[1] == "friction=0.2, gravity=(0, 0, -2)"
    assert plan.variants == (None,) * 3


def test_one_value_reaches_all_dynamic_bodies():
    plan = plan_run(DEMO, ["mass=3", "linear_velocity=(1,0,0)", "boxes=3"], device="cpu")
    assert plan.sim.get("mass")[0].tolist() == [0, 3, 3, 3]
    assert plan.sim.get("linear_velocity")[0, :, 0].tolist() == [0, 1, 1, 1]


def test_bodies_are_chosen_by_name_pattern_or_index():
    build = dataclasses.replace(DEMO, build=named_scene)
    given = ["mass[left]=3", "mass[2]=4", "friction[*t]=0.1,0.2", "restitution[ground]=0.9"]
    plan = plan_run(build, given, device="cpu")
    assert plan.sim.get("mass")[1].tolist() == [0, 3, 4]
    np.testing.assert_allclose(plan.sim.get("friction"), [[0.5, 0.1, 0.1], [0.5, 0.2, 0.2]], rtol=1e-6)
    np.testing.assert_allclose(plan.sim.get("restitution")[0], [0.9, 0, 0], rtol=1e-6)
    changed = plan_run(build, ["mass[lef[st]]=5", "mass[righ[!x]]=6"], device="cpu").sim.get("mass")
    assert changed[0].tolist() == [0, 5, 6]
    assert plan_run(build, ["active[right]=false"], device="cpu").sim.get("active")[0].tolist() == [True, True, False]
    assert plan_run(build, ["position[left]=(0,0,5)"], device="cpu").sim.get("position")[0, 1].tolist() == [0, 0, 5]
    for text, message in (
        ("mass[up]=1", "selects no body; bodies are ground, left, right"),
        ("dt[left]=1", "cannot select"),
    ):
        with pytest.raises(ValueError, match=message):
            plan_run(build, [text], device="cpu")


def named_scene() -> Scene:
    scene = Scene()
    scene.add_static(Plane(), name="ground")
    for x, name in ((-1, "left"), (1, "right")):
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(x, 0, 0.1), name=name)
    return scene


def test_seed_reaches_the_scene_unless_it_is_set():
    assert plan_run(DEMO, seed=3, device="cpu").scene.bodies[1].name == "seed_3"
    assert plan_run(DEMO, device="cpu").scene.bodies[1].name == "seed_7"
    assert plan_run(DEMO, ["seed=4"], seed=3, device="cpu").scene.bodies[1].name == "seed_4"


def test_nothing_is_expected_of_a_run_cut_short():
    assert plan_run(DEMO, device="cpu").variants == ("default",)
    assert plan_run(DEMO, frames=3, device="cpu").variants == (None,)
    assert plan_run(DEMO, ["boxes=1"], device="cpu").variants == ("default",)


def test_substeps_set_the_time_step():
    plan = plan_run(DEMO, fps=50.0, substeps=3, device="cpu")
    assert plan.sim.settings.dt == pytest.approx(1 / 150)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "--envs: must be >= 1"),
        ({"num_envs": 3, "compare": True}, "--envs: must be 2, the number of values to compare, got 3"),
        ({"num_envs": 3, "assignments": ["friction=1,2"]}, "--envs: must be 2, the number of values to compare, got 3"),
        ({"compare": True, "assignments": ["mass=1,2"]}, "--compare: cannot be combined with a list for mass"),
        ({"substeps": 0}, "--substeps: must be >= 1"),
        ({"substeps": 4, "assignments": ["dt=0.01"]}, "--substeps: sets dt"),
        ({"fps": 100.0}, "fps: a frame must be a whole number of steps of dt"),
        ({"frames": -1}, "--frames: must be >= 0"),
        ({"assignments": ["dt=2"]}, "dt: must be"),
        ({"assignments": ["friction=-1"]}, "friction: must be"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError) as error:
        plan_run(DEMO, device="cpu", **arguments)
    assert message in str(error.value)


def test_scene_without_variants_cannot_be_compared():
    with pytest.raises(ValueError, match="--compare: small has no variants"):
        plan_run(dataclasses.replace(DEMO, variants={}), compare=True, device="cpu")


def test_scenes_are_found_by_name_or_file(tmp_path):
    assert find_scene("box_stack") is scenes.get("box_stack")
    with pytest.raises(ValueError, match=r"scene: must be a USD, MJCF or URDF file, a .py file .* got 'box_stak'"):
        find_scene("box_stak")
    with pytest.raises(FileNotFoundError):
        find_scene(str(tmp_path / "none.py"))
    (tmp_path / "mine.py").write_text(
        '"""My scene.\n\nMore.\n"""\n'
        "import warp_rigid as wr\n\n"
        "def scene(radius=0.1):\n"
        "    made = wr.Scene()\n"
        "    made.add_body(wr.Sphere(radius))\n"
        "    return made\n"
    )
    demo = find_scene(str(tmp_path / "mine.py"))
    assert (demo.name, demo.summary, demo.parameters) == ("mine", "My scene.", {"radius": 0.1})
    plan = plan_run(demo, ["radius=0.3"], frames=2, device="cpu")
    assert plan.scene.bodies[0].shape.radius == 0.3
    assert execute(plan).verdicts == []
    (tmp_path / "empty.py").write_text("")
    with pytest.raises(ValueError, match=r"empty.py: has no function scene"):
        find_scene(str(tmp_path / "empty.py"))
