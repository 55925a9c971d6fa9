"""Joints of UsdPhysics: every kind out and in again, and files by hand in other units and axes."""

import math

import numpy as np
import pytest

import warp_rigid as wr
from tests.usd_tools import moved, rigid, start_of, validator_errors, write_stage
from warp_rigid.scene.shapes import mass_properties

TURNED = (0.1, 0.2, 0.3, 0.9)


def joined():
    """A scene with every kind of joint."""
    scene = wr.Scene()
    ground = scene.add_static(wr.Plane(), name="ground")
    bodies = [
        scene.add_body(wr.Box((0.1, 0.2, 0.3)), position=(k, 0, 1), orientation=TURNED, name=f"box_{k}")
        for k in range(5)
    ]
    scene.add_joint(wr.FixedJoint(), bodies[0], ground, anchor=(0, 0, 0.5), break_force=100.0, break_torque=20.0)
    hinge = scene.add_joint(
        wr.RevoluteJoint((0, 1, 1), (-1.0, 0.5), 0.25),
        bodies[1],
        bodies[0],
        anchor=(0.5, 0, 1),
        name="elbow",
        armature=0.5,
    )
    scene.add_drive(hinge, stiffness=5.0, damping=0.5, max_force=3.0, target_position=0.25, target_velocity=0.1)
    slider = scene.add_joint(wr.PrismaticJoint((1, 0, 0), (-math.inf, 0.5)), bodies[2], bodies[1], anchor=(1.5, 0, 1))
    scene.add_drive(slider, damping=2.0)
    ball = scene.add_joint(wr.SphericalJoint(0.6, (0, 0, 1)), bodies[3], bodies[2], anchor=(2.5, 0, 1), collide=True)
    scene.add_drive(ball, damping=0.3)
    scene.add_joint(wr.DistanceJoint(maximum=1.0), bodies[4], bodies[3], anchor=(4, 0, 1), anchor_b=(3, 0, 1))
    scene.add_joint(wr.RevoluteJoint((0, 0, 1)), bodies[4], anchor=(4, 0, 2))
    return scene


def test_every_kind_comes_back_from_a_file(tmp_path):
    scene = joined()
    path = tmp_path / "joined.usda"
    wr.export_usd(start_of(scene), path, profile="scene")
    assert validator_errors(path) == []
    found = wr.import_usd(path, root="/World/env_0000")
    given, back = ({entry.name: entry for entry in some.joints} for some in (scene, found))
    assert back.keys() == given.keys()
    for name, entry in given.items():
        other = back[name]
        assert type(other.joint) is type(entry.joint)
        assert other.joint.range == pytest.approx(entry.joint.range, rel=1e-6)
        assert other.joint.resistance == entry.joint.resistance
        assert found.bodies[other.body_a].name == scene.bodies[entry.body_a].name
        assert (other.body_b is None) == (entry.body_b is None)
        for side in ("frame_a", "frame_b"):
            own, theirs = getattr(entry, side), getattr(other, side)
            assert theirs.position == pytest.approx(own.position, abs=1e-6)
            assert abs(np.dot(theirs.orientation, own.orientation)) == pytest.approx(1.0, abs=1e-6)
        assert (other.break_force, other.break_torque) == (entry.break_force, entry.break_torque)
        assert (other.collide, other.armature) == (entry.collide, entry.armature)
        assert (other.drive is None) == (entry.drive is None)
        if entry.drive is not None:
            assert list(vars(other.drive).values()) == pytest.approx(list(vars(entry.drive).values()), rel=1e-6)
    assert found.filtered_pairs == scene.filtered_pairs


def test_a_file_in_other_units_hangs_the_same_pendulum(tmp_path):
    """Centimetres, y up, axis Z, the world as the second body: the angle is that of the world relative to the body."""
    joint = (
        'def PhysicsRevoluteJoint "Hinge" (prepend apiSchemas = ["PhysicsDriveAPI:angular"]) {\n'
        " rel physics:body0 = </World/A>\n"
        " point3f physics:localPos0 = (0, 50, 0)\n point3f physics:localPos1 = (100, 250, 0)\n"
        ' uniform token physics:axis = "Z"\n float physics:lowerLimit = -90\n float physics:upperLimit = 45\n'
        " float drive:angular:physics:stiffness = 10000\n float drive:angular:physics:targetPosition = 30\n}\n"
    )
    body = rigid("A", "Cube", f"double size = 20; {moved(100, 200, 0)}")
    scene = wr.import_usd(write_stage(tmp_path / "hinge.usda", body + joint, up="Y", meters=0.01))
    (entry,) = scene.joints
    assert entry.body_a == 0 and entry.body_b is None
    assert entry.frame_a.position == pytest.approx((0, 0.5, 0))
    assert entry.frame_b.position == pytest.approx((1.0, 0.0, 2.5))
    assert entry.joint.limits == pytest.approx((-math.pi / 2, math.pi / 4))
    assert entry.drive.stiffness == pytest.approx(10000 * 1e-4 * 180 / math.pi)
    assert entry.drive.target_position == pytest.approx(math.pi / 6)


def test_a_disabled_joint_and_one_without_bodies_are_told(tmp_path):
    body = rigid("A", "Cube") + (
        'def PhysicsFixedJoint "Off" {\n rel physics:body0 = </World/A>\n bool physics:jointEnabled = 0\n}\n'
        'def PhysicsFixedJoint "Loose" {\n}\n'
    )
    scene = wr.import_usd(write_stage(tmp_path / "loose.usda", body))
    told = {finding.path: finding.reason for finding in scene.import_report.left_out}
    assert scene.joints == []
    assert told["/World/Off"] == "the joint is disabled"
    assert "/World/Loose" in told


@pytest.mark.parametrize(("axis", "found"), [("Y", ["/World/Second"]), ("X", [])])
def test_hinges_that_prevent_each_other_are_named(tmp_path, axis, found):
    """Two hinges between the same bodies, as converters write them for a joint of two rotations."""
    hinges = "".join(
        f'def PhysicsRevoluteJoint "{name}" {{\n rel physics:body0 = </World/A>\n rel physics:body1 = </World/B>\n'
        f" point3f physics:localPos0 = (0, 0, 1)\n point3f physics:localPos1 = (0, 0, -1)\n"
        f' uniform token physics:axis = "{along}"\n}}\n'
        for name, along in (("First", "X"), ("Second", axis))
    )
    bodies = rigid("A", "Cube", "double size = 1") + rigid("B", "Cube", f"double size = 1; {moved(0, 0, 2)}")
    scene = wr.import_usd(write_stage(tmp_path / "hinges.usda", bodies + hinges))
    told = [finding.path for finding in scene.import_report.findings if "about another axis" in finding.reason]
    assert told == found and len(scene.joints) == 2


HINGE = (
    'def PhysicsRevoluteJoint "{name}" (prepend apiSchemas = ["MjcJointAPI", "NewtonJointAPI"]) {{\n'
    " rel physics:body0 = </World/A>\n rel physics:body1 = </World/B>\n point3f physics:localPos0 = (0, 0, -1)\n"
    ' point3f physics:localPos1 = (0, 0, 1)\n uniform token physics:axis = "{axis}"\n{values}\n}}\n'
)
TWO_BODIES = rigid("A", "Cube", "double size = 1; bool physics:kinematicEnabled = 1") + rigid(
    "B", "Cube", f"double size = 1; {moved(0, 0, -2)}"
)


def test_joints_of_mujoco_in_series_are_connected_by_light_bodies(tmp_path):
    """A hinge about y, then one about x, in the order of the file: masses and their distribution add up to B's."""
    hinges = HINGE.format(name="Second", axis="Y", values="") + HINGE.format(name="First", axis="X", values="")
    scene = wr.import_usd(write_stage(tmp_path / "series.usda", TWO_BODIES + hinges))
    a, b, link = (next(body for body in scene.bodies if body.name == name) for name in ("A", "B", "B_Second"))
    ends = {entry.name: (scene.bodies[entry.body_b], scene.bodies[entry.body_a]) for entry in scene.joints}
    assert ends == {"Second": (a, link), "First": (link, b)}
    assert link.mass == pytest.approx(1.0 / 6.0) and b.mass + link.mass == pytest.approx(1000.0)
    whole = mass_properties.combine(
        (mass_properties.MassProperties(x.mass, x.shape.center_of_mass, x.shape.inertia * x.mass / x.shape.volume), *at)
        for x, at in ((b, (np.zeros(3), np.eye(3))), (link, (np.zeros(3), np.eye(3))))
    )
    assert whole.center_of_mass == pytest.approx(np.zeros(3), abs=1e-9)
    assert whole.inertia == pytest.approx(np.eye(3) * 1000.0 / 6.0)
    sim = wr.Simulator(scene, device="cpu", settings=wr.Settings(dt=1e-3))
    turn = np.sin(0.1), np.cos(0.1)
    scene_gravity = (9.81 * turn[0], 0.0, -9.81 * turn[1])
    sim.set("gravity", scene_gravity)
    sim.step(500)
    # A physical pendulum about y, of 2 small amplitudes of 0.1: its angle is 0.1 (1 - cos(t sqrt(m g l / I))).
    rate = np.sqrt(9.81 / (1.0 / 6.0 + 1.0))
    angle = dict(zip((entry.name for entry in scene.joints), sim.get("joint_position")[0], strict=True))
    assert abs(angle["Second"]) == pytest.approx(0.1 * (1.0 - np.cos(0.5 * rate)), rel=1e-2)
    assert abs(angle["First"]) < 1e-5


def test_springs_references_and_servos_of_mujoco_become_drives(tmp_path):
    """Angles of MuJoCo count from `ref` at the initial pose; a servo has stiffness -bias[1] gear^2."""
    values = (
        "uniform double mjc:ref = 30\n uniform double mjc:springref = 40\n uniform double mjc:stiffness = 2\n"
        "float newton:damping = 0.017453293\n float newton:armature = 0.5\n"
        "float physics:lowerLimit = -60\n float physics:upperLimit = 90\n"
    )
    servo = 'def MjcActuator "{name}" {{\n rel mjc:target = </World/Hinge>\n{values}\n}}\n'.replace(
        "{values}", "uniform double[] mjc:gear = [2, 0]\n{values}"
    )
    affine = 'uniform token mjc:biasType = "affine"\n uniform double[] mjc:biasPrm = [0, -5, -0.5]\n'
    text = (
        TWO_BODIES
        + HINGE.format(name="Hinge", axis="Y", values=values)
        + servo.format(name="Motor", values="")
        + servo.format(name="Servo", values=affine)
        + servo.format(name="Again", values=affine)
    )
    scene = wr.import_usd(write_stage(tmp_path / "servo.usda", text))
    (entry,) = scene.joints
    degree = math.pi / 180.0
    assert entry.joint.limits == pytest.approx((-90 * degree, 60 * degree), abs=1e-6)
    assert entry.armature == 0.5
    assert entry.drive.stiffness == pytest.approx(2.0 + 20.0) and entry.drive.damping == pytest.approx(1.0 + 2.0)
    assert entry.drive.target_position == pytest.approx((2.0 * 10 * degree - 20.0 * 30 * degree) / 22.0)
    told = {finding.path: finding.reason for finding in scene.import_report.left_out}
    assert told == {
        "/World/Motor": "MjcActuator: a motor whose force is its control: not imported",
        "/World/Again": "MjcActuator: another actuator drives this joint",
    }


@pytest.mark.parametrize(
    ("kind", "values", "lost"),
    [
        ("Spherical", "float drive:rotX:physics:stiffness = 100\n float limit:rotX:physics:low = -5", 2),
        ("Spherical", "float newton:friction = 3\n float newton:damping = 0.5\n float newton:armature = 0.1", 2),
        ("Spherical", "float physics:coneAngle0Limit = 20", 1),
        ("Spherical", "float physics:coneAngle0Limit = 0\n float physics:coneAngle1Limit = 0", 1),
        ("Distance", "float newton:friction = 3\n float drive:distance:physics:stiffness = 100", 2),
        ("Fixed", "float newton:damping = 0.5", 1),
        ("Revolute", "float drive:linear:physics:stiffness = 100\n float newton:friction = 3", 1),
        ("Prismatic", "float drive:linear:physics:stiffness = 100\n float newton:friction = 0", 0),
    ],
)
def test_what_a_kind_of_joint_cannot_have_is_told(tmp_path, kind, values, lost):
    """Each drive, limit and resistance that is lost has one finding."""
    schemas = ("PhysicsDriveAPI:rotX", "PhysicsDriveAPI:linear", "PhysicsDriveAPI:distance", "PhysicsLimitAPI:rotX")
    applied = ", ".join(f'"{schema}"' for schema in (*schemas, "NewtonJointAPI"))
    joint = f'def Physics{kind}Joint "Joint" (prepend apiSchemas = [{applied}]) {{\n rel physics:body0 = </World/A>\n'
    ends = " rel physics:body1 = </World/B>\n point3f physics:localPos0 = (0, 0, -1)\n float physics:maxDistance = 3\n"
    text = f"{TWO_BODIES}{joint}{ends} point3f physics:localPos1 = (0, 0, 1)\n {values}\n}}\n"
    report = wr.import_usd(write_stage(tmp_path / "lost.usda", text)).import_report
    assert [finding.path for finding in report.findings] == ["/World/Joint"] * lost


@pytest.mark.parametrize(("angle", "told"), [(40, True), (-1, False)])
def test_a_limit_of_a_ball_joint_of_mujoco_is_told(tmp_path, angle, told):
    """MuJoCo limits the angle of the whole rotation, a cone only that between the axes."""
    limits = f"float physics:coneAngle0Limit = {angle}\n float physics:coneAngle1Limit = {angle}"
    ball = HINGE.replace("Revolute", "Spherical").format(name="Ball", axis="X", values=limits)
    scene = wr.import_usd(write_stage(tmp_path / "ball.usda", TWO_BODIES + ball))
    assert ["rotations" in finding.reason for finding in scene.import_report.findings] == [True] * told


def test_a_drive_without_force_stays_without_force(tmp_path):
    """A motor that a program has switched off; the arm falls as before, with or without it."""
    scene = wr.Scene()
    arm = scene.add_body(wr.Box((0.2, 0.03, 0.03)), position=(0.2, 0, 1), mass=1.0)
    hinge = scene.add_joint(wr.RevoluteJoint((0, 1, 0)), arm, anchor=(0, 0, 1))
    scene.add_drive(hinge, stiffness=500.0, damping=20.0, max_force=30.0)
    sim = wr.Simulator(scene, device="cpu")
    sim.set("joint_max_force", 0.0)
    recording = wr.record(sim, frames=15)
    wr.export_usd(recording, tmp_path / "off.usda", profile="scene")
    back = wr.import_usd(tmp_path / "off.usda", strict=True)
    assert back.joints[0].drive.max_force == 0.0
    again = wr.record(wr.Simulator(back, device="cpu"), frames=15)
    np.testing.assert_allclose(again.position, recording.position, rtol=0, atol=1e-6)
    assert recording.position[-1, 0, 0, 2] < 0.85


def test_a_joint_with_a_group_of_bodies_holds_the_world(tmp_path):
    """Converters name the root of the file as the world, below which there may be a single collider."""
    link = (
        'def Xform "Link" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]) {\n'
        " float physics:mass = 1\n float3 physics:diagonalInertia = (1, 1, 1)\n}\n"
    )
    wall = (
        'def Cube "Wall" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {\n double3 xformOp:translate = (5, 0, 0)\n}\n'
    )
    joint = 'def PhysicsFixedJoint "Base" {\n rel physics:body0 = </World>\n rel physics:body1 = </World/Link>\n}\n'
    scene = wr.import_usd(write_stage(tmp_path / "base.usda", link + wall + joint))
    (entry,) = scene.joints
    assert entry.body_b is None and scene.bodies[entry.body_a].name == "Link"


def test_a_part_of_a_stage_keeps_its_joints_with_the_world_and_its_gravity(tmp_path):
    """A bar in a group that is moved and turned by 90 degrees about x: in its frame, gravity is along -y."""
    group = (
        'def Xform "Group" {{\n double3 xformOp:translate = (5, 0, 1)\n float xformOp:rotateX = 90\n'
        ' uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]\n{}}}\n'
    )
    half = "(0.70710678, 0.70710678, 0, 0)"
    joint = (
        'def PhysicsScene "Physics" {\n vector3f physics:gravityDirection = (0, 0, -1)\n'
        " float physics:gravityMagnitude = 2\n}\n"
        'def PhysicsRevoluteJoint "Hinge" {\n rel physics:body1 = </World/Group/Bar>\n'
        ' uniform token physics:axis = "Z"\n'
        f" point3f physics:localPos0 = (5, 0, 1)\n quatf physics:localRot0 = {half}\n"
        " point3f physics:localPos1 = (-1, 0, 0)\n}\n"
    )
    text = group.format(rigid("Bar", "Cube", f"double size = 0.2; {moved(1, 0, 0)}") + joint)
    heights = []
    for root in (None, "/World/Group"):
        scene = wr.import_usd(write_stage(tmp_path / "bar.usda", text), root, strict=True)
        up = -np.array(scene.gravity) / 2.0
        np.testing.assert_allclose(up, (0, 0, 1) if root is None else (0, 1, 0), atol=1e-6)
        sim = wr.Simulator(scene, device="cpu")
        start = sim.get("position")[0, 0] @ up
        sim.step(120)
        heights.append(sim.get("position")[0, 0] @ up - start)
        assert sim.get("joint_position")[0, 0] < -0.2
    assert heights[1] == pytest.approx(heights[0], abs=1e-5) and heights[0] < -0.2


def test_a_body_with_colliders_whose_file_states_no_mass_is_light(tmp_path):
    """A guard on an arm, as converters write links of URDF with a mass of 0: its density is not used for its mass."""
    text = rigid("Arm", "Cube", "double size = 1; float physics:mass = 2", ["PhysicsMassAPI"])
    some, mass = [1e-6, 1e-6, 1e-6, 0, 0, 0], "float physics:mass = 0;"
    for name, stated, tensor in (("Guard", mass, [0] * 6), ("Foot", mass, some), ("Block", "", some)):
        none = f"double size = 1; {stated} double[] newton:inertia = {tensor}"
        text += rigid(name, "Cube", none, ["PhysicsMassAPI"])
        ends = f"rel physics:body0 = </World/Arm>\n rel physics:body1 = </World/{name}>"
        text += f'def PhysicsFixedJoint "{name}Joint" {{\n {ends}\n}}\n'
    scene = wr.import_usd(write_stage(tmp_path / "guard.usda", text))
    mass = {body.name: body.mass for body in scene.bodies}
    assert mass == pytest.approx({"Arm": 2.0, "Guard": 0.002, "Foot": 0.002, "Block": 1000.0})
    told = {finding.path: finding.reason for finding in scene.import_report.findings}
    assert told["/World/Guard"] == "a mass of 0: it has 0.1% of the mass of /World/Arm"


def test_bodies_without_mass_are_parts_of_what_fixed_joints_hold_them_to(tmp_path):
    """A base without mass between the world and an arm, and a frame at the end of the arm."""
    empty = 'def Xform "{}" (prepend apiSchemas = ["PhysicsRigidBodyAPI"]) {{\n}}\n'
    fixed = 'def PhysicsFixedJoint "{}" {{\n{}}}\n'
    ends = " rel physics:body0 = </World/{}>\n rel physics:body1 = </World/{}>\n"
    text = (
        empty.format("Base")
        + empty.format("Frame")
        + empty.format("Loose")
        + rigid("Arm", "Cube", "double size = 1")
        + fixed.format("Root", " rel physics:body1 = </World/Base>\n")
        + fixed.format("Mount", ends.format("Base", "Arm"))
        + fixed.format("Tip", ends.format("Arm", "Frame"))
    )
    with pytest.warns(UserWarning, match="left out"):
        scene = wr.import_usd(write_stage(tmp_path / "parts.usda", text))
    (entry,) = scene.joints
    assert (entry.name, entry.body_b) == ("Mount", None) and scene.bodies[entry.body_a].name == "Arm"
    told = {finding.path: finding.reason for finding in scene.import_report.findings}
    assert told["/World/Base"].endswith("it is a part of the world")
    assert told["/World/Frame"].endswith("it is a part of /World/Arm")
    assert told["/World/Loose"] == "it has no enabled collider, and no mass"


def test_a_part_without_moments_of_inertia_adds_its_mass_to_its_body(tmp_path):
    """Half a kilogram that a frame without mass holds 0.5 m above a cube of 1.5 kg, against the parallel axis theorem.

    The cube turns: the common centre, 0.125 m above that of the cube, moves with it.
    """
    place = 'double3 xformOp:translate = (0, 0, 0.5)\n uniform token[] xformOpOrder = ["xformOp:translate"]'
    spin = "vector3f physics:angularVelocity = (90, 0, 0)"
    text = rigid("Cube", "Cube", f"double size = 1; float physics:mass = 1.5; {spin}", ["PhysicsMassAPI"])
    for name, mass in (("Frame", 0.0), ("Camera", 0.5)):
        apis = 'prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]'
        text += f'def Xform "{name}" ({apis}) {{\n float physics:mass = {mass}\n {place}\n}}\n'
    for name, first, second in (("A", "Cube", "Frame"), ("B", "Frame", "Camera")):
        ends = f"rel physics:body0 = </World/{first}>\n rel physics:body1 = </World/{second}>"
        text += f'def PhysicsFixedJoint "{name}" {{\n {ends}\n}}\n'
    (body,) = wr.import_usd(write_stage(tmp_path / "camera.usda", text)).bodies
    assert body.mass == pytest.approx(2.0)
    np.testing.assert_allclose(body.shape.center_of_mass, (0, 0, 0.125), atol=1e-7)
    tensor = body.shape.inertia * body.mass / body.shape.volume
    across = 1.5 / 6 + 1.5 * 0.5 / 2.0 * 0.5**2
    np.testing.assert_allclose(tensor, np.diag((across, across, 1.5 / 6)), atol=1e-7)
    np.testing.assert_allclose(body.linear_velocity, (0, -0.125 * np.pi / 2, 0), atol=1e-6)
