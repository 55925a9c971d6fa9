"""The scene profile: what other programs read in it, and that it comes back as the scene it was."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdPhysics

import warp_rigid as wr
from tests.fakes import FakeSimulator
from tests.oracles import rotation_matrix
from tests.usd_tools import Resting, start_of, validator_errors
from warp_rigid import scenes
from warp_rigid.runs.recording import Recorder
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scenes.builders import meshes
from warp_rigid.usd.check import check_usd

SMALL = {
    "bunny_pile": {"bodies": 2},
    "showcase": {"bodies": 30},
    "terrain": {"bodies": 8},
    "planet": {"bodies": 16},
    "carpet": {"bodies": 8},
    "bone_pile": {"bones": 6},
    "domino_spiral": {"dominoes": 12},
    "wrecking_ball": {"rows": 3, "pyramids": 1},
    "chain": {"links": 12},
    "bridge": {"planks": 10},
    "ragdolls": {"dolls": 1},
    "demolition": {"rows": 5, "columns": 4},
}
"""Sizes of scenes that would take long otherwise; the kinds of bodies stay the same."""

EVERY_KIND_OF_SHAPE = ("showcase", "skull_and_brain", "terrain")
"""Scenes with round shapes and compounds, with meshes, and with a height field."""


def small(name):
    """A built-in scene at a size at which everything of it occurs."""
    known = scenes.get(name).parameters
    return scenes.load(name, **{key: value for key, value in SMALL.get(name, {}).items() if key in known})


def failures(path):
    """What the Omniverse validator finds that is worse than a warning."""
    validator = pytest.importorskip("omni.asset_validator", reason="needs Python before 3.13")
    issues = validator.ValidationEngine(init_rules=True).validate(str(path)).issues()
    bad = (validator.IssueSeverity.ERROR, validator.IssueSeverity.FAILURE)
    return [
        f"{issue.rule.__name__ if issue.rule else ''}: {issue.message}" for issue in issues if issue.severity in bad
    ]


@pytest.fixture(scope="module")
def mixed():
    """Every kind of shape and body."""
    scene = wr.Scene(gravity=(0.3, 0.0, -3.7), friction_combine="average", restitution_combine="max")
    scene.add_force_field(wr.PointField(center=(0, 0, -10), strength=100.0))
    scene.add_force_field(wr.UniformField(acceleration=(0.5, 0, 0)))
    scene.add_static(wr.Plane(normal=(0.2, 0.0, 1.0), offset=-0.3), friction=0.7, name="slope")
    heights = np.random.default_rng(1).uniform(0, 0.2, (4, 5))
    scene.add_static(wr.Heightfield(heights, (2.0, 3.0)), position=(0, 5, 0), name="terrain")
    joined = wr.Compound(
        [
            (wr.Box((0.3, 0.05, 0.05)), (0, 0, 0), (0, 0, 0, 1)),
            (wr.Compound([(wr.Sphere(0.1), (0.1, 0, 0), (0, 0, 0, 1))]), (0.3, 0, 0), (0, 0, 0.6, 0.8)),
        ]
    )
    scene.add_static(joined, position=(4, 0, 0), name="rail 1")
    turned = (0.1, -0.2, 0.3, 0.9)
    scene.add_body(joined, position=(0, 0, 2), orientation=turned, linear_velocity=(1, 2, 3), name="rail 1")
    scene.add_body(wr.Capsule(0.1, 0.3), position=(1, 0, 2), angular_velocity=(4, 5, 6), orientation=turned, mass=3.0)
    scene.add_body(wr.Cylinder(0.1, 0.3), position=(2, 0, 2), rolling_friction=0.01, spinning_friction=0.02)
    scene.add_body(meshes.torus(sdf_resolution=20), position=(3, 0, 2), restitution=0.25, density=2500.0)
    scene.add_kinematic(wr.Cylinder(1.0, 0.05), position=(0, -3, 1), angular_velocity=(0, 0, 2), name="3rd table")
    for pair in ((0, 3), (2, 4), (4, 5), (5, 7)):
        scene.filter_pair(*pair)
    return scene


def assert_same(one, other):
    """Two scenes of the same bodies."""
    np.testing.assert_allclose(one.gravity, other.gravity, rtol=1e-6, atol=1e-6)
    assert (one.friction_combine, one.restitution_combine) == (other.friction_combine, other.restitution_combine)
    assert one.filtered_pairs == other.filtered_pairs
    assert sorted(map(repr, one.force_fields)) == sorted(map(repr, other.force_fields))
    assert [(body.name, body.motion) for body in one.bodies] == [(body.name, body.motion) for body in other.bodies]
    for mine, theirs in zip(one.bodies, other.bodies, strict=True):
        scale = max(1.0, float(np.abs(mine.position).max()))
        np.testing.assert_allclose(mine.position, theirs.position, rtol=0, atol=1e-6 * scale)
        np.testing.assert_allclose(
            rotation_matrix(mine.orientation), rotation_matrix(theirs.orientation), rtol=0, atol=1e-6
        )
        assert theirs.mass == pytest.approx(mine.mass, rel=1e-5)
        for name in COEFFICIENTS:
            assert getattr(theirs, name) == pytest.approx(getattr(mine, name), rel=1e-6)
        for name in ("linear_velocity", "angular_velocity"):
            np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), rtol=1e-5, atol=1e-5)
        assert_same_shape(mine.shape, theirs.shape)


def assert_same_shape(mine, theirs):
    """By what they do: their extent, their mass properties and their distances."""
    finite = np.isfinite(mine.bounds)
    assert (finite == np.isfinite(theirs.bounds)).all()
    size = mine.size if np.isfinite(mine.size) else 1.0
    np.testing.assert_allclose(np.array(mine.bounds)[finite], np.array(theirs.bounds)[finite], atol=1e-5 * size)
    if not mine.static_only:
        assert theirs.volume == pytest.approx(mine.volume, rel=1e-5)
        np.testing.assert_allclose(mine.center_of_mass, theirs.center_of_mass, atol=1e-5 * size)
        np.testing.assert_allclose(mine.inertia, theirs.inertia, rtol=1e-4, atol=1e-5 * np.abs(mine.inertia).max())
    if isinstance(mine, wr.Mesh):
        assert isinstance(theirs, wr.Mesh) and mine.sdf_resolution == theirs.sdf_resolution
        return
    if isinstance(mine, wr.Heightfield):
        assert mine.moving == theirs.moving and mine.angular_frequency == theirs.angular_frequency
        np.testing.assert_array_equal(mine.amplitude, theirs.amplitude)
        np.testing.assert_array_equal(mine.phase, theirs.phase)
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * 2.0 * size
    np.testing.assert_allclose(
        mine.signed_distance(points)[0], theirs.signed_distance(points)[0], rtol=0, atol=2e-6 * max(size, 1.0)
    )


@pytest.mark.parametrize("suffix", [".usdc", ".usda", ".usdz"])
def test_every_kind_of_body_comes_back(mixed, tmp_path, suffix):
    path = tmp_path / f"mixed{suffix}"
    wr.export_usd(start_of(mixed), path)
    back = wr.import_usd(path, strict=True)
    assert_same(mixed, back)


def test_colliders_below_a_static_body_can_be_read_alone(tmp_path):
    """Those of a written file, by the path of the prim that holds them: their poses are relative to it."""
    scene = wr.Scene()
    parts = [(wr.Box((0.1, 0.2, 0.3)), (0, 0, 0), (0, 0, 0, 1)), (wr.Sphere(0.2), (1, 0, 0), (0, 0, 0, 1))]
    scene.add_static(wr.Compound(parts), position=(5, 0, 0), name="wall")
    wr.export_usd(start_of(scene), tmp_path / "a.usda")
    found = wr.import_usd(tmp_path / "a.usda", root="/World/env_0000/wall/geometry").bodies
    assert [body.position for body in found] == [(0, 0, 0), (1, 0, 0)]


@pytest.mark.parametrize("name", scenes.names())
def test_built_in_scene_comes_back(name, tmp_path):
    scene = small(name)
    wr.export_usd(start_of(scene), tmp_path / "scene.usdc", profile="scene")
    assert_same(scene, wr.import_usd(tmp_path / "scene.usdc", strict=True))


@pytest.mark.parametrize(
    ("name", "profile"),
    [(name, profile) for name in EVERY_KIND_OF_SHAPE for profile in ("scene", "animation")]
    + [
        pytest.param(name, ("scene", "animation")[index % 2], marks=pytest.mark.long)
        for index, name in enumerate(scenes.names())
        if name not in EVERY_KIND_OF_SHAPE
    ],
)
def test_validators_find_nothing_in_built_in_scenes(name, profile, tmp_path):
    path = tmp_path / "scene.usdc"
    sim = Resting(small(name), num_envs=2)
    recorder = Recorder(sim, 60.0)
    recorder.capture(sim)
    wr.export_usd(recorder.recording(), path, profile=profile)
    assert check_usd(path) == []
    assert failures(path) == []


def test_the_validators_can_find_something(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "bad.usda"))
    mesh = UsdGeom.Mesh.Define(stage, "/mesh")
    UsdPhysics.RigidBodyAPI.Apply(mesh.GetPrim())
    stage.Save()
    assert validator_errors(tmp_path / "bad.usda") and failures(tmp_path / "bad.usda")


def parsed(path, kind):
    """Descriptions by path, from the USD library's own physics parser."""
    stage = Usd.Stage.Open(str(path))
    found = UsdPhysics.UsdPhysicsLoadStageFromPrimRange(stage, ["/"])
    return {str(path): description for path, description in zip(*found.get(kind, ([], [])), strict=True)}


def test_the_physics_parser_reads_what_was_simulated(mixed, tmp_path):
    path = tmp_path / "mixed.usdc"
    wr.export_usd(start_of(mixed), path)
    bodies = parsed(path, UsdPhysics.ObjectType.RigidBody)
    root = "/World/env_0000"
    assert set(bodies) == {f"{root}/{name}" for name in ("rail_1_1", "capsule_4", "cylinder_5", "mesh_6", "_rd_table")}
    assert [path for path, body in bodies.items() if body.kinematicBody] == [f"{root}/_rd_table"]
    np.testing.assert_allclose(bodies[f"{root}/capsule_4"].position, (1, 0, 2), atol=1e-6)
    # The parser gives velocities as they are in the file: in the body's frame, in degrees.
    turn = rotation_matrix(mixed.bodies[4].orientation)
    spin = np.radians(turn @ np.array(bodies[f"{root}/capsule_4"].angularVelocity))
    np.testing.assert_allclose(spin, (4, 5, 6), rtol=1e-5)
    (gravity,) = parsed(path, UsdPhysics.ObjectType.Scene).values()
    np.testing.assert_allclose(
        np.array(gravity.gravityDirection) * gravity.gravityMagnitude, (0.3, 0.0, -3.7), rtol=1e-6, atol=1e-6
    )
    (mesh,) = (d for p, d in parsed(path, UsdPhysics.ObjectType.MeshShape).items() if "mesh_6" in p)
    assert mesh.approximation == "none" and len(mesh.materials) == 1
    capsules = parsed(path, UsdPhysics.ObjectType.CapsuleShape)
    (capsule,) = capsules.values()
    assert (capsule.radius, capsule.halfHeight) == (pytest.approx(0.1), pytest.approx(0.3))
    materials = parsed(path, UsdPhysics.ObjectType.RigidBodyMaterial)
    assert materials[str(mesh.materials[0])].restitution == pytest.approx(0.25)


def test_mass_properties_are_those_simulated(mixed, tmp_path):
    path = tmp_path / "mixed.usdc"
    wr.export_usd(start_of(mixed), path)
    stage = Usd.Stage.Open(str(path))
    body = mixed.bodies[3]
    api = UsdPhysics.MassAPI(stage.GetPrimAtPath("/World/env_0000/rail_1_1"))
    axes = rotation_matrix(
        (*api.GetPrincipalAxesAttr().Get().GetImaginary(), api.GetPrincipalAxesAttr().Get().GetReal())
    )
    inertia = axes @ np.diag(api.GetDiagonalInertiaAttr().Get()) @ axes.T
    wanted = body.shape.inertia * body.mass / body.shape.volume
    np.testing.assert_allclose(inertia, wanted, atol=1e-5 * np.abs(wanted).max())
    np.testing.assert_allclose(api.GetCenterOfMassAttr().Get(), body.shape.center_of_mass, atol=1e-6)


def test_each_environment_has_its_own_values_and_belongs_to_its_own_physics(mixed, tmp_path):
    class Varied(Resting):
        def get(self, name):
            factor = np.array([[1.0], [0.5]]) if name in ("gravity", "friction") else 1.0
            return super().get(name) * factor

    sim = Varied(mixed, 2)
    recorder = Recorder(sim, 60.0)
    recorder.capture(sim)
    path = tmp_path / "two.usdc"
    wr.export_usd(recorder.recording(), path, profile="scene")
    with pytest.raises(ValueError, match="several gravities, .*; set root to one of /World/env_0000, /World/env_0001"):
        wr.import_usd(path)
    first, second = (wr.import_usd(path, root, strict=True) for root in ("/World/env_0000", "/World/env_0001"))
    assert_same(mixed, first)
    np.testing.assert_allclose(second.gravity, 0.5 * np.array(mixed.gravity), rtol=1e-6)
    assert [body.friction for body in second.bodies] == pytest.approx([0.5 * body.friction for body in mixed.bodies])
    for kind in (UsdPhysics.ObjectType.RigidBody, UsdPhysics.ObjectType.CubeShape, UsdPhysics.ObjectType.PlaneShape):
        for site, description in parsed(path, kind).items():
            env = site.split("/")[2]
            owners = [str(owner) for owner in description.simulationOwners]
            if kind == UsdPhysics.ObjectType.RigidBody or "rail_1/" in site or "slope" in site:
                assert owners == [f"/World/{env}/PhysicsScene"], site


def changeable():
    """A driven arm, a ball on a cord, a wind, and a pool."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), name="ground")
    arm = scene.add_body(wr.Box((0.2, 0.03, 0.03)), position=(0.2, 0, 1), mass=1.0, name="arm")
    hinge = scene.add_joint(wr.RevoluteJoint((0, 1, 0), limits=(-1.2, 1.0)), arm, anchor=(0, 0, 1), name="hinge")
    scene.add_drive(hinge, stiffness=5.0, damping=0.3)
    ball = scene.add_body(wr.Sphere(0.05), position=(2, 0, 1), mass=0.2, name="ball")
    scene.add_joint(wr.SphericalJoint(), ball, anchor=(2, 0, 1.5), name="cord")
    scene.add_joint(wr.PrismaticJoint((0, 0, 1)), "ball", "arm", name="slide", break_force=900.0)
    scene.add_force_field(wr.DragField(drag=0.1))
    scene.add_force_field(wr.UniformField(acceleration=(0, 0, 0)))
    scene.add_pool(wr.Sphere(0.1), 2, "spare", position=(4, 0, 1))
    return scene


def test_what_was_set_before_the_recording_comes_back(tmp_path):
    """Values of joints and force fields, and which bodies are active, as well as masses: the motion is the same."""
    sim = wr.Simulator(changeable(), num_envs=2, device="cpu")
    sim.set("joint_broken", True, joints=["slide"])
    for name, value in (("target_position", 0.6), ("stiffness", 60.0), ("upper", 0.4), ("friction", 0.2)):
        sim.set(f"joint_{name}", value, envs=[1], joints=["hinge"])
    sim.set("joint_damping", 0.02, envs=[1], joints=["cord"])
    sim.set("field_acceleration", [[(0, 0, 0), (1, 2, 0)]], envs=[1])
    sim.set("field_drag", [[0.5, 0.0]], envs=[1])
    sim.set("active", True, envs=[1], bodies=["spare_1"])
    recording = wr.record(sim, frames=30, fps=60)
    wr.export_usd(recording, tmp_path / "two.usda", profile="scene")
    for env in range(2):
        back = wr.import_usd(tmp_path / "two.usda", f"/World/env_{env:04}")
        assert [body.active for body in back.bodies] == [True, True, True, False, env == 1]
        assert str(back.import_report).endswith("slide: left out: the joint is disabled")
        again = wr.record(wr.Simulator(back, device="cpu"), frames=30, fps=60)
        np.testing.assert_allclose(again.position[:, 0], recording.position[:, env], rtol=0, atol=2e-6)
    assert np.abs(recording.position[-1, 0] - recording.position[-1, 1]).max() > 0.1


def test_a_hinge_that_has_turned_several_times_goes_on(tmp_path):
    """At the start of the recording it is at two turns and a half, on its way to a target and a limit further on."""
    scene = wr.Scene(gravity=(0, 0, 0))
    arm = scene.add_body(wr.Box((0.2, 0.03, 0.03)), position=(0.2, 0, 1), mass=1.0)
    hinge = scene.add_joint(wr.RevoluteJoint((0, 0, 1), limits=(-18.0, 18.0)), arm, anchor=(0, 0, 1))
    scene.add_drive(hinge, stiffness=0.5, damping=0.2, target_position=19.0)
    sim = wr.Simulator(scene, num_envs=2, device="cpu")
    sim.set("joint_target_position", [[19.0], [-16.0]])
    while np.abs(sim.get("joint_position")).min() < 15.0:
        sim.step(4)
    recording = wr.record(sim, frames=60)
    wr.export_usd(recording, tmp_path / "turned.usda", profile="scene")
    for env in range(2):
        back = wr.import_usd(tmp_path / "turned.usda", f"/World/env_{env:04}", strict=True)
        again = wr.record(wr.Simulator(back, device="cpu"), frames=60)
        np.testing.assert_allclose(again.position[:, 0], recording.position[:, env], rtol=0, atol=2e-5)
    assert np.ptp(recording.position, axis=0).max() > 0.03


def test_joints_with_the_world_are_at_the_place_of_their_environment(tmp_path):
    """A pendulum and a weight on a string in three environments, which the file places beside each other."""
    scene = wr.Scene()
    arm = scene.add_body(wr.Box((0.2, 0.03, 0.03)), position=(0.2, 0, 1), name="world")
    scene.add_joint(wr.RevoluteJoint((0, 1, 0)), arm, anchor=(0, 0, 1))
    weight = scene.add_body(wr.Sphere(0.05), position=(1, 0, 1))
    scene.add_joint(wr.DistanceJoint(maximum=0.5), weight, anchor=(1, 0, 1), anchor_b=(1.2, 0, 1.4))
    recording = wr.record(wr.Simulator(scene, num_envs=3, device="cpu"), frames=20)
    wr.export_usd(recording, tmp_path / "three.usda", profile="scene")
    back = wr.import_usd(tmp_path / "three.usda", strict=True)
    sim = wr.Simulator(back, device="cpu")
    start = sim.get("position")[0]
    sim.step(80)
    moved = (sim.get("position")[0] - start).reshape(3, 2, 3)
    np.testing.assert_allclose(moved, recording.position[-1] - recording.position[0], rtol=0, atol=1e-5)
    assert np.ptp(start[:, 0]) > 2.0 and np.abs(moved[:, 0, 2]).min() > 0.1


def test_environments_with_different_rules_are_read_one_at_a_time(tmp_path):
    """Winds that a program has set; and attracting points and bounds, which are at the places of their environments."""
    winds, point, room = wr.Scene(), wr.Scene(), wr.Scene(bounds=((-1, -1, 0), (1, 1, 2)))
    winds.add_force_field(wr.UniformField((0, 0, 0)))
    point.add_force_field(wr.PointField((1, 2, 3), 5.0))
    for scene in (winds, point, room):
        scene.add_body(wr.Sphere(0.1), position=(0, 0, 1))
        sim = wr.Simulator(scene, num_envs=2, device="cpu")
        if scene is winds:
            sim.set("field_acceleration", [[(1, 0, 0)], [(2, 0, 0)]])
        wr.export_usd(wr.record(sim, frames=0), tmp_path / "two.usda", profile="scene")
        with pytest.raises(ValueError, match="force fields or bounds; set root to one of /World/env_0000, /World/env"):
            wr.import_usd(tmp_path / "two.usda")
        back = wr.import_usd(tmp_path / "two.usda", "/World/env_0001", strict=True)
        assert back.bounds == scene.bounds
        assert back.force_fields == ([wr.UniformField((2, 0, 0))] if scene is winds else scene.force_fields)


@pytest.mark.parametrize("suffix", [".usdc", ".usda"])
def test_bounds_come_back(tmp_path, suffix):
    """With what happens to a body that leaves them; where there is no bound, they are infinite."""
    scene = wr.Scene(bounds=((-1, -2, -np.inf), (1, 2, np.inf)), out_of_bounds="remove")
    scene.add_body(wr.Sphere(0.1))
    wr.export_usd(start_of(scene), tmp_path / f"film{suffix}")
    back = wr.import_usd(tmp_path / f"film{suffix}", strict=True)
    assert (back.bounds, back.out_of_bounds) == (scene.bounds, "remove")


@pytest.mark.parametrize("frame", [0, 7, 24])
def test_poses_over_time_are_the_recordings(frame, tmp_path):
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    scene.add_body(wr.Box((0.1, 0.2, 0.3)), position=(1, 2, 3), name="brick")
    recording = wr.record(FakeSimulator(scene), 24, fps=24.0)
    wr.export_usd(recording, tmp_path / "film.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "film.usdc"))
    brick = stage.GetPrimAtPath("/World/env_0000/brick")
    matrix = np.array(UsdGeom.XformCache(frame).GetLocalToWorldTransform(brick)).T
    np.testing.assert_array_equal(matrix[:3, 3].astype(np.float32), recording.position[frame, 0, 1])
    turn = rotation_matrix(recording.orientation[frame, 0, 1].astype(float))
    np.testing.assert_allclose(matrix[:3, :3], turn, atol=3e-7)


def test_small_films_are_scenes_and_large_ones_animations(tmp_path):
    def instancers(count, **options):
        scene = wr.Scene()
        for i in range(count):
            scene.add_body(wr.Sphere(0.1), position=(i, 0, 0))
        wr.export_usd(start_of(scene), tmp_path / "film.usdc", **options)
        stage = Usd.Stage.Open(str(tmp_path / "film.usdc"))
        return sum(prim.IsA(UsdGeom.PointInstancer) for prim in stage.Traverse())

    assert instancers(3) == 0 and instancers(2001) == 1
    assert instancers(3, profile="animation") == 1


def test_a_saved_recording_has_no_physics_but_a_film(tmp_path):
    scene = scenes.load("box_stack")
    start_of(scene).save(tmp_path / "run.npz")
    loaded = wr.Recording.load(tmp_path / "run.npz")
    wr.export_usd(loaded, tmp_path / "film.usdc")
    assert check_usd(tmp_path / "film.usdc") == []
    with pytest.raises(ValueError, match="profile: requires masses and materials"):
        wr.export_usd(loaded, tmp_path / "film.usdc", profile="scene")
