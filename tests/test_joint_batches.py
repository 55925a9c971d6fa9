"""Joints in batches of different scenes, with growing pools, in heaps, and chosen by name."""

import numpy as np
import pytest

import warp_rigid as wr
from tests.test_joints import G, anchor_errors, simulator, tumbling
from warp_rigid.sweep.job import structure

HALF = 0.1


def hanging(links):
    """Capsules below each other on ball joints, with a motor in the uppermost one."""
    scene = wr.Scene(gravity=(0, 0, -G))
    above = None
    for k in range(links):
        body = scene.add_body(wr.Capsule(0.02, 0.05), position=(0.1 * k, 0, 3), name=f"link_{k}")
        joint = wr.RevoluteJoint((0, 1, 0)) if k == 0 else wr.SphericalJoint()
        scene.add_joint(joint, body, above, anchor=(0.1 * k - 0.05, 0, 3), name=f"joint_{k}")
        above = body
    scene.add_drive(0, stiffness=2.0, damping=0.1, max_force=5.0)
    return scene


def falling(count=2):
    """Boxes above a plane, without joints."""
    scene = wr.Scene(gravity=(0, 0, -G))
    scene.add_static(wr.Plane(), name="ground")
    for k in range(count):
        scene.add_body(wr.Box((HALF,) * 3), position=(0, 0.02 * k, 0.15 + 0.25 * k), name=f"box_{k}")
    return scene


def dragging():
    """Two boxes on the ground, and a third that a weld holds to one of them."""
    scene = falling()
    body = scene.add_body(wr.Box((HALF,) * 3), position=(0.25, 0, 0.15), name="welded", linear_velocity=(2, 0, 0))
    scene.add_joint(wr.FixedJoint(), body, "box_0", anchor=(0.125, 0, 0.15), name="weld")
    return scene


def test_environments_with_and_without_joints_have_the_bits_of_their_own_batches(device):
    made = [hanging(3), falling(), dragging(), tumbling(), hanging(6)]
    mixed = simulator(made, device, num_envs=4)
    mixed.step(120)
    for index, scene in enumerate(made):
        alone = simulator(scene, device)
        alone.step(120)
        bodies, joints = len(scene.bodies), len(scene.joints)
        for env in range(index, mixed.num_envs, len(made)):
            for name in ("position", "orientation", "linear_velocity", "angular_velocity"):
                assert mixed.get(name)[env, :bodies].tobytes() == alone.get(name)[0].tobytes(), (index, name)
            for name in ("joint_position", "joint_velocity", "joint_force", "joint_stiffness"):
                values = mixed.get(name)[env]
                assert values[:joints].tobytes() == alone.get(name)[0].tobytes(), (index, name)
                assert np.isnan(values[joints:]).all()
            assert not mixed.get("joint_broken")[env].any()


@pytest.mark.parametrize("own", [0, 1, 2])
@pytest.mark.parametrize("mode", ["one_pass", "two_pass"])
def test_repetitions_of_shock_propagation_in_others_change_nothing(device, own, mode):
    """Their number is one of the settings that can differ between environments."""
    ends = []
    for others in (own, 3):
        sim = simulator(dragging(), device, num_envs=2)
        sim.set("shock_propagation", mode)
        sim.set("shock_iterations", [own, others])
        sim.step(60)
        ends.append(b"".join(sim.get(name)[0].tobytes() for name in ("position", "linear_velocity", "joint_force")))
    assert ends[0] == ends[1]


def test_joints_are_chosen_by_name(device):
    other = hanging(2)
    other.joints.insert(0, other.joints.pop())
    sim = simulator([hanging(3), other], device)
    sim.set("joint_target_position", [[0.25]], joints="joint_0")
    assert np.nan_to_num(sim.get("joint_target_position")).tolist() == [[0.25, 0, 0], [0, 0.25, 0]]
    for call, text in (
        (lambda: sim.set("joint_broken", True, joints="elbow"), "joints: must be names of joints of scene 0"),
        (lambda: sim.set("joint_broken", True, joints=[2]), "joints: must be indices from 0 to 1 of scene 1"),
        (lambda: sim.set("joint_broken", True, bodies=[0]), "bodies: must not be given for joint_broken"),
        (lambda: sim.set("mass", 1.0, joints=[0]), "joints: must not be given for mass"),
    ):
        with pytest.raises(ValueError, match=text):
            call()
    with pytest.raises(ValueError, match="joints: there are no joints in the scene"):
        simulator(falling(), device).set("joint_broken", True, joints=[0])
    with pytest.raises(ValueError, match="joint_broken: the scene has no joints"):
        simulator(falling(), device).set("joint_broken", True)


def test_a_name_that_is_taken_gets_a_number():
    scene = hanging(2)
    again = scene.add_joint(wr.FixedJoint(), "link_0", anchor=(0, 0, 3), name="joint_1")
    assert scene.joints[again].name == "joint_1_1"


def pair_of_islands():
    """Two boxes at rest beside each other, joined by a string."""
    scene = wr.Scene(gravity=(0, 0, -G))
    scene.add_static(wr.Plane(), name="ground")
    for x in (0.0, 0.5):
        scene.add_body(wr.Box((HALF,) * 3), position=(x, 0, HALF))
    scene.add_joint(wr.DistanceJoint(maximum=0.5), 1, 2, anchor=(0, 0, HALF), anchor_b=(0.5, 0, HALF))
    return scene


def test_a_broken_joint_divides_the_island_of_bodies_at_rest(device):
    """Their contacts do not change, so the graph of the last step would be used again."""
    sim = simulator(pair_of_islands(), device)
    sim.step(20)
    assert sim.stats()["islands"].tolist() == [1]
    sim.set("joint_broken", True)
    sim.step()
    assert sim.stats()["islands"].tolist() == [2]
    sim.set("joint_broken", False)
    sim.step()
    assert sim.stats()["islands"].tolist() == [1]
    sim.set("joint_break_force", 1.0)
    sim.step(20)
    sim.set("force", [[[0, 0, 0], [0, 0, 0], [60.0, 0, 0]]])
    sim.step(2)
    assert sim.get("joint_broken").all()
    sim.set("force", 0)
    sim.step(60)
    assert sim.stats()["islands"].tolist() == [2]


def heap(joined):
    """A crowded environment: 160 boxes fall into a heap, pairs of them welded."""
    scene = wr.Scene(gravity=(0, 0, -G))
    scene.add_static(wr.Plane(), friction=0.5, name="ground")
    for x, y in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        scene.add_static(wr.Box((0.1, 0.9, 2) if x else (0.9, 0.1, 2)), position=(0.9 * x, 0.9 * y, 2))
    for k in range(160):
        cell = np.array([k % 6, k // 6 % 4, k // 24])
        at = (0.24 * (cell[0] - 2.5), 0.26 * (cell[1] - 1.5), 0.2 + 0.23 * cell[2])
        body = scene.add_body(wr.Box((HALF,) * 3), position=at, friction=0.5)
        if joined and k % 2:
            scene.add_joint(wr.FixedJoint(), body, body - 1, anchor=(at[0] - 0.12, at[1], at[2]))
    return scene


@pytest.mark.long
def test_contacts_and_joints_of_a_heap_are_solved_together(device):
    """Welded pairs in a heap come to rest, as deep in each other as loose boxes, and no weld opens."""
    sim = simulator(heap(True), device)
    sim.step(720)
    assert anchor_errors(sim).max() < 1e-6
    assert np.linalg.norm(sim.get("linear_velocity"), axis=-1).max() < 0.02
    assert sim.penetration()[0] < 1e-3
    assert sim.stats()["islands_rounds"].tolist() == [0]


def test_a_heap_beside_a_mechanism_is_solved_in_rounds(device):
    """Only the island of the joint keeps sweeps."""
    scene = heap(False)
    arm = scene.add_body(wr.Capsule(0.02, 0.1), position=(5, 0, 1))
    scene.add_joint(wr.SphericalJoint(), arm, anchor=(4.9, 0, 1))
    sim = simulator(scene, device)
    sim.step(120)
    assert sim.stats()["islands_rounds"][0] >= 1
    assert anchor_errors(sim).max() < 1e-6


def swing(length: float = 0.5, hinges: int = 1):
    """A driven arm; with a second hinge, another arm at its end."""
    scene = wr.Scene(gravity=(0, 0, 0))
    arm = scene.add_body(wr.Box((length / 2, 0.05, 0.05)), position=(length / 2, 0, 0), mass=1.0, name="arm")
    shoulder = scene.add_joint(wr.RevoluteJoint((0, 0, 1)), arm, name="shoulder")
    scene.add_drive(shoulder, stiffness=40.0, damping=8.0)
    if hinges == 2:
        hand = scene.add_body(wr.Sphere(0.05), position=(length + 0.05, 0, 0), mass=0.1, name="hand")
        scene.add_joint(wr.FixedJoint(), hand, arm, anchor=(length, 0, 0), name="wrist")
    return scene


def test_quantities_of_joints_are_axes_and_columns_of_sweeps():
    axes = {"hinges": [1, 2], "joint_target_position[shoulder]": [0.25, -0.5], "joint_break_force[wr*]": [1e6]}
    with pytest.raises(ValueError, match=r"joint_break_force\[wr\*\]: selects no joint; joints are shoulder"):
        wr.sweep(swing, axes, duration=0.1, metrics=["drift"], device="cpu")
    del axes["joint_break_force[wr*]"]
    observe = ["joint_position[shoulder]", "joint_force[wrist]"]
    result = wr.sweep(swing, axes, duration=4.0, metrics=["drift"], device="cpu", observe=observe)
    assert not result.failed
    for row in result.rows:
        aim = row["joint_target_position[shoulder]"]
        assert row["joint_position[shoulder]"] == pytest.approx(aim, abs=1e-4)
    with pytest.raises(ValueError, match="joint_damping: must be finite numbers >= 0"):
        wr.sweep(swing, {"joint_damping[shoulder]": [-1.0]}, duration=0.1, metrics=["drift"], device="cpu")


def test_scenes_of_a_sweep_with_the_same_bodies_are_checked_for_their_own_joints():
    def door(hinged: bool):
        scene = wr.Scene()
        box = scene.add_body(wr.Box((0.1, 0.1, 0.1)), name="door")
        if hinged:
            scene.add_joint(wr.RevoluteJoint((0, 0, 1)), box, name="hinge")
        return scene

    options = {"duration": 0.05, "metrics": [], "device": "cpu"}
    result = wr.sweep(door, {"hinged": [False, True]}, observe=["joint_force[hinge]"], **options)
    free, hinged = result.rows
    assert np.isnan(free["joint_force[hinge]"]).all() and np.isfinite(hinged["joint_force[hinge]"]).all()
    with pytest.raises(ValueError, match="selects no joint"):
        wr.sweep(door, {"hinged": [True, False], "joint_damping[hinge]": [0.1]}, **options)


def test_scenes_that_differ_in_joints_have_different_structures():
    assert structure(swing()) == structure(swing())
    changed = swing()
    changed.add_drive(0, stiffness=41.0, damping=8.0)
    assert structure(changed) != structure(swing())
