"""Values that are no numbers of the simulator: refused with one line, wherever they are given."""

import json
import os

import numpy as np
import pytest

import warp_rigid as wr

HUGE = 10**400
MASKED = np.ma.array(0.5, mask=True)


@pytest.fixture
def sim():
    """A ball that turns about a hinge, above a plane."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), name="ground")
    ball = scene.add_body(wr.Sphere(0.1), position=(0, 0, 1), name="ball")
    scene.add_joint(wr.RevoluteJoint((0, 0, 1), (-1, 1)), ball, anchor=(0, 0, 1))
    scene.add_pool(wr.Sphere(0.1), 1, "spare")
    return wr.Simulator(scene, device="cpu")


def told_by(act):
    """The message of the refusal, one line."""
    with pytest.raises(ValueError) as error:
        act()
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("value", [HUGE, -HUGE, 1 + 2j, [1, 2j], [True, 0.5], "x", None, MASKED])
@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda value: wr.RevoluteJoint((0, 0, 1), (-1, value)), "limits"),
        (lambda value: wr.Scene(bounds=((0, 0, 0), (1, 1, value))), "bounds"),
        (lambda value: wr.Compound([], (0, 0, 0), value), "inertia_per_mass"),
        (lambda value: wr.Heightfield(np.zeros((2, 2)), (1, 1), wr.HarmonicMotion(value, 1.0)), "amplitude"),
        (lambda value: wr.Mesh(np.eye(3), value), "faces"),
        (lambda value: wr.Sphere(1.0).signed_distance(value), "points"),
        (lambda value: wr.Sphere(value), "radius"),
    ],
)
def test_what_is_no_number_is_told_by_its_name(make, name, value):
    if not (name == "inertia_per_mass" and value is None):
        assert told_by(lambda: make(value)).startswith(f"{name}: must be ")


@pytest.mark.parametrize("name", ["friction", "linear_velocity", "gravity"])
def test_half_precision_infinity_is_refused(sim, name):
    """The largest number of single precision is itself infinite in half precision, as of networks in PyTorch."""
    infinite = np.full(3 if sim.get(name).shape[-1] == 3 else (), np.inf, np.float16)
    assert told_by(lambda: sim.set(name, infinite)) == f"{name}: must be finite numbers, got inf"


def test_a_cone_in_degrees_is_refused():
    """It would never be reached; the same holds for the argument of the joint."""
    scene = wr.Scene()
    scene.add_joint(wr.SphericalJoint(1.0), scene.add_body(wr.Sphere(0.1)), name="shoulder")
    scene.add_joint(wr.RevoluteJoint((0, 0, 1), (-1, 1)), scene.add_body(wr.Sphere(0.1)), name="crank")
    sim = wr.Simulator(scene, device="cpu")
    told = "joint_upper: must be at most pi, or inf, for shoulder, a SphericalJoint, got 45"
    assert told_by(lambda: sim.set("joint_upper", 45, joints="shoulder")) == told
    sim.set("joint_upper", [np.pi, 45.0])
    sim.set("joint_upper", np.inf)


@pytest.mark.parametrize("limits", [(-1e39, 0.0), (0.0, 1e39), (-1e300, 1e300)])
def test_limits_that_single_precision_cannot_hold_are_refused(limits, sim):
    """Infinite ones are allowed; larger numbers would become infinite, or NaN where they are subtracted."""
    assert told_by(lambda: wr.RevoluteJoint((0, 0, 1), limits)).startswith("limits: must be up to 3.40282e+38")
    assert told_by(lambda: sim.set("joint_upper", 1e39)) == "joint_upper: must be up to 3.40282e+38 or infinite"
    assert told_by(lambda: sim.set("joint_stiffness", 1e39)) == "joint_stiffness: must be up to 3.40282e+38"
    assert wr.RevoluteJoint((0, 0, 1), (-np.inf, np.inf)).limits == (-np.inf, np.inf)
    sim.set("joint_upper", np.inf)
    assert sim.get("joint_upper")[0, 0] == np.inf


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("sleeping", np.array(1.0), "sleeping: must be True or False, got 1.0"),
        ("sleeping", np.ma.array(True, mask=True), "sleeping: must be True or False, got "),
        ("friction", [0.5, True, 0.5], "friction: must be"),
        ("contact_iterations", np.array(2.5), "contact_iterations: must be a whole number from 0 to 10000, got 2.5"),
        ("shock_propagation", np.array("on"), "shock_propagation: must be one of off, one_pass, two_pass, got 'on'"),
    ],
)
def test_a_setting_is_one_value_or_several(sim, name, value, told):
    assert told_by(lambda: sim.set(name, value)).startswith(told)
    sim.set("sleeping", np.array(True))
    sim.set("contact_iterations", np.array(7))
    assert sim.get("sleeping")[0] and sim.get("contact_iterations")[0] == 7


@pytest.mark.parametrize(
    "act",
    [
        lambda sim: sim.set("friction", MASKED),
        lambda sim: sim.set("friction", np.ma.array([0.5, 0.6, 0.7], mask=[0, 1, 0])),
        lambda sim: sim.set("mass", MASKED, bodies=[1]),
        lambda sim: sim.set("active", np.ma.array([True, True, True], mask=[0, 1, 0])),
        lambda sim: sim.set("joint_target_position", MASKED),
        lambda sim: sim.set("friction", 0.5, bodies=np.ma.array([0, 1], mask=[False, True])),
        lambda sim: sim.reset(envs=np.ma.array([0], mask=[True])),
        lambda sim: sim.spawn("spare", np.ma.array([0.0, 0.0, 2.0], mask=[1, 0, 0])),
        lambda sim: sim.apply_impulse(np.ma.array([0.0, 0.0, 2.0], mask=[1, 0, 0]), (0, 0, 1), "ball"),
    ],
)
def test_masked_values_are_no_values(sim, act):
    before = {name: sim.get(name).tobytes() for name in ("friction", "mass", "active", "joint_target_position")}
    told_by(lambda: act(sim))
    assert before == {name: sim.get(name).tobytes() for name in before}
    sim.set("friction", np.ma.array([0.5, 0.6, 0.7], mask=False))
    np.testing.assert_array_equal(sim.get("friction")[0], np.float32([0.5, 0.6, 0.7]))


def test_a_mesh_waits_for_no_named_pipe(tmp_path):
    """The buffer of a glTF file, which is refused; the materials of an OBJ file, which are not needed."""
    os.mkfifo(tmp_path / "pipe")
    gltf = {"asset": {"version": "2.0"}, "buffers": [{"uri": "pipe", "byteLength": 100}], "meshes": [], "nodes": []}
    (tmp_path / "pipe.gltf").write_text(json.dumps(gltf))
    assert told_by(lambda: wr.Mesh.from_file(tmp_path / "pipe.gltf")).endswith("pipe: must be a regular file")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "pipe.obj").write_text("mtllib pipe\n" + corners)
    assert len(wr.Mesh.from_file(tmp_path / "pipe.obj").faces) == 4
