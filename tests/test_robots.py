"""MJCF and URDF, by way of the converters to USD: real files, what is reported, and converters that fail."""

import math
import os
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import trimesh

import warp_rigid as wr
from tests.robot_tools import robot_files
from warp_rigid.commands import cli
from warp_rigid.scene.joints import PrismaticJoint, RevoluteJoint
from warp_rigid.scenes.builders.jointed import anchor_errors

ANT, CARTPOLE = "ant.xml", "cartpole.urdf"


@pytest.fixture(scope="module")
def robots():
    return robot_files()


@pytest.fixture
def converter(tmp_path, monkeypatch):
    """A program in place of the converters: a function of the text of a shell script."""
    (tmp_path / "bin").mkdir()
    monkeypatch.setattr("warp_rigid.usd.robots.search_path", lambda: str(tmp_path / "bin"))

    def install(script):
        for name in ("mujoco_usd_converter", "urdf_usd_converter"):
            program = tmp_path / "bin" / name
            program.write_text(f"#!/bin/sh\n{script}\n")
            program.chmod(0o755)

    return install


def test_an_ant_has_the_joints_of_its_file(robots):
    """Masses from the volumes of its capsules; hinges with the limits, and the damping, of the XML text."""
    with pytest.warns(UserWarning, match="left out, see scene.import_report"):
        scene = wr.import_robot(robots[ANT])
    joints = {entry.name: entry for entry in scene.joints}
    told = {joint.get("name"): joint for joint in ElementTree.parse(robots[ANT]).iter("joint") if joint.get("name")}
    hinges = {name for name, joint in told.items() if joint.get("type") == "hinge"}
    assert {name for name, entry in joints.items() if isinstance(entry.joint, RevoluteJoint)} == hinges
    assert len(hinges) == 8 and len(joints) == 12, "four legs are welded to the torso"
    for name in hinges:
        limits = [math.radians(float(x)) for x in told[name].get("range").split()]
        assert joints[name].joint.limits == pytest.approx(limits, abs=1e-5)
        assert joints[name].drive.damping == pytest.approx(1.0, rel=1e-5)
        assert joints[name].armature == 1.0
    assert len([body for body in scene.bodies if body.mass > 0.0]) == 13
    told = {finding.path: finding.reason for finding in scene.import_report.findings}
    assert told["/ant/Physics/Actuator_0"] == "MjcActuator: a motor whose force is its control: not imported"
    assert "lights are not supported" in [f.reason for f in scene.import_report.findings if f.path == ANT]


@pytest.mark.long
def test_an_ant_falls_and_comes_to_lie_in_one_piece(robots):
    with pytest.warns(UserWarning, match="left out"):
        scene = wr.import_robot(robots[ANT])
    sim = wr.Simulator(scene, device="cpu")
    opened = 0.0
    for _ in range(30):
        sim.step(24)
        opened = max(opened, anchor_errors(sim).max())
    rows = [i for i, body in enumerate(scene.bodies) if body.mass > 0.0]
    assert opened < 1e-5 and sim.penetration()[0] < 5e-4
    with pytest.warns(UserWarning, match="left out"):
        touching = wr.import_robot(robots[ANT], self_collision=True)
    assert wr.Simulator(touching, device="cpu").penetration()[0] == 0.0, "links overlap, but the masks keep them apart"
    assert np.linalg.norm(sim.get("linear_velocity")[0, rows], axis=-1).max() < 0.02
    limits = np.array([entry.joint.range for entry in scene.joints])
    angle = sim.get("joint_position")[0]
    assert (angle > limits[:, 0] - 1e-3).all() and (angle < limits[:, 1] + 1e-3).all()


def test_a_cart_and_its_poles_have_the_joints_of_their_file(robots):
    with pytest.warns(UserWarning, match="left out"):
        scene = wr.import_robot(robots[CARTPOLE])
    tree = ElementTree.parse(robots[CARTPOLE])
    masses = [float(link.find("inertial/mass").get("value")) for link in tree.iter("link") if link.find("inertial")]
    assert sorted(body.mass for body in scene.bodies)[: len(masses)] == pytest.approx(sorted(masses))
    kinds = {entry.name: type(entry.joint) for entry in scene.joints}
    assert kinds["slider_to_cart"] is PrismaticJoint and kinds["cart_to_pole1"] is RevoluteJoint
    assert [entry.body_b for entry in scene.joints if entry.name == "root_joint"] == [None]
    sim = wr.Simulator(scene, device="cpu")
    sim.set("linear_velocity", (0, 0.5, 0), bodies=[scene.bodies.index(b) for b in scene.bodies if "pole2" in b.name])
    sim.step(240)
    assert anchor_errors(sim).max() < 1e-5 and sim.status()["status"][0] == "ok"


@pytest.mark.parametrize("name", [ANT, CARTPOLE])
def test_the_command_runs_a_robot(robots, name, capsys, tmp_path):
    film = tmp_path / "film.usdc"
    assert cli.main(["run", str(robots[name]), "--frames", "2", "--device", "cpu", "-o", str(film)]) == 0
    assert film.stat().st_size > 0
    assert "not supported" in capsys.readouterr().err


def test_strict_refuses_what_is_incomplete(robots):
    with pytest.raises(ValueError, match=rf"{ANT}: left out: .* \(and \d+ more\)"):
        wr.import_robot(robots[ANT], strict=True)


def test_a_missing_converter_is_named(converter, tmp_path, capsys):
    for name, package in (("robot.urdf", "urdf-usd-converter"), ("robot.xml", "mujoco-usd-converter")):
        (tmp_path / name).write_text("<robot/>")
        assert cli.main(["run", str(tmp_path / name)]) == 2
        told = capsys.readouterr().err
        assert re.search(rf"{name}: needs the program \w+: pipx install {package}", " ".join(told.split()))


def test_a_file_that_is_not_there_or_of_another_kind_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"robot\.xml: no such file"):
        wr.import_robot(tmp_path / "robot.xml")
    (tmp_path / "robot.sdf").write_text("<sdf/>")
    with pytest.raises(ValueError, match=r"robot\.sdf: must end in one of \.xml, \.mjcf, \.urdf"):
        wr.import_robot(tmp_path / "robot.sdf")


@pytest.mark.long
@pytest.mark.parametrize(
    ("script", "told"),
    [
        ("echo '[Error] [some.function] no link named foot'; exit 1", "no link named foot"),
        ("echo 'Traceback'; echo 'ValueError: bad axis' >&2; exit 1", "ValueError: bad axis"),
        ("exit 0", "no message"),
        (
            "echo '[Warning] [a.b] failed: XML error:'; echo 'line 3: <mujoco>'; echo; exit 1",
            "XML error: line 3: <mujoco>",
        ),
        ("exec sleep 99", "was stopped after 3 s"),
    ],
)
def test_a_failed_conversion_is_one_line(converter, tmp_path, monkeypatch, script, told):
    converter(script)
    monkeypatch.setattr("warp_rigid.usd.robots.SECONDS", 3.0)
    (tmp_path / "robot.urdf").write_text("<robot/>")
    with pytest.raises(ValueError, match=told) as caught:
        wr.import_robot(tmp_path / "robot.urdf")
    assert str(caught.value).count("\n") == 0 and "robot.urdf" in str(caught.value)


def test_warnings_of_the_converter_are_findings(converter, tmp_path):
    """Each once, however often it is printed; the file is that of the robot, not the temporary one."""
    sphere = (
        '#usda 1.0\n(\n metersPerUnit = 1\n upAxis = "Z"\n)\ndef Sphere "Ball" (\n'
        ' prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI"]\n)\n{\n double radius = 0.5\n}\n'
    )
    warning = "echo '[Warning] [a.b.c] lights are not supported'"
    converter(f"{warning}; {warning}; cat >\"$2/Robot.usda\" <<'END'\n{sphere}END")
    path = tmp_path / "robot.mjcf"
    path.write_text("<mujoco/>")
    with pytest.warns(UserWarning, match=r"1 left out, see scene.import_report; first: robot.mjcf: left out: lights"):
        scene = wr.import_robot(path)
    assert len(scene.bodies) == 1 and scene.import_report.file == str(path)
    assert [str(f) for f in scene.import_report.findings] == ["robot.mjcf: left out: lights are not supported"]


@pytest.mark.long
def test_a_conversion_has_limits_and_ends_with_the_process_that_waits(converter, tmp_path):
    """A limit of the system that is lower stays."""
    converter('echo $$ >"$2.pid"; exec sleep 60')
    (tmp_path / "robot.urdf").write_text("<robot/>")
    program = (
        "import resource, sys\nfrom warp_rigid.usd import robots\nimport warp_rigid as wr\n"
        "resource.setrlimit(resource.RLIMIT_CPU, (200, 200))\nrobots.search_path = lambda: sys.argv[1]\n"
        "robots._convert(robots.Path(sys.argv[2]), sys.argv[3])\n"
    )
    folder = tmp_path / "converted"
    folder.mkdir()
    arguments = [str(tmp_path / "bin"), str(tmp_path / "robot.urdf"), str(folder)]
    waiting = subprocess.Popen([sys.executable, "-c", program, *arguments])
    pid_file = tmp_path / "converted.pid"
    deadline = time.monotonic() + 60.0
    while not (pid_file.exists() and pid_file.read_text().strip()) and time.monotonic() < deadline:
        time.sleep(0.05)
    limits = Path(f"/proc/{int(pid_file.read_text())}/limits")
    soft = {line[:25].strip(): line[25:].split()[0] for line in limits.read_text().splitlines()}
    assert (soft["Max cpu time"], soft["Max address space"]) == ("200", str(8 * 2**30))
    waiting.kill()
    waiting.wait()
    while limits.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not limits.exists()


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("robot.urdf", '<robot><mesh filename="pipe.stl"/></robot>'),
        ("robot.urdf", '<robot><mesh filename="package://arm/pipe.stl"/></robot>'),
        ("robot.xml", '<mujoco><compiler meshdir="arm"/><asset><mesh file="pipe.stl"/></asset></mujoco>'),
        ("robot.xml", '<mujoco><include file="more.xml"/></mujoco>'),
    ],
)
def test_a_named_pipe_behind_a_description_is_not_waited_for(converter, tmp_path, name, text):
    converter("exit 1")
    (tmp_path / "arm").mkdir()
    os.mkfifo(tmp_path / "arm" / "pipe.stl")
    os.mkfifo(tmp_path / "pipe.stl")
    (tmp_path / "more.xml").write_text("<mujoco><asset><mesh file='pipe.stl'/></asset></mujoco>")
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=r"pipe\.stl: must be a regular file$"):
        wr.import_robot(tmp_path / name)


ARM = """<robot name="arm"><link name="upper"><inertial><mass value="2"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="package://my_arm/meshes/upper.stl"/></geometry></collision></link></robot>"""
BALL = '<sphere radius="0.1"/>'


@pytest.mark.parametrize(
    ("place", "listed"),
    [("my_arm/urdf", None), ("robots", None), ("elsewhere/deep", "."), ("elsewhere/deep", "my_arm")],
    ids=["around the file", "beside a folder around it", "in a listed folder", "listed itself"],
)
def test_meshes_of_packages_are_found(robots, tmp_path, monkeypatch, place, listed):
    """A box of 0.4 x 0.2 x 0.6 m."""
    root = tmp_path if listed is None else tmp_path / "work"
    (root / "my_arm" / "meshes").mkdir(parents=True)
    trimesh.creation.box((0.4, 0.2, 0.6)).export(root / "my_arm" / "meshes" / "upper.stl")
    monkeypatch.setenv("ROS_PACKAGE_PATH", "" if listed is None else f"/nowhere:{root / listed}")
    file = tmp_path / place / "arm.urdf"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(ARM)
    scene = wr.import_robot(file)
    (arm,) = (body for body in scene.bodies if body.mass > 0.0)
    low, high = arm.shape.bounds
    assert high - low == pytest.approx((0.4, 0.2, 0.6), abs=1e-5)


def test_a_package_that_is_not_found_is_reported(robots, tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM)
    with pytest.warns(UserWarning, match="left out, see scene.import_report"):
        scene = wr.import_robot(tmp_path / "arm.urdf")
    assert any("my_arm" in finding.reason for finding in scene.import_report.findings)


FEATURES = {
    "robot.xml": """<mujoco><include file="more.xml"/><worldbody>
<body name="a"><joint name="j1" axis="0 1 0"/><geom size="0.1"/><site name="s1"/>
<body name="b" pos="0 0 -1"><joint name="j2" axis="0 1 0"/><geom size="0.1"/></body></body></worldbody>
<tendon><fixed name="coupling"><joint joint="j1" coef="1"/><joint joint="j2" coef="-1"/></fixed></tendon>
<equality><joint name="gear" joint1="j1" joint2="j2"/><joint joint1="j2"/><connect name="pin" body1="b" anchor="0 0 0"/>
</equality><actuator><motor name="motor" joint="j1"/><position name="servo" joint="j2" kp="10"/></actuator></mujoco>""",
    "robot.urdf": """<robot name="m"><link name="base"/><link name="l1"/><link name="l2"/>
<joint name="j1" type="continuous"><parent link="base"/><child link="l1"/><axis xyz="0 1 0"/></joint>
<joint name="j2" type="continuous"><parent link="base"/><child link="l2"/><axis xyz="0 1 0"/><mimic joint="j1"/></joint>
<transmission name="t1"><joint name="j1"/></transmission>
<gazebo reference="l1"><sensor name="lidar" type="ray"/></gazebo></robot>""".replace(
        "/><link",
        "><inertial><mass value='1'/><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial></link><link",
    ),
}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (
            "robot.xml",
            {"motors": "motor", "tendons": "coupling", "equality constraints": "gear, joint (j2)", "sensors": "imu"},
        ),
        ("robot.urdf", {"mimic joints": "j2", "transmissions": "t1", "sensors": "lidar"}),
    ],
)
def test_what_is_not_simulated_is_named(robots, tmp_path, name, expected):
    """One warning for each kind; a servo and a point constraint are simulated, and an included file counts."""
    (tmp_path / name).write_text(FEATURES[name])
    (tmp_path / "more.xml").write_text('<mujoco><sensor><gyro name="imu" site="s1"/></sensor></mujoco>')
    with pytest.warns(UserWarning) as caught:
        scene = wr.import_robot(tmp_path / name)
    told = [str(warning.message).partition(": not simulated: ")[2] for warning in caught]
    assert dict(line.split(": ") for line in told if line) == expected
    reasons = [finding.reason for finding in scene.import_report.left_out if finding.path == name]
    assert set(reasons) >= {f"{kind}: {names}" for kind, names in expected.items()}


def test_free_joints_with_damping_are_named(robots, tmp_path):
    """Their values can be those of a default class; a <freejoint> has none."""
    joints = ('<joint name="root" type="free"/>', "<freejoint/>", '<joint type="free" class="loose"/>')
    bodies = "".join(
        f'<body name="b{i}" pos="{i} 0 0">{joint}<geom size="0.1"/></body>' for i, joint in enumerate(joints)
    )
    classes = '<default><joint damping="0.5"/><default class="loose"><joint damping="0"/></default></default>'
    (tmp_path / "robot.xml").write_text(f"<mujoco>{classes}<worldbody>{bodies}</worldbody></mujoco>")
    told = "robot.xml: not simulated: damping, friction and armature of free joints: root$"
    with pytest.warns(UserWarning, match=told):
        scene = wr.import_robot(tmp_path / "robot.xml")
    assert len(scene.bodies) == 3


def test_links_of_mass_0_are_named(robots, tmp_path):
    """They get a mass from their collider; a link without collider keeps that of the file, and is not named."""
    link = "<link name='{}'><inertial><mass value='{}'/><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/>"
    ball = "</inertial><collision><geometry><sphere radius='0.1'/></geometry></collision></link>"
    links = [link.format(name, mass) + ball for name, mass in (("base", 1), ("foot", 0))]
    joint = "<joint name='j' type='continuous'><parent link='base'/><child link='foot'/><axis xyz='0 1 0'/></joint>"
    (tmp_path / "robot.urdf").write_text(f"<robot name='m'>{''.join(links)}{joint}</robot>")
    with pytest.warns(
        UserWarning, match="robot.urdf: links of mass 0 get a mass, a small one where they are fixed to another: foot"
    ):
        scene = wr.import_robot(tmp_path / "robot.urdf")
    assert any("foot" in str(finding) for finding in scene.import_report.findings)


def test_the_first_link_of_a_urdf_file_is_fixed_and_can_be_released(robots, tmp_path):
    """It falls by g dt^2 n (n + 1) / 2 in n steps, in which the velocity is updated before the position."""
    (tmp_path / "arm.urdf").write_text(ARM.replace('<mesh filename="package://my_arm/meshes/upper.stl"/>', BALL))
    sim = wr.Simulator(wr.import_robot(tmp_path / "arm.urdf"), num_envs=2, device="cpu")
    sim.set("joint_broken", True, joints=["root_joint"], envs=[1])
    sim.step(120)
    np.testing.assert_allclose(sim.get("position")[:, 0, 2], (0.0, -9.81 * 120 * 121 / 2 / 240**2), rtol=1e-5)
