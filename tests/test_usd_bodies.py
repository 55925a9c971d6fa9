"""Bodies of UsdPhysics: instances in motion, filters of articulations, masses of colliders, disabled bodies."""

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom

import warp_rigid as wr
from tests.oracles import rotation_matrix
from tests.usd_tools import moved, rigid, write_stage
from warp_rigid.usd.instancing import flatten_usd

SPIN_DEGREES, SPEED = np.array([30.0, -60.0, 90.0]), np.array([1.0, 2.0, -0.5])
TURNED, PLACE = (0.9, 0.1, 0.3, -0.3), np.array([1.0, -2.0, 0.5])
OUTER = (
    "double3 xformOp:translate = (0, 0, 2)\n float3 xformOp:rotateXYZ = (40, 10, -70)\n"
    " float3 xformOp:scale = (2, 2, 2)"
)
OPS = 'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]'


@pytest.fixture
def stage(tmp_path):
    """Function(text of prims, **units) -> the imported scene, without findings."""

    def read(body, root=None, **units):
        return wr.import_usd(write_stage(tmp_path / "file.usda", body, **units), root, strict=True)

    return read


def numbers(*rows):
    return "[" + ", ".join("(" + ", ".join(map(str, row)) + ")" for row in rows) + "]"


def instancer(prototype, *values, outer=OUTER):
    """One instance at PLACE, TURNED, with SPEED and SPIN_DEGREES, of a prototype, below a moved instancer."""
    turn = numbers(np.array(TURNED) / np.linalg.norm(TURNED))
    return (
        f'def PointInstancer "Many" {{\n {outer}\n {OPS}\n int[] protoIndices = [0]\n'
        f" rel prototypes = </World/Many/P>\n point3f[] positions = {numbers(PLACE)}\n quatf[] orientationsf = {turn}\n"
        f" vector3f[] velocities = {numbers(SPEED)}\n vector3f[] angularVelocities = {numbers(SPIN_DEGREES)}\n"
        + "\n".join(values)
        + f"\n {prototype}\n}}\n"
    )


def outer_frame():
    """Rotation and translation of the instancers' frame; its scale is 2."""
    stage = Usd.Stage.CreateInMemory()
    prim = UsdGeom.Xform.Define(stage, "/X")
    prim.AddRotateXYZOp().Set(Gf.Vec3f(40, 10, -70))
    return np.array(prim.GetLocalTransformation())[:3, :3].T, np.array([0.0, 0.0, 2.0])


def assert_carried(body, tolerance=1e-5):
    """The velocity of the centre of mass and the spin of a point of the instance, which moves as a rigid body."""
    turn, shift = outer_frame()
    spin = turn @ np.radians(SPIN_DEGREES)
    center = body.position + rotation_matrix(body.orientation) @ body.shape.center_of_mass
    arm = center - (2.0 * turn @ PLACE + shift)
    np.testing.assert_allclose(body.angular_velocity, spin, atol=tolerance)
    np.testing.assert_allclose(body.linear_velocity, 2.0 * turn @ SPEED + np.cross(spin, arm), atol=tolerance)


NESTED = (
    'def Xform "P" {{\n def Xform "Group" (\n {native}\n ) {{\n'
    " float3 xformOp:rotateXYZ = (20, 30, 50)\n double3 xformOp:translate = (0.3, 0.2, 0.1)\n"
    ' uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]\n{inside}\n}}\n}}\n'
)


def test_an_instance_that_is_a_body_moves_as_its_instancer_says(stage):
    """In the frame of the instancer, which is turned and scaled, whatever the orientation of the instance."""
    (body,) = stage(instancer(rigid("P", "Cube"))).bodies
    assert_carried(body)


def test_the_velocity_of_an_instance_is_that_of_its_origin(stage):
    """A collider beside the origin of its body, which spins about the origin."""
    beside = (
        'def Cube "c" (\n prepend apiSchemas = ["PhysicsCollisionAPI"]\n)\n{\n double3 xformOp:translate = (3, 1, 0)\n'
    )
    beside += ' uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n'
    (body,) = stage(
        instancer(f'def Xform "P" (\n prepend apiSchemas = ["PhysicsRigidBodyAPI"]\n)\n{{\n{beside}}}\n')
    ).bodies
    assert np.linalg.norm(body.shape.center_of_mass) == pytest.approx(2.0 * 10**0.5, rel=1e-6)
    assert_carried(body)


@pytest.mark.parametrize("native", ["", "instanceable = true"])
def test_bodies_within_an_instance_move_with_it(stage, native):
    inside = rigid("A", "Cube", moved(0, 5, 0)) + rigid(
        "B", "Sphere", f"vector3f physics:velocity = (9, 9, 9); {moved(4, 0, 1)}"
    )
    bodies = stage(instancer(NESTED.format(inside=inside, native=native))).bodies
    assert len(bodies) == 2
    for body in bodies:
        assert_carried(body)


def test_instances_within_instances_add_their_motions(stage):
    """The inner instancer turns its instances too: the spins, each in its own frame, and the velocities add up."""
    inner = (
        'def Xform "P" {\n def PointInstancer "Inner" {\n int[] protoIndices = [0]\n'
        " point3f[] positions = [(1, 0, 0)]\n vector3f[] angularVelocities = [(0, 0, 45)]\n"
        " rel prototypes = </World/Many/P/Inner/Q>\n" + rigid("Q", "Sphere", moved(0, 1, 0)) + "}\n}\n"
    )
    (body,) = stage(instancer(inner)).bodies
    turn, shift = outer_frame()
    own = rotation_matrix(np.array([*TURNED[1:], TURNED[0]]) / np.linalg.norm(TURNED))
    spin, relative = turn @ np.radians(SPIN_DEGREES), turn @ own @ (0, 0, np.pi / 4)
    pivot = turn @ (2.0 * PLACE) + shift + 2.0 * turn @ own @ (1, 0, 0)
    expected = 2.0 * turn @ SPEED + np.cross(spin, body.position - (2.0 * turn @ PLACE + shift))
    expected += np.cross(relative, body.position - pivot)
    np.testing.assert_allclose(body.angular_velocity, spin + relative, atol=1e-5)
    np.testing.assert_allclose(body.linear_velocity, expected, atol=1e-5)


def test_an_instance_keeps_the_velocity_of_its_body_where_the_instancer_states_none(stage):
    text = instancer(rigid("P", "Cube", "vector3f physics:velocity = (1, 0, 0)"))
    text = text.replace(f" vector3f[] velocities = {numbers(SPEED)}\n", "")
    (body,) = stage(text).bodies
    np.testing.assert_allclose(body.linear_velocity, rotation_matrix(body.orientation) @ (1, 0, 0), atol=1e-6)


def test_units_axes_and_roots_of_instances(stage):
    """In centimetres, with y up: -z of the stage is y of the scene."""
    text = instancer(rigid("P", "Cube"), outer="").replace(f" {OPS}\n", "")
    (body,) = stage(text, up="Y", meters=0.01).bodies
    np.testing.assert_allclose(body.linear_velocity, 0.01 * SPEED[[0, 2, 1]] * (1, -1, 1), atol=1e-8)
    np.testing.assert_allclose(body.angular_velocity, np.radians(SPIN_DEGREES)[[0, 2, 1]] * (1, -1, 1), atol=1e-6)
    (same,) = stage(text, "/World", meters=0.01).bodies
    np.testing.assert_allclose(same.linear_velocity, 0.01 * SPEED, atol=1e-8)


def test_instances_made_flat_keep_their_velocities(tmp_path):
    text = instancer(NESTED.format(inside=rigid("A", "Cube"), native=""))
    path = write_stage(tmp_path / "many.usda", text)
    assert flatten_usd(path, tmp_path / "flat.usda") == 1
    (body,) = wr.import_usd(tmp_path / "flat.usda").bodies
    assert_carried(body)


ROBOT = """
def Xform "Robot" (
    apiSchemas = {root}
)
{{
    {pairs}
    {links}
    def PhysicsRevoluteJoint "j" (
        apiSchemas = {joint}
    )
    {{
        {joint_pairs}
        rel physics:body0 = </World/Robot/L0>
        rel physics:body1 = </World/Robot/L1>
        point3f physics:localPos0 = (0, 0, 1)
        point3f physics:localPos1 = (0, 0, -1)
    }}
}}
"""
ARTICULATION = '["PhysicsArticulationRootAPI", "PhysicsFilteredPairsAPI"]'
TO_FLOOR = "rel physics:filteredPairs = </World/Floor>"


def robot(links, **given):
    values = {"root": "None", "joint": "None", "pairs": "", "joint_pairs": "", "links": links}
    floor = 'def Cube "Floor" (\n prepend apiSchemas = ["PhysicsCollisionAPI"]\n)\n{\n}\n'
    return ROBOT.format(**values | given) + floor + rigid("Ball", "Sphere")


LINKS = rigid("L0", "Cube", moved(0, 0, 5)) + rigid("L1", "Cube", moved(0, 0, 7))


@pytest.mark.parametrize("where", ["root", "joint", "target", "group"])
def test_a_filter_on_an_articulation_is_one_on_all_its_bodies(stage, where):
    """On the prim above its links, on a joint that is its root, as the target of another prim, and on a plain group."""
    if where == "root":
        text = robot(LINKS, root=ARTICULATION, pairs=TO_FLOOR)
    elif where == "joint":
        text = robot(LINKS, joint=ARTICULATION, joint_pairs=TO_FLOOR)
    elif where == "group":
        text = robot(LINKS, root='["PhysicsFilteredPairsAPI"]', pairs=TO_FLOOR)
    else:
        text = robot(LINKS, root='["PhysicsArticulationRootAPI"]').replace(
            'def Cube "Floor" (\n prepend apiSchemas = ["PhysicsCollisionAPI"]\n)\n{',
            'def Cube "Floor" (\n prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsFilteredPairsAPI"]\n)\n{\n'
            " rel physics:filteredPairs = </World/Robot>",
        )
    scene = stage(text)
    names = {frozenset(scene.bodies[k].name for k in pair) for pair in scene.filtered_pairs}
    assert names == {frozenset(pair) for pair in (("L0", "L1"), ("L0", "Floor"), ("L1", "Floor"))}


def test_a_filter_on_a_body_is_not_one_on_the_bodies_below_it(stage):
    """Links that lie in each other's prims, as exporters of robots write them."""
    below = rigid("L1", "Cube", 'uniform token[] xformOpOrder = ["!resetXformStack!"]')
    text = rigid("L0", "Cube", TO_FLOOR, ["PhysicsFilteredPairsAPI"], inside=below)
    text += 'def Cube "Floor" (\n prepend apiSchemas = ["PhysicsCollisionAPI"]\n)\n{\n}\n'
    scene = stage(text)
    assert {frozenset(scene.bodies[k].name for k in pair) for pair in scene.filtered_pairs} == {
        frozenset(("L0", "Floor"))
    }


def collider(name, values):
    lines = "\n".join(f"  {value.strip()}" for value in values.split(";"))
    return f'def Cube "{name}" (\n prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMassAPI"]\n)\n{{\n{lines}\n}}\n'


def point_sum(parts):
    """Mass, centre and inertia of parts (mass, centre, inertia about it), from the parallel axis theorem."""
    mass = sum(m for m, _, _ in parts)
    center = sum(m * c for m, c, _ in parts) / mass
    steiner = [m * ((c - center) @ (c - center) * np.eye(3) - np.outer(c - center, c - center)) for m, c, _ in parts]
    return mass, center, sum(i for _, _, i in parts) + sum(steiner)


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_a_collider_states_its_own_distribution_of_mass(stage, unit):
    """One cube of the density of its shape, and one with a centre and moments of its own, turned and scaled."""
    axes = np.array([0.1, 0.2, 0.3, 0.9]) / np.linalg.norm([0.1, 0.2, 0.3, 0.9])
    x, y, z, w = axes
    text = (
        'def Xform "Body" (\n prepend apiSchemas = ["PhysicsRigidBodyAPI"]\n)\n{\n'
        + collider("l", f"float physics:mass = 1; double size = 1; {moved(-1, 0, 0)}")
        + collider(
            "r",
            "float physics:mass = 3; double size = 1; point3f physics:centerOfMass = (0, 0.1, 0.4); "
            f"float3 physics:diagonalInertia = (2, 3, 4); quatf physics:principalAxes = ({w}, {x}, {y}, {z}); "
            "double3 xformOp:translate = (1, 0, 0); float xformOp:rotateX = 90; float3 xformOp:scale = (1, 2, 1); "
            'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX", "xformOp:scale"]',
        )
        + "}\n"
    )
    (body,) = stage(text, meters=unit).bodies
    quarter = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    turn = quarter @ rotation_matrix(axes)
    at = np.array([1, 0, 0]) + quarter @ np.array([0, 0.2, 0.4])
    parts = [(1.0, np.array([-1.0, 0, 0]), np.eye(3) / 6.0), (3.0, at, turn @ np.diag([2.0, 3.0, 4.0]) @ turn.T)]
    mass, center, inertia = point_sum(parts)
    assert body.mass == pytest.approx(mass)
    np.testing.assert_allclose(body.shape.center_of_mass, unit * center, atol=1e-6 * unit)
    found = body.mass * body.shape.inertia / body.shape.volume
    np.testing.assert_allclose(found, unit**2 * inertia, atol=1e-5 * unit**2)


def test_a_single_collider_below_its_body_states_its_centre(stage):
    text = 'def Xform "Body" (\n prepend apiSchemas = ["PhysicsRigidBodyAPI"]\n)\n{\n'
    text += collider("c", f"point3f physics:centerOfMass = (0, 0, -0.3); double size = 1; {moved(0, 2, 0)}") + "}\n"
    (body,) = stage(text).bodies
    assert body.mass == pytest.approx(1000.0)
    np.testing.assert_allclose(body.shape.center_of_mass, (0, 2, -0.3), atol=1e-6)


DISABLED = """
def Xform "Post" (
    prepend apiSchemas = ["PhysicsRigidBodyAPI"]
)
{{
    bool physics:rigidBodyEnabled = 0
    double3 xformOp:translate = (0, 0, 2)
    float xformOp:rotateZ = 90
    float3 xformOp:scale = (2, 2, 2)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ", "xformOp:scale"]
    {inside}
}}
"""
HINGE = """
def Physics{kind}Joint "Hinge"
{{
    rel physics:body0 = </World/{first}>
    rel physics:body1 = </World/{second}>
    point3f physics:localPos{at_post} = (0.1, 0, 0)
    point3f physics:localPos{at_arm} = (0, -0.8, 0)
    quatf physics:localRot{at_arm} = (0.70710678, 0, 0, 0.70710678)
}}
"""
GEOMETRY = 'def Cube "Geometry" (\n prepend apiSchemas = ["PhysicsCollisionAPI"]\n)\n{\n double size = 0.1\n}\n'


@pytest.mark.parametrize("kind", ["Revolute", "Fixed", "Spherical", "Prismatic"])
@pytest.mark.parametrize("is_first", [True, False])
@pytest.mark.parametrize("inside", ["", GEOMETRY], ids=["no collider", "a collider"])
def test_a_joint_to_a_disabled_body_is_a_joint_to_the_world(stage, kind, is_first, inside):
    """At the anchor (0, 0.2, 2), the turned and scaled place on the post; its collider and the arm do not collide."""
    names, ends = (("Post", "Arm"), (0, 1)) if is_first else (("Arm", "Post"), (1, 0))
    text = DISABLED.format(inside=inside) + rigid("Arm", "Cube", f"double size = 0.2; {moved(0, 1, 2)}")
    text += HINGE.format(kind=kind, first=names[0], second=names[1], at_post=ends[0], at_arm=ends[1])
    scene = stage(text)
    (entry,) = scene.joints
    arm = scene.bodies[entry.body_a]
    assert arm.name == "Arm" and entry.body_b is None
    np.testing.assert_allclose(entry.frame_b.position, (0, 0.2, 2), atol=1e-6)
    np.testing.assert_allclose(arm.position + np.array(entry.frame_a.position), (0, 0.2, 2), atol=1e-6)
    assert [body.name for body in scene.bodies] == (["Geometry"] if inside else []) + ["Arm"]
    assert scene.filtered_pairs == ({(0, 1)} if inside else set())


def test_an_arm_swings_about_a_disabled_body(stage):
    """A hinge about the world's x axis at 0.8 m: period 2 pi sqrt(I / (m g r)) for small swings."""
    text = DISABLED.format(inside="") + rigid("Arm", "Cube", f"double size = 0.2; {moved(0, 1, 2)}")
    text += HINGE.format(kind="Revolute", first="Post", second="Arm", at_post=0, at_arm=1).replace(
        "point3f physics:localPos1", 'uniform token physics:axis = "Y"\n point3f physics:localPos1'
    )
    scene = stage(text)
    sim = wr.Simulator(scene, device="cpu")
    sim.step(60)
    position = sim.get("position")[0, 0]
    assert np.hypot(position[1] - 0.2, position[2] - 2.0) == pytest.approx(0.8, abs=1e-4) and position[2] < 1.9
