"""Checkpoints: an exact restart from one file, and one clear line for any other file."""

import io
import json
import pickle
import re
import zipfile

import numpy as np
import pytest

import warp_rigid as wr
from tests.oracles import random_pile, rotate_about, stages_of
from warp_rigid.engine.checkpoint import VERSION
from warp_rigid.engine.simulator import Simulator
from warp_rigid.kernels.collide.pair_contacts import ContactKey
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.serialization import scenes_from_data, scenes_to_data
from warp_rigid.scenes.builders import meshes

STATE = ("position", "orientation", "linear_velocity", "angular_velocity", "force", "torque", "level")


def bits(sim):
    return [sim.get(name).tobytes() for name in STATE] + [sim.contacts().tobytes(), sim.status().tobytes()]


def every_shape():
    """A scene with a body of every shape, every motion and every kind of field."""
    scene = wr.Scene(gravity=(0.1, 0, -9), friction_combine="average", restitution_combine="max")
    scene.add_static(wr.Plane(normal=(0.1, 0.2, 1.0), offset=-0.3), friction=0.7, name="ground")
    scene.add_static(wr.Heightfield(np.random.default_rng(0).random((4, 5)) * 0.1, (2.0, 3.0)), position=(3, 0, 0))
    table = wr.Compound(
        [(wr.Box((0.5, 0.5, 0.05)), (0, 0, 0), (0, 0, 0, 1)), (wr.Sphere(0.1), (0, 0, 0.1), (0, 0, 3, 1))]
    )
    scene.add_kinematic(table, position=(0, 0, 0.5), angular_velocity=(0, 0, 1))
    both = wr.Compound([(table, (0, 0, 0), (0.1, 0.2, 0.3, 0.4)), (wr.Capsule(0.05, 0.1), (0, 0, 1), (0, 0, 0, 1))])
    mesh = meshes.tetrahedron(sdf_resolution=16)
    for k, shape in enumerate((wr.Sphere(0.1), wr.Capsule(0.1, 0.1), wr.Cylinder(0.1, 0.1), both, mesh, mesh)):
        scene.add_body(
            shape,
            position=(0.3 * k - 0.6, 0.1 * k, 1.2),
            orientation=rotate_about((1, 2, 3), 1 + 29 * k),
            restitution=0.1,
        )
    scene.add_force_field(wr.UniformField((0.1, 0, 0)))
    scene.add_force_field(wr.PointField((0, 0, -5), 2.0))
    scene.filter_pair(3, 4)
    return scene


def busy(device):
    """Two environments that differ in all that can be set, stepped until things touch."""
    settings = wr.Settings(dt=1 / 200, contact_iterations=7)
    sim = Simulator(every_shape(), num_envs=2, settings=settings, device=device, seed=5)
    sim.set("mass", 3.0, envs=[1], bodies=[4])
    sim.set("friction", 0.9, envs=[1])
    sim.set("shock_propagation", ["one_pass", "two_pass"])
    sim.set("shock_iterations", [1, 2])
    sim.set("gravity", (0, 0, -5), envs=[1])
    sim.set("force", (0.1, 0, 0), bodies=[5])
    sim.step(100)
    return sim


def test_a_loaded_run_goes_on_bit_for_bit(device, tmp_path):
    sim = busy(device)
    assert len(sim.contacts()) > 5
    sim.save(tmp_path / "new" / "a.ckpt")
    loaded = Simulator.load(tmp_path / "new" / "a.ckpt")
    assert str(loaded.device) == str(sim.device)
    assert (loaded.time, loaded.seed, loaded.settings) == (sim.time, sim.seed, sim.settings)
    assert bits(loaded) == bits(sim)
    for name in ("mass", "inertia", "friction", "gravity", "shock_propagation", "shock_iterations", "kinetic_energy"):
        assert loaded.get(name).tobytes() == sim.get(name).tobytes(), name
    assert loaded.penetration().tobytes() == sim.penetration().tobytes()
    for one in (sim, loaded):
        one.step(60)
    assert bits(loaded) == bits(sim)
    loaded.reset()
    fresh = Simulator(every_shape(), num_envs=2, settings=sim.settings, device=device)
    assert loaded.get("position").tobytes() == fresh.get("position").tobytes()
    assert loaded.get("orientation").tobytes() == fresh.get("orientation").tobytes()


def test_contacts_without_samples_come_back(device, tmp_path):
    """Bodies deep in each other touch along an axis or, unless both are convex, by a ball inside one of them.

    Arms that cross come apart along a direction that they keep.
    """
    scene = wr.Scene(gravity=(0, 0, 0))
    thick = wr.Compound([(wr.Box((half, half, half)), (0, 0, 0), (0, 0, 0, 1)) for half in (0.1, 0.01)])
    pair, convex = 2 * (thick,), 2 * (meshes.octahedron(0.1, 16),)
    bar = wr.Box((0.2, 0.03, 0.03))
    corner = wr.Compound([(bar, (0, 0, 0), (0, 0, 0, 1)), (bar, (0.17, 0, 0.17), rotate_about((0, 1, 0), 90))])
    scene.add_body(corner, position=(3, 0, 0))
    scene.add_body(corner, position=(2.9, 0.1, 0), orientation=rotate_about((0, 0, 1), 90))
    for place, (shapes, apart) in enumerate(((pair, 0.004), (convex, 0.03))):
        for k, shape in enumerate(shapes):
            scene.add_body(shape, position=(place + apart * k, 0.3 * apart * k, 0.6 * apart * k))
    sim = Simulator(scene, device=device)
    sim.step()
    keys = stages_of(sim).pools.history.key.numpy()[: sim.counts()["contacts"]]
    assert {ContactKey.BY_CENTER, ContactKey.BY_AXIS} == set(keys[keys < 0].tolist())
    assert stages_of(sim).pools.history.axis.numpy()[0].any()
    sim.save(tmp_path / "a.ckpt")
    loaded = Simulator.load(tmp_path / "a.ckpt")
    for one in (sim, loaded):
        one.step(10)
    assert bits(loaded) == bits(sim)


def test_a_failed_environment_and_the_pools_come_back(device, tmp_path):
    scene = random_pile(np.random.default_rng(3))
    room = {"pairs": 500, "contacts": 3000}
    sim = Simulator(scene, num_envs=2, device=device, on_overflow="raise", capacity=room, memory_limit=10**9)
    sim.step(3)
    velocity = sim.array("linear_velocity")
    host = velocity.numpy().copy()
    host[4] = np.nan
    velocity.assign(host)
    sim.step(20)
    sim.save(tmp_path / "a.ckpt")
    loaded = Simulator.load(tmp_path / "a.ckpt")
    assert loaded.status().tolist() == sim.status().tolist() and sim.status()["status"][0] == "non-finite"
    assert loaded.counts() == sim.counts()
    assert loaded.on_overflow == "raise"
    loaded.step(5)
    sim.step(5)
    assert bits(loaded) == bits(sim)


def test_scenes_survive_as_plain_data():
    """All of a scene, through JSON, twice."""
    scene = every_shape()
    for _ in range(2):
        data, arrays = scenes_to_data([scene])
        (again,) = scenes_from_data(json.loads(json.dumps(data)), arrays)
        assert again.bodies == scene.bodies
        assert again.force_fields == scene.force_fields
        assert again.filtered_pairs == scene.filtered_pairs == {(3, 4)}
        assert (again.gravity, again.friction_combine, again.restitution_combine) == (
            scene.gravity,
            scene.friction_combine,
            scene.restitution_combine,
        )
        scene = again


def test_a_repaired_mesh_is_not_repaired_again(tmp_path):
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1]]
    with pytest.warns(UserWarning, match="repaired"):
        mesh = wr.Mesh(vertices, [[0, 2, 1], [0, 1, 3], [0, 4, 2], [1, 2, 3]], sdf_resolution=8)
    scene = wr.Scene()
    scene.add_body(mesh)
    (saved,) = scenes_from_data(*scenes_to_data([scene]))
    again = saved.bodies[0].shape
    assert again.repairs == mesh.repairs != []
    assert again.grid.values.tobytes() == mesh.grid.values.tobytes()
    assert again.key == mesh.key


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoint") / "a.ckpt"
    sim = Simulator(random_pile(np.random.default_rng(0)), num_envs=2, device="cpu")
    sim.step(10)
    sim.save(path)
    return path


def refused(path):
    with pytest.raises(ValueError) as error:
        Simulator.load(path)
    text = str(error.value)
    assert text.startswith(f"{path}: not a checkpoint of warp_rigid") and "\n" not in text and len(text) < 400
    return text


def test_a_truncated_file_is_refused(saved, tmp_path):
    content = saved.read_bytes()
    for size in (0, 1, 100, len(content) // 2, len(content) - 1):
        path = tmp_path / f"cut_{size}"
        path.write_bytes(content[:size])
        refused(path)


def test_a_changed_byte_is_noticed(saved, tmp_path):
    """In the middle of the largest array."""
    with zipfile.ZipFile(saved) as file:
        largest = max(file.infolist(), key=lambda member: member.compress_size)
    content = bytearray(saved.read_bytes())
    content[largest.header_offset + len(largest.FileHeader()) + largest.compress_size // 2] ^= 1
    path = tmp_path / "changed"
    path.write_bytes(content)
    assert "CRC" in refused(path)


def test_foreign_files_are_refused(saved, tmp_path):
    path = tmp_path / "foreign"
    path.write_text("not a zip")
    refused(path)
    np.savez(path.with_suffix(".npz"), a=np.zeros(3))
    refused(path.with_suffix(".npz"))
    sim = Simulator.load(saved)
    wr.record(sim, 1).save(path)
    assert "another kind" in refused(path)
    with pytest.raises(FileNotFoundError):
        Simulator.load(tmp_path / "missing")


def members(path):
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def rewritten(path, parts):
    with zipfile.ZipFile(path, "w") as file:
        for name, content in parts.items():
            file.writestr(name, content)
    return path


def npy(array):
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def with_header(saved, path, change):
    parts = members(saved)
    header = json.loads(np.load(io.BytesIO(parts["header.npy"])).tobytes())
    change(header)
    parts["header.npy"] = npy(np.frombuffer(json.dumps(header).encode(), np.uint8))
    return rewritten(path, parts)


def test_a_newer_version_is_told(saved, tmp_path):
    path = with_header(saved, tmp_path / "newer", lambda header: header.update(version=99))
    assert f"version must be {VERSION}, got 99" in refused(path)


def test_other_thresholds_are_named(saved, tmp_path, caplog):
    Simulator.load(saved, device="cpu")
    assert not caplog.records
    path = with_header(saved, tmp_path / "other", lambda header: header["thresholds"].update(CONVERGED=1.0))
    Simulator.load(path, device="cpu")
    (record,) = caplog.records
    assert "other thresholds: CONVERGED; results differ" in record.getMessage()
    path = with_header(saved, tmp_path / "older", lambda header: header.pop("thresholds"))
    Simulator.load(path, device="cpu")
    assert len(caplog.records) == 1


@pytest.mark.parametrize("name", ["restitution", "surface_velocity"])
def test_a_file_without_a_coefficient_gets_its_default(saved, tmp_path, name):
    def forget(header):
        for body in header["scenes"][0]["bodies"]:
            del body[name]

    path = with_header(saved, tmp_path / "older", forget)
    parts = members(path)
    assert parts.pop(f"Bodies.{name}.npy")
    sim = Simulator.load(rewritten(tmp_path / "older", parts), device="cpu")
    assert (sim.get(name) == (COEFFICIENTS[name].default if name in COEFFICIENTS else 0.0)).all()
    del parts["Bodies.friction.npy"]
    assert "Bodies.friction" in refused(rewritten(tmp_path / "damaged", parts))


@pytest.mark.parametrize(
    "change",
    [
        lambda h: h.pop("scenes"),
        lambda h: h.update(num_envs=10_000_000),
        lambda h: h.update(num_envs="many"),
        lambda h: h.update(seed=-1),
        lambda h: h["settings"].update(dt=-1.0),
        lambda h: h["settings"].update(more=1),
        lambda h: h["scenes"][0]["bodies"][0].update(shape=99),
        lambda h: h["scenes"][0]["bodies"][0].update(orientation=[0, 0, 0, 7]),
        lambda h: h["shapes"][0].update(key="0"),
        lambda h: h["scenes"][0]["bodies"].clear(),
        lambda h: h["scenes"][0].update(filtered_pairs=[[0, 99]]),
        lambda h: h["used"].update(contacts=3),
        lambda h: h.update(steps=None),
        lambda h: h.update(fitted=[]),
        lambda h: h.update(fitted=[1, 2, 3]),
    ],
)
def test_a_header_that_does_not_fit_is_refused(saved, tmp_path, change):
    refused(with_header(saved, tmp_path / "changed", change))


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("State.position", np.zeros((1, 3), np.float32)),
        ("State.position", np.zeros((38, 3), np.float64)),
        ("History.pair_start", None),
        ("History.body_b", None),
        ("History.key", None),
        ("Environments.contact_iterations", np.full(2, 2**30, np.int32)),
        ("Environments.shock_propagation", np.full(2, 3, np.int32)),
        ("Environments.warm_starting", np.full(2, 2, np.int32)),
    ],
)
def test_arrays_that_the_kernels_could_not_trust_are_refused(saved, tmp_path, name, array):
    parts = members(saved)
    if array is None:
        array = np.load(io.BytesIO(parts[f"{name}.npy"])).copy()
        array[len(array) // 2] = 10**6
    parts[f"{name}.npy"] = npy(array)
    assert name.partition(".")[2] in refused(rewritten(tmp_path / "changed", parts))


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("Bodies.mass", -1.0, "mass: must be a number from 1e-17 to 1e.15, got -1.0"),
        ("Bodies.mass", 7.0, "Bodies.inverse_mass must follow from the masses"),
        ("Bodies.inertia", np.nan, "Bodies.inertia must follow from the masses"),
        ("Bodies.friction", -0.5, "friction: must be >= 0, got -0.5"),
        ("Bodies.restitution", np.nan, "Bodies.restitution must be finite numbers"),
        ("Environments.gravity", np.inf, "Environments.gravity must be finite numbers"),
        ("Environments.failed_body", 10**6, "Environments.failed_body must be from 0 to "),
        ("Environments.step", -1, "Environments.step must be from 0 to "),
        ("State.active", 2, "State.active must be from 0 to 1"),
        ("State.orientation", 0.0, "State.orientation must be quaternions of length 1"),
    ],
)
def test_values_that_no_simulator_writes_are_refused(saved, tmp_path, name, value, told):
    """In the row of the last body, which is dynamic, or of the last environment."""
    parts = members(saved)
    array = np.load(io.BytesIO(parts[f"{name}.npy"])).copy()
    array[-1] = value
    parts[f"{name}.npy"] = npy(array)
    assert re.search(told, refused(rewritten(tmp_path / "changed", parts)))


@pytest.mark.parametrize(
    ("name", "place", "value", "told"),
    [
        ("FieldForces.parameters", (0, 0), np.nan, "acceleration: must be 3 finite numbers"),
        ("Joints.numbers", (0, 0), 2.0, "the lower limits must be at most the upper ones"),
        ("Joints.numbers", (0, 2), -1.0, "joint_friction: must be finite numbers >= 0"),
        ("Joints.broken", (0,), 2, "Joints.broken must be from 0 to 1"),
    ],
)
def test_values_of_fields_and_joints_are_checked(tmp_path, name, place, value, told):
    scene = wr.Scene()
    scene.add_joint(wr.RevoluteJoint((0, 0, 1), (-1, 1)), scene.add_body(wr.Sphere(0.1)))
    scene.add_force_field(wr.UniformField((1, 0, 0)))
    sim = Simulator(scene, device="cpu")
    sim.save(tmp_path / "good")
    parts = members(tmp_path / "good")
    array = np.load(io.BytesIO(parts[f"{name}.npy"])).copy()
    array[place] = value
    parts[f"{name}.npy"] = npy(array)
    assert told in refused(rewritten(tmp_path / "changed", parts))


class Trap:
    """Would tell that it was unpickled."""

    sprung = False

    def __reduce__(self):
        return (setattr, (Trap, "sprung", True))


def test_nothing_in_a_file_is_run(saved, tmp_path):
    assert pickle.loads(pickle.dumps(Trap())) is None and Trap.sprung
    Trap.sprung = False
    parts = members(saved)
    parts["State.position.npy"] = npy(np.array([Trap()], dtype=object))
    refused(rewritten(tmp_path / "trap", parts))
    assert not Trap.sprung
