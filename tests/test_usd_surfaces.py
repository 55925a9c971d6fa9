"""Running surfaces in USD: the attributes of PhysX, in every unit and frame, without its schema installed."""

import numpy as np
import pytest
from pxr import Usd

import warp_rigid as wr
from tests.oracles import rotate_about
from tests.usd_tools import moved, rigid, start_of, validator_errors, write_stage
from warp_rigid import rotations

API = "PhysxSurfaceVelocityAPI"
KINEMATIC = "bool physics:kinematicEnabled = 1;"
BELT = "vector3f physxSurfaceVelocity:surfaceVelocity = (1, 0, 0); "
TURN = "vector3f physxSurfaceVelocity:surfaceAngularVelocity = (0, 0, 90); "
WORLD = "bool physxSurfaceVelocity:surfaceVelocityLocalSpace = 0; "
TURNED = (
    "float xformOp:rotateZ = 90; double3 xformOp:translate = (0, 0, 5); "
    'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]'
)


def imported(tmp_path, values, apis=(API,), **units):
    path = write_stage(tmp_path / "file.usda", rigid("Belt", "Cube", values, apis), **units)
    return wr.import_usd(path, strict=True).bodies[0]


def world_velocity(body):
    return rotations.rotate(body.orientation, body.surface_velocity)


def test_velocities_in_the_frame_of_the_body(tmp_path):
    """The default space is that of the body; angles are in degrees."""
    body = imported(tmp_path, KINEMATIC + BELT + TURN + TURNED)
    np.testing.assert_allclose(body.surface_velocity, (1, 0, 0), atol=1e-6)
    np.testing.assert_allclose(world_velocity(body), (0, 1, 0), atol=1e-6)
    np.testing.assert_allclose(body.surface_angular_velocity, (0, 0, np.pi / 2), atol=1e-6)


def test_velocities_in_the_world(tmp_path):
    body = imported(tmp_path, KINEMATIC + WORLD + BELT + TURNED)
    np.testing.assert_allclose(body.surface_velocity, (0, -1, 0), atol=1e-6)
    np.testing.assert_allclose(world_velocity(body), (1, 0, 0), atol=1e-6)


@pytest.mark.parametrize("space", ["", WORLD])
def test_velocities_in_units_and_axes_of_the_file(tmp_path, space):
    """Centimetres, and y up: a belt along -z of the file runs along y of the scene."""
    belt = "vector3f physxSurfaceVelocity:surfaceVelocity = (0, 0, -50); "
    body = imported(tmp_path, KINEMATIC + space + belt + moved(0, 0, 0), up="Y", meters=0.01)
    np.testing.assert_allclose(world_velocity(body), (0, 0.5, 0), atol=1e-6)


def test_a_scale_stretches_velocities_of_the_body_only(tmp_path):
    """As PhysX does."""
    scale = 'float3 xformOp:scale = (3, 1, 1); uniform token[] xformOpOrder = ["xformOp:scale"]'
    for space, speed in (("", 3.0), (WORLD, 1.0)):
        body = imported(tmp_path, KINEMATIC + space + BELT + scale)
        np.testing.assert_allclose(body.surface_velocity, (speed, 0, 0), atol=1e-6)


def test_what_is_not_enabled_does_not_run(tmp_path):
    off = "bool physxSurfaceVelocity:surfaceVelocityEnabled = 0; "
    for values, apis in ((off + BELT, (API,)), ("", (API,)), (BELT, ())):
        assert imported(tmp_path, KINEMATIC + values, apis).surface_velocity == (0, 0, 0)


def test_static_colliders_run_too(tmp_path):
    """About the origin of the prim, also where the shape has another frame: a cylinder along x."""
    text = f'def Cylinder "Roll" (\n prepend apiSchemas = ["PhysicsCollisionAPI", "{API}"]\n)\n{{\n'
    text += ' uniform token axis = "X"\n double radius = 0.2\n double height = 1\n'
    text += (BELT + TURN).replace("; ", "\n") + "}\n"
    body = wr.import_usd(write_stage(tmp_path / "file.usda", text), strict=True).bodies[0]
    assert body.motion == wr.Motion.STATIC
    np.testing.assert_allclose(world_velocity(body), (1, 0, 0), atol=1e-6)
    spin = rotations.rotate(body.orientation, body.surface_angular_velocity)
    np.testing.assert_allclose(spin, (0, 0, np.pi / 2), atol=1e-6)


def test_the_surface_of_a_dynamic_body_is_reported(tmp_path):
    path = write_stage(tmp_path / "file.usda", rigid("Belt", "Cube", BELT, (API,)))
    with pytest.warns(UserWarning):
        scene = wr.import_usd(path)
    (finding,) = scene.import_report.left_out
    assert finding.path == "/World/Belt"
    with pytest.raises(ValueError, match="static or kinematic"):
        wr.import_usd(path, strict=True)


def test_surfaces_are_written_and_read_again(tmp_path):
    scene = wr.Scene()
    turn = rotate_about((1, 2, 3), 50)
    motion = {"surface_velocity": (0.5, -1, 0.25), "surface_angular_velocity": (0.1, 0.2, -3)}
    scene.add_static(wr.Box((1, 2, 0.1)), position=(1, 2, 3), orientation=turn, name="static", **motion)
    scene.add_kinematic(wr.Cylinder(0.3, 0.1), orientation=turn, name="kinematic", **motion)
    scene.add_static(wr.Plane(), name="still")
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 5), name="ball")
    wr.export_usd(start_of(scene), tmp_path / "file.usda", profile="scene")
    stage = Usd.Stage.Open(str(tmp_path / "file.usda"))
    runs = [prim.GetName() for prim in stage.Traverse() if API in prim.GetPrimTypeInfo().GetAppliedAPISchemas()]
    assert sorted(runs) == ["kinematic", "static"]
    read = wr.import_usd(tmp_path / "file.usda", strict=True)
    for body in scene.bodies:
        again = read.bodies[read.index(body.name)]
        np.testing.assert_allclose(again.surface_velocity, body.surface_velocity, atol=1e-6)
        np.testing.assert_allclose(again.surface_angular_velocity, body.surface_angular_velocity, atol=1e-6)
    assert validator_errors(tmp_path / "file.usda") == []


def test_the_velocities_of_each_environment_are_written(device, tmp_path):
    """Those that were set, not those of the scene."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), name="belt")
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 0.1))
    sim = wr.Simulator(scene, num_envs=2, device=device)
    sim.set("surface_velocity", np.array([[[1.0, 0, 0]], [[0, 2.0, 0]]]), bodies=["belt"])
    recording = wr.record(sim, frames=2, fps=60)
    for env, velocity in ((0, (1, 0, 0)), (1, (0, 2, 0))):
        wr.export_usd(recording, tmp_path / "file.usda", envs=[env], profile="scene")
        assert wr.import_usd(tmp_path / "file.usda", strict=True).bodies[0].surface_velocity == velocity
