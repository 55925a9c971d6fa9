"""Files of other programs: units, axes, scales, masses, and what cannot be taken over."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf

import warp_rigid as wr
from tests.oracles import rotation_matrix
from tests.usd_tools import moved, rigid, start_of, write_stage
from warp_rigid.commands import cli
from warp_rigid.runs.runner import execute, find_scene, plan_run
from warp_rigid.scenes.builders import meshes

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def stage(tmp_path):
    """Function(text of prims, **units) -> the imported scene."""

    def read(body, root=None, strict=True, **units):
        return wr.import_usd(write_stage(tmp_path / "file.usda", body, **units), root, strict=strict)

    return read


def test_centimetres_grams_and_y_up_are_converted(stage):
    """A ball of 5 cm and 3 g, 2 m up, thrown along the stage's -z: y in this package's frame."""
    text = rigid(
        "Ball",
        "Sphere",
        f"double radius = 5; float physics:mass = 3; vector3f physics:velocity = (0, 0, -100); {moved(10, 200, 30)}",
        ["PhysicsMassAPI"],
    )
    scene = stage('def PhysicsScene "P" {\n}\n' + text, up="Y", meters=0.01, kilograms=0.001)
    np.testing.assert_allclose(scene.gravity, (0, 0, -9.81), atol=1e-6)
    (ball,) = scene.bodies
    assert ball.shape.radius == pytest.approx(0.05)
    assert ball.mass == pytest.approx(0.003)
    np.testing.assert_allclose(ball.position, (0.1, -0.3, 2.0), atol=1e-9)
    np.testing.assert_allclose(ball.linear_velocity, (0, 1, 0), atol=1e-9)


def test_gravity_is_in_the_stages_units_and_axes(stage):
    body = rigid("Ball", "Sphere")
    values = " vector3f physics:gravityDirection = (1, 0, 0)\n float physics:gravityMagnitude = 162\n"
    text = f'def PhysicsScene "P" {{\n{values}}}\n'
    np.testing.assert_allclose(stage(text + body, up="Y", meters=0.01).gravity, (1.62, 0, 0), atol=1e-6)
    np.testing.assert_allclose(stage(body).gravity, (0, 0, -9.81))


SCALED = 'double3 xformOp:scale = ({}, {}, {}); uniform token[] xformOpOrder = ["xformOp:scale"]'


@pytest.mark.parametrize(
    ("kind", "values", "volume", "half"),
    [
        ("Cube", "double size = 3; " + SCALED.format(1, 2, 4), 27 * 8.0, (1.5, 3, 6)),
        ("Sphere", "double radius = 2; " + SCALED.format(3, 3, 3), 4 / 3 * np.pi * 216, (6, 6, 6)),
        ("Cylinder", 'token axis = "X"; double radius = 1; double height = 6', 6 * np.pi, (3, 1, 1)),
        ("Capsule", 'token axis = "Y"; double radius = 1; double height = 6', (6 + 4 / 3) * np.pi, (1, 4, 1)),
        (
            "Cylinder",
            'token axis = "Y"; double radius = 1; double height = 2; ' + SCALED.format(2, 5, 2),
            40 * np.pi,
            (2, 5, 2),
        ),
    ],
)
def test_primitives_keep_axis_and_scale(stage, kind, values, volume, half):
    (body,) = stage(rigid("Thing", kind, values)).bodies
    assert body.shape.volume == pytest.approx(volume, rel=1e-9)
    lower, upper = _world_bounds(body)
    np.testing.assert_allclose(upper, half, rtol=1e-6)
    np.testing.assert_allclose(lower, -np.array(half), rtol=1e-6)
    assert not isinstance(body.shape, wr.Mesh)


def _world_bounds(body):
    """Box around a body, from its surface."""
    points = body.shape.surface()[0] @ rotation_matrix(body.orientation).T + np.array(body.position)
    return points.min(axis=0), points.max(axis=0)


def test_a_scale_that_bends_a_primitive_makes_a_mesh_and_says_so(stage):
    text = rigid("Egg", "Sphere", "double radius = 0.1; " + SCALED.format(1, 1, 2))
    scene = stage(text, strict=False)
    assert isinstance(scene.bodies[0].shape, wr.Mesh)
    np.testing.assert_allclose(_world_bounds(scene.bodies[0])[1], (0.1, 0.1, 0.2), rtol=1e-2)
    (finding,) = scene.import_report.changed
    assert finding.path == "/World/Egg" and "converted to a mesh" in finding.reason
    with pytest.raises(ValueError, match="/World/Egg: changed: a Sphere with this scale is converted to a mesh"):
        stage(text)


def test_a_cone_is_a_mesh(stage):
    scene = stage(rigid("Cone", "Cone", 'token axis = "Z"; double radius = 0.3; double height = 0.6'), strict=False)
    assert scene.bodies[0].shape.volume == pytest.approx(np.pi * 0.09 * 0.6 / 3, rel=5e-3)
    np.testing.assert_allclose(scene.bodies[0].shape.center_of_mass, (0, 0, -0.15), atol=1e-3)
    assert [finding.reason for finding in scene.import_report.changed] == ["a Cone is converted to a mesh"]


TETRAHEDRON = (
    "point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]; int[] faceVertexCounts = [3, 3, 3, 3];"
    " int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3];"
)


def test_mirrored_and_stretched_meshes_stay_solids(stage):
    """A negative scale turns a mesh inside out unless its triangles are turned over."""
    text = rigid("Left", "Mesh", TETRAHEDRON + SCALED.format(-1, 2, 1), ["PhysicsMeshCollisionAPI"])
    (body,) = stage(text).bodies
    lower, upper = _world_bounds(body)
    np.testing.assert_allclose(lower, (-1, 0, 0), atol=1e-7)
    np.testing.assert_allclose(upper, (0, 2, 1), atol=1e-7)
    assert body.shape.volume == pytest.approx(2 / 6)
    inside = (np.array([[-0.2, 0.2, 0.2]]) - body.position) @ rotation_matrix(body.orientation)
    assert body.shape.signed_distance(inside)[0] < 0


def test_grids_follow_the_schemas_resolution(stage):
    api = ["PhysicsMeshCollisionAPI", "NewtonSDFCollisionAPI"]
    values = {"uniform int newton:sdfMaxResolution = 40": 40, "uniform float newton:sdfTargetVoxelSize = 0.05": 20}
    for text, resolution in values.items():
        (body,) = stage(rigid("Solid", "Mesh", TETRAHEDRON + text, api)).bodies
        assert body.shape.sdf_resolution == resolution
    scene = stage(rigid("Solid", "Mesh", TETRAHEDRON + "uniform float newton:sdfPadding = 0.1", api), strict=False)
    assert "sdfPadding is ignored" in scene.import_report.changed[0].reason


@pytest.mark.parametrize(("token", "told"), [("sdf", False), ("none", False), ("convexHull", True)])
def test_approximations_are_not_needed(stage, token, told):
    text = TETRAHEDRON + f'uniform token physics:approximation = "{token}"'
    scene = stage(rigid("Solid", "Mesh", text, ["PhysicsMeshCollisionAPI"]), strict=False)
    assert bool(scene.import_report.changed) == told


def test_nested_colliders_become_one_body(stage):
    """Two unit cubes beside each other below a turned and shifted body."""
    cubes = "".join(
        f'def Cube "c{x}" (\n prepend apiSchemas = ["PhysicsCollisionAPI"]\n)\n{{\n double size = 1\n '
        f'double3 xformOp:translate = ({x}, 0, 0)\n uniform token[] xformOpOrder = ["xformOp:translate"]\n}}\n'
        for x in (0, 1)
    )
    text = (
        'def Xform "Body" (\n prepend apiSchemas = ["PhysicsRigidBodyAPI"]\n)\n{\n float xformOp:rotateZ = 90\n'
        " double3 xformOp:translate = (5, 0, 1)\n"
        ' uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]\n' + cubes + "}\n"
    )
    (body,) = stage(text).bodies
    assert body.mass == pytest.approx(2000.0)
    np.testing.assert_allclose(body.position, (5, 0, 1), atol=1e-9)
    lower, upper = _world_bounds(body)
    np.testing.assert_allclose(lower, (4.5, -0.5, 0.5), atol=1e-6)
    np.testing.assert_allclose(upper, (5.5, 1.5, 1.5), atol=1e-6)


MATERIAL = (
    'def Material "M" (\n prepend apiSchemas = ["PhysicsMaterialAPI"]\n)\n{\n float physics:density = 5\n'
    " float physics:dynamicFriction = 0.2\n float physics:staticFriction = 0.2\n float physics:restitution = 0.6\n}\n"
)
BOUND = "rel material:binding:physics = </World/M>"


@pytest.mark.parametrize(
    ("values", "mass"),
    [
        ("", 1000.0),
        (BOUND, 5.0),
        (BOUND + "; float physics:density = 7", 7.0),
        (BOUND + "; float physics:mass = 9", 9.0),
    ],
)
def test_mass_goes_before_density_and_that_before_the_materials(stage, values, mass):
    apis = ["PhysicsMassAPI", "MaterialBindingAPI"]
    (body,) = stage(MATERIAL + rigid("Cube", "Cube", "double size = 1; " + values, apis)).bodies
    assert body.mass == pytest.approx(mass, rel=1e-6)
    if BOUND in values:
        assert (body.friction, body.restitution) == (pytest.approx(0.2), pytest.approx(0.6))


def test_density_is_in_the_stages_units(stage):
    """1 g/cm^3 is water."""
    text = rigid("Cube", "Cube", "double size = 10; float physics:density = 1", ["PhysicsMassAPI"])
    (body,) = stage(text, meters=0.01, kilograms=0.001).bodies
    assert body.mass == pytest.approx(1.0)


def test_a_material_bound_above_counts(stage):
    above = 'def Xform "Group" (\n prepend apiSchemas = ["MaterialBindingAPI"]\n)\n{\n ' + BOUND + "\n"
    (body,) = stage(MATERIAL + above + rigid("Cube", "Cube") + "}\n").bodies
    assert body.friction == pytest.approx(0.2)


def test_velocities_are_in_the_bodys_frame(stage):
    turn = (
        'float xformOp:rotateZ = 90; uniform token[] xformOpOrder = ["xformOp:rotateZ"]; '
        "vector3f physics:velocity = (1, 0, 0); vector3f physics:angularVelocity = (180, 0, 0)"
    )
    (body,) = stage(rigid("Cube", "Cube", turn)).bodies
    np.testing.assert_allclose(body.linear_velocity, (0, 1, 0), atol=1e-6)
    np.testing.assert_allclose(body.angular_velocity, (0, np.pi, 0), atol=1e-6)


def test_kinematic_disabled_and_static_bodies(stage):
    static = 'def Cube "Wall" (\n prepend apiSchemas = ["PhysicsCollisionAPI"]\n)\n{\n}\n'
    ghost = static.replace("Wall", "Ghost").replace("{", "{\n bool physics:collisionEnabled = 0")
    text = rigid("Mover", "Cube", "bool physics:kinematicEnabled = 1") + rigid(
        "Off", "Cube", "bool physics:rigidBodyEnabled = 0"
    )
    scene = stage(static + ghost + text)
    assert [(body.name, body.motion.name) for body in scene.bodies] == [
        ("Wall", "STATIC"),
        ("Mover", "KINEMATIC"),
        ("Off", "STATIC"),
    ]


INSTANCER = """
def PointInstancer "Many" {{
    point3f[] positions = [(0, 0, 1), (3, 0, 1), (6, 0, 1)]
    quatf[] orientationsf = [(1, 0, 0, 0), (0.70710678, 0, 0, 0.70710678), (1, 0, 0, 0)]
    float3[] scales = [(1, 1, 1), (2, 2, 2), (1, 1, 1)]
    vector3f[] velocities = [(0, 0, 0), (0, 0, 5), (0, 0, 0)]
    int[] protoIndices = [0, 1, {last}]
    rel prototypes = [</World/Many/P/A>, </World/Many/P/B>]
    double3 xformOp:translate = (0, 10, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Scope "P" {{
        {a}
        {b}
    }}
}}
"""


def test_instancers_are_expanded(stage):
    a, b = rigid("A", "Sphere", "double radius = 0.5"), rigid("B", "Cube", "double size = 1")
    scene = stage(INSTANCER.format(a=a, b=b, last=0))
    assert [type(body.shape) for body in scene.bodies] == [wr.Sphere, wr.Box, wr.Sphere]
    np.testing.assert_allclose([body.position for body in scene.bodies], [(0, 10, 1), (3, 10, 1), (6, 10, 1)])
    np.testing.assert_allclose(scene.bodies[1].shape.half_extents, (1, 1, 1))
    np.testing.assert_allclose(np.abs(scene.bodies[1].orientation), (0, 0, 0.5**0.5, 0.5**0.5), atol=1e-6)
    np.testing.assert_allclose(scene.bodies[1].linear_velocity, (0, 0, 5), atol=1e-6)
    assert [body.name for body in scene.bodies] == ["Many_0", "Many_1", "Many_2"]
    with pytest.raises(ValueError, match="/World/Many: protoIndices must be from 0 to 1"):
        stage(INSTANCER.format(a=a, b=b, last=2))


def test_bodies_of_equal_prim_names_get_different_names(stage):
    ball = rigid("Ball", "Sphere")
    scene = stage("".join(f'def Xform "{name}" {{\n{ball}\n}}\n' for name in "ABC"))
    assert [body.name for body in scene.bodies] == ["Ball", "Ball_1", "Ball_2"]


@pytest.mark.parametrize("units", [{}, {"start": 12}])
def test_an_animated_body_starts_with_its_first_pose(tmp_path, units):
    """Its transform has time samples only; the stage starts at frame 12 or states no range."""
    moving = "double3 xformOp:translate.timeSamples = { 10: (0, 0, 1), 14: (4, 0, 1) }\n"
    order = 'uniform token[] xformOpOrder = ["xformOp:translate"]\nbool physics:kinematicEnabled = true'
    path = write_stage(tmp_path / "file.usda", rigid("Belt", "Cube", moving + order))
    if units:
        path.write_text(path.read_text().replace("upAxis", "startTimeCode = 12\n    endTimeCode = 20\n    upAxis", 1))
    scene = wr.import_usd(path)
    (belt,) = scene.bodies
    np.testing.assert_allclose(belt.position, (2.0 if units else 0.0, 0, 1), atol=1e-9)


MOVING = """
double3 xformOp:translate.timeSamples = {{ 0: (0, 0, 1), 24: (1, 0, 1), 48: (1, 2, 1) }}
float xformOp:rotateZ.timeSamples = {{ 0: 0, 24: 0, 48: 90 }}
uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]
{flag}
"""


def test_an_animated_kinematic_body_follows_its_animation(tmp_path):
    """An off-centre hammer moves along x for a second, then along y while it turns, and stays where it ends."""
    head = 'def Sphere "Head" (\n prepend apiSchemas = ["PhysicsCollisionAPI"]\n)\n{\n double radius = 0.2\n'
    head += ' double3 xformOp:translate = (0.5, 0, 0)\n uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n'
    text = 'def Xform "Hammer" (\n prepend apiSchemas = ["PhysicsRigidBodyAPI"]\n)\n{\n'
    text += MOVING.format(flag="bool physics:kinematicEnabled = 1") + head + "}\n"
    path = write_stage(tmp_path / "file.usda", text)
    layer = Sdf.Layer.FindOrOpen(str(path))
    layer.timeCodesPerSecond, layer.startTimeCode, layer.endTimeCode = 24.0, 0.0, 48.0
    layer.Save()
    assert wr.import_usd(path, strict=True).bodies[0].path.times[-1] == 2.0
    result = execute(plan_run(find_scene(str(path)), frames=150, device="cpu"), [0])
    position, orientation = result.recording.position[:, 0, 0], result.recording.orientation[:, 0, 0]
    np.testing.assert_allclose(position[30], (0.5, 0, 1), atol=1e-5)
    np.testing.assert_allclose(position[60], (1, 0, 1), atol=1e-5)
    np.testing.assert_allclose(position[90], (1, 1, 1), atol=1e-5)
    half = np.radians(22.5)
    np.testing.assert_allclose(orientation[90], (0, 0, np.sin(half), np.cos(half)), atol=1e-4)
    np.testing.assert_allclose(position[[120, 150]], [(1, 2, 1)] * 2, atol=1e-5)
    np.testing.assert_allclose(orientation[[120, 150]], [(0, 0, 0.5**0.5, 0.5**0.5)] * 2, atol=1e-5)


def test_a_body_that_should_start_asleep_is_reported(stage):
    asleep = "bool physics:startsAsleep = 1"
    text = rigid("Box", "Cube", asleep) + rigid("Gate", "Cube", f"{asleep}; bool physics:kinematicEnabled = 1")
    changed = stage(text + rigid("Ball", "Sphere"), strict=False).import_report.changed
    assert [str(finding) for finding in changed] == [
        "/World/Box: changed: it starts awake: physics:startsAsleep is ignored"
    ]


def test_animation_of_a_static_body_is_reported(stage):
    text = rigid("Wall", "Cube", MOVING.format(flag="bool physics:rigidBodyEnabled = 0").replace("\n", ";"))
    scene = stage(text, strict=False)
    assert "animated motion is ignored" in str(scene.import_report.findings[0])
    assert scene.bodies[0].path is None


GROUP = """
def PhysicsCollisionGroup "{name}" (
    prepend apiSchemas = ["CollectionAPI:colliders"]
)
{{
    rel collection:colliders:includes = {members}
    rel physics:filteredGroups = {others}
}}
"""


def test_collision_groups_and_filtered_pairs_keep_bodies_apart(stage):
    """Group G does not touch H; by name, E does not touch F. A is in G; B and C are in H; D is in none."""
    text = "".join(rigid(name, "Sphere", moved(9 * i, 0, 0)) for i, name in enumerate("ABCDE"))
    text += rigid("F", "Sphere", "rel physics:filteredPairs = </World/E>", ["PhysicsFilteredPairsAPI"])
    text += GROUP.format(name="G", members="</World/A>", others="</World/H>")
    text += GROUP.format(name="H", members="[</World/B>, </World/C>]", others="</World/G>")
    assert stage(text).filtered_pairs == {(0, 1), (0, 2), (4, 5)}


def test_a_filter_between_some_colliders_only_is_told(stage):
    two = "".join(f'def Cube "c{i}" (\n prepend apiSchemas = ["PhysicsCollisionAPI"]\n)\n{{\n}}\n' for i in (0, 1))
    text = f'def Xform "Pair" (\n prepend apiSchemas = ["PhysicsRigidBodyAPI"]\n)\n{{\n{two}}}\n'
    text += rigid("Ball", "Sphere", "rel physics:filteredPairs = </World/Pair/c1>", ["PhysicsFilteredPairsAPI"])
    with pytest.warns(UserWarning, match="see scene.import_report"):
        scene = stage(text, strict=False)
    assert scene.filtered_pairs == set()
    assert "filter between some of its colliders" in scene.import_report.left_out[0].reason


def test_what_cannot_be_taken_over_is_listed(stage):
    text = (
        rigid("A", "Cube")
        + rigid("B", "Cube", moved(3, 0, 0), ["PhysxRigidBodyAPI"])
        + 'def PhysicsJoint "Weld" {\n rel physics:body0 = </World/A>\n rel physics:body1 = </World/B>\n}\n'
        + 'def Xform "Robot" (\n prepend apiSchemas = ["PhysicsArticulationRootAPI"]\n)\n{\n}\n'
        + 'def Cloth "Flag" {\n}\n'
        + 'def Xform "Hollow" (\n prepend apiSchemas = ["PhysicsRigidBodyAPI"]\n)\n{\n}\n'
    )
    with pytest.warns(UserWarning, match="left out, see scene.import_report"):
        scene = stage(text, strict=False)
    told = {finding.path: finding.reason for finding in scene.import_report.left_out}
    assert set(told) == {f"/World/{name}" for name in ("B", "Weld", "Flag", "Hollow")}, "an articulation is its joints"
    assert "PhysxRigidBodyAPI" in told["/World/B"] and "Cloth" in told["/World/Flag"]
    assert "D6Joint" in told["/World/Weld"] and "no enabled collider" in told["/World/Hollow"]
    assert [body.name for body in scene.bodies] == ["A", "B"]
    with pytest.raises(ValueError, match=r"/World/\w+: left out.*and 3 more"):
        stage(text)


def test_a_distribution_of_mass_that_is_not_the_shapes_is_imported(stage):
    """In centimetres and grams, with principal axes that are turned by 90 degrees about z."""
    values = (
        "float physics:mass = 2000; point3f physics:centerOfMass = (20, 0, 0);"
        " float3 physics:diagonalInertia = (1e6, 2e6, 3e6);"
        " quatf physics:principalAxes = (0.70710678, 0, 0, 0.70710678)"
    )
    text = rigid("Cube", "Cube", values, ["PhysicsMassAPI"])
    (body,) = stage(text, meters=0.01, kilograms=0.001).bodies
    assert body.mass == pytest.approx(2.0)
    assert body.shape.center_of_mass == pytest.approx([0.2, 0.0, 0.0])
    found = body.shape.inertia / body.shape.volume * body.mass
    assert found == pytest.approx(np.diag([0.2, 0.1, 0.3]), abs=1e-6)


def test_colliders_of_different_densities_keep_them(stage):
    """Two cubes of a body, the second one three times as heavy: the centre of mass is at three quarters."""
    cube = (
        'def Cube "{}" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMassAPI"]) {{\n double size = 1\n{}\n}}\n'
    )
    text = (
        'def Xform "Pair" (prepend apiSchemas = ["PhysicsRigidBodyAPI"]) {\n'
        + cube.format("A", "float physics:mass = 1")
        + cube.format("B", "float physics:mass = 3\n" + moved(2, 0, 0).replace(";", "\n"))
        + "}\n"
    )
    (body,) = stage(text).bodies
    assert body.mass == pytest.approx(4.0) and body.shape.center_of_mass == pytest.approx([1.5, 0.0, 0.0])
    inertia = body.shape.inertia / body.shape.volume * body.mass
    spread = 1.0 * 1.5**2 + 3.0 * 0.5**2
    assert inertia == pytest.approx(np.diag([4 / 6, 4 / 6 + spread, 4 / 6 + spread]))


def test_a_body_without_colliders_moves_by_its_mass(stage, tmp_path):
    """It falls and turns, touches nothing, and comes back from an exported file."""
    values = (
        "float physics:mass = 2\n float3 physics:diagonalInertia = (1, 2, 3)\n"
        "vector3f physics:angularVelocity = (0, 0, 90)"
    )
    text = f'def Xform "Link" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]) {{\n{values}\n}}\n'
    scene = stage(text + rigid("Floor", "Cube", f"bool physics:rigidBodyEnabled = 0; {moved(0, 0, -2)}"), strict=False)
    assert [finding.reason for finding in scene.import_report.findings] == [
        "it has no enabled collider: it touches nothing"
    ]
    sim = wr.Simulator(scene, device="cpu")
    sim.step(240)
    link = [body.name for body in scene.bodies].index("Link")
    assert sim.get("position")[0, link, 2] == pytest.approx(-0.5 * 9.81, rel=5e-3)
    assert sim.get("angular_velocity")[0, link] == pytest.approx([0.0, 0.0, np.pi / 2], abs=1e-5)
    wr.export_usd(wr.record(sim, frames=1), tmp_path / "link.usda")
    again = wr.import_usd(tmp_path / "link.usda")
    body = again.bodies[[body.name for body in again.bodies].index("Link")]
    assert body.mass == pytest.approx(2.0)
    assert body.shape.inertia / body.shape.volume == pytest.approx(np.diag([0.5, 1.0, 1.5]), abs=1e-6)


def test_a_part_of_a_stage_can_be_read(stage):
    group = (
        'def Xform "{}" {{\n double3 xformOp:translate = (7, 0, 0)\n'
        ' uniform token[] xformOpOrder = ["xformOp:translate"]\n{}}}\n'
    )
    text = group.format("Near", rigid("Cube", "Cube", moved(1, 0, 0))) + group.format("Far", rigid("Ball", "Sphere"))
    (body,) = stage(text, root="/World/Near").bodies
    assert body.name == "Cube"
    np.testing.assert_allclose(body.position, (1, 0, 0))
    with pytest.raises(ValueError, match="root: .* has no prim /World/None"):
        stage(text, root="/World/None")


def test_a_part_of_a_stage_has_its_gravity_and_its_joints_with_other_parts(stage):
    """The physics scene, and the post that holds the ball, are outside of the group at x = 7 m that is read."""
    physics = 'def PhysicsScene "Physics" {\n float physics:gravityMagnitude = 1.62\n}\n'
    post = f'def Xform "Post" {{\n{moved(0, 0, 2).replace(";", chr(10))}\n}}\n'
    joint = (
        'def PhysicsSphericalJoint "Joint" {\n rel physics:body0 = </World/Post>\n'
        " rel physics:body1 = </World/Group/Ball>\n point3f physics:localPos0 = (7, 0, -1)\n}\n"
    )
    place = moved(7, 0, 0).replace(";", "\n")
    group = f'def Xform "Group" {{\n{place}\n{rigid("Ball", "Sphere", moved(0, 0, 1))}{joint}}}\n'
    scene = stage(physics + post + group, root="/World/Group")
    np.testing.assert_allclose(scene.gravity, (0, 0, -1.62), rtol=1e-6)
    np.testing.assert_allclose(scene.joints[0].frame_b.position, (0, 0, 1))


@pytest.mark.parametrize("root", [None, "/World/Group"])
def test_prims_that_ignore_those_above_are_where_the_stage_shows_them(stage, root):
    """A body below another one, and a collider, whose transforms start from the world, in a group at x = 7 m."""
    reset = 'double3 xformOp:translate = {}\n uniform token[] xformOpOrder = ["!resetXformStack!", "xformOp:translate"]'
    part = f'def Cube "Part" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {{\n{reset.format((7, 0, 3))}\n}}\n'
    below = rigid("Below", "Cube", reset.format((7, 4, 0)).replace("\n", ";"))
    body = rigid("Body", "Cube", moved(0, 0, 1), inside=part + below)
    place = moved(7, 0, 0).replace(";", "\n")
    found = {body.name: body for body in stage(f'def Xform "Group" {{\n{place}\n{body}}}\n', root=root).bodies}
    x = 7.0 if root is None else 0.0
    np.testing.assert_allclose(found["Below"].position, (x, 4, 0))
    np.testing.assert_allclose(found["Body"].position, (x, 0, 1))
    np.testing.assert_allclose(found["Body"].shape.bounds, [(-1, -1, -1), (1, 1, 3)])


def test_files_without_bodies_are_refused_in_one_line(stage, tmp_path):
    with pytest.raises(FileNotFoundError, match="none.usda: no such file"):
        wr.import_usd(tmp_path / "none.usda")
    (tmp_path / "text.usda").write_text("no usd")
    with pytest.raises(ValueError, match="text.usda: not a readable USD file"):
        wr.import_usd(tmp_path / "text.usda")
    with pytest.raises(ValueError, match="has no rigid bodies or colliders of UsdPhysics; export animations with"):
        stage('def Sphere "Ball" {\n}\n')
    with pytest.raises(ValueError, match="has no rigid bodies or colliders of UsdPhysics; /World/Egg: .*, got 0.0$"):
        stage(rigid("Egg", "Sphere", "double radius = 0"), strict=False)


def test_the_example_by_hand_runs(capsys, tmp_path):
    path = ROOT / "scenes" / "marble_run.usda"
    scene = wr.import_usd(path, strict=True)
    assert [body.motion.name for body in scene.bodies].count("DYNAMIC") == 7
    assert [type(body.shape).__name__ for body in scene.bodies].count("Mesh") == 1
    assert cli.main(["run", "marble_run.usda", "--frames", "2", "--device", "cpu", "-o", str(tmp_path / "a.usdc")]) == 0
    assert "12 bodies" in capsys.readouterr().out


def test_attributes_are_those_of_the_newton_schemas(tmp_path):
    """The schemas must be known before the first stage is opened, so another process looks."""
    scene = wr.Scene()
    solid = meshes.torus(sdf_resolution=24)
    scene.add_body(solid, rolling_friction=0.1, name="ring")
    wr.export_usd(start_of(scene), tmp_path / "a.usda")
    code = """
import sys, newton_usd_schemas
from pxr import Usd
stage = Usd.Stage.Open(sys.argv[1])
for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
    for name in prim.GetAuthoredPropertyNames():
        if name.startswith("newton:"):
            known = prim.GetPrimDefinition().GetAttributeDefinition(name)
            attribute = prim.GetAttribute(name)
            same = attribute.GetTypeName() == known.GetTypeName()
            print(name, attribute.Get(), same, attribute.GetVariability() == known.GetVariability())
"""
    command = [sys.executable, "-c", code, str(tmp_path / "a.usda")]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split("\n")
    assert sorted(told)[1:] == [
        "newton:rollingFriction 0.10000000149011612 True True",
        "newton:sdfMaxResolution 24 True True",
        "newton:torsionalFriction 0.0 True True",
    ]


def test_the_command_line_tells_findings(capsys, tmp_path):
    text = rigid("A", "Cube") + 'def PhysicsJoint "Weld" {\n rel physics:body0 = </World/A>\n}\n'
    path = write_stage(tmp_path / "file.usda", text)
    assert cli.main(["run", str(path), "--frames", "1", "--device", "cpu", "--set", "root=/World"]) == 0
    assert "/World/Weld: left out: D6Joint" in capsys.readouterr().err
