"""Hints on units: given once where they are probably wrong, and never on the built-in scenes."""

import warnings

import numpy as np
import pytest
import trimesh
from PIL import Image

import warp_rigid as wr
from warp_rigid.commands import cli
from warp_rigid.engine.hints import hints_on
from warp_rigid.engine.quantities import SETTABLE, owner_of


def hinted(act):
    """Messages of the warnings of a call."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("default", UserWarning)
        act()
    return [str(one.message) for one in found if one.category is UserWarning]


def hinge(limits):
    scene = wr.Scene()
    scene.add_body(wr.Box((0.1, 0.1, 0.1)), name="lever")
    scene.add_joint(wr.RevoluteJoint((0, 1, 0), limits=limits), "lever", name="elbow")
    return scene


@pytest.mark.parametrize(
    ("limits", "count"),
    [
        ((-90, 90), 1),
        ((0.0, 45.0), 1),
        ((-np.inf, 170.0), 1),
        ((-np.pi, np.pi), 0),
        ((-2 * np.pi, 2 * np.pi), 0),
        ((-np.inf, np.inf), 0),
        (None, 0),
    ],
)
def test_limits_beyond_a_full_turn(limits, count):
    scene = hinge(limits)
    found = hinted(lambda: [wr.Simulator(scene, device="cpu") for _ in range(3)])
    assert len(found) == count and all("elbow" in text and "np.radians" in text for text in found)


@pytest.mark.parametrize(("target", "stiffness", "count"), [(90.0, 10.0, 1), (-6.0, 10.0, 0), (90.0, 0.0, 0)])
def test_targets_beyond_a_full_turn(target, stiffness, count):
    scene = hinge(None)
    scene.add_drive(0, stiffness=stiffness, damping=1.0, target_position=target)
    found = hints_on([scene], 1 / 240)
    assert len(found) == count and all("elbow" in text and "np.radians(90)" in text for text in found)


def test_orientations_in_degrees_are_named_once_for_a_place():
    """A loop in a program, the values of an axis, and the environments whose scenes a batch builds again."""
    scene = wr.Scene()
    places = [lambda angle: scene.add_body(wr.Sphere(0.1), orientation=(0, 0, angle, 0))]
    places += [lambda angle: wr.Compound([(wr.Sphere(0.1), (0, 0, 0), (0, 0, angle, 0))] * 3)]

    def turned(angle=30.0):
        made = wr.Scene()
        made.add_body(wr.Sphere(0.1), orientation=(0, 0, angle, 0))
        return made

    places += [lambda angle: wr.sweep(turned, {"angle": [angle, angle + 1.0]}, duration=0.01, device="cpu")]
    for place in places:
        found = hinted(lambda place=place: [place(angle) for angle in (30.0, 60.0, 90.0)])
        assert len(found) == 1 and "orientation: a quaternion" in found[0]


@pytest.mark.parametrize(
    ("orientation", "count"), [((0, 0, 90, 0), 1), ((45.0, 0, 0, 1), 1), ((0, 0, 1, 1), 0), ((1, 1, 1, 1), 0)]
)
def test_orientations_in_degrees(orientation, count):
    found = hinted(lambda: wr.Scene().add_body(wr.Sphere(0.1), orientation=orientation))
    assert len(found) == count and all(text.startswith("orientation: ") for text in found)


@pytest.mark.parametrize(
    ("size", "other", "motion", "words"),
    [
        (50.0, 0.2, "add_body", "250 times"),
        (5.0, 0.02, "add_kinematic", "250 times"),
        (0.001, 0.2, "add_body", "1/200 of"),
        (10.0, 0.2, "add_body", None),
        (50.0, 0.2, "add_static", None),
        (50.0, None, "add_body", None),
    ],
)
def test_meshes_of_another_size_than_the_other_bodies(size, other, motion, words):
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    box = trimesh.creation.box((size, size / 2, size / 2))
    getattr(scene, motion)(wr.Mesh(box.vertices, box.faces, 8), name="part")
    for i in range(0 if other is None else 3):
        scene.add_body(wr.Box((other / 2,) * 3), position=(100 + i, 0, 0))
    found = hints_on([scene], 1 / 240)
    assert len(found) == (words is not None)
    assert all(words in text and "body part" in text and "scale=" in text for text in found)


def test_a_mesh_of_another_unit_is_named_before_its_mass_is_refused():
    scene = wr.Scene()
    box = trimesh.creation.box((5, 4, 2))
    scene.add_body(wr.Mesh(box.vertices, box.faces, 8), position=(0, 0, 3), name="part")
    scene.add_body(wr.Sphere(0.02))

    def refused():
        with pytest.raises(ValueError, match="mass: the heaviest dynamic body"):
            wr.Simulator(scene, device="cpu")

    (found,) = hinted(refused)
    assert "body part: its mesh is 5 m long" in found and "0.001 for mm" in found


def test_an_image_that_no_shape_shows(tmp_path):
    Image.new("RGB", (2, 2)).save(tmp_path / "image.png")
    scene = wr.Scene()
    box = trimesh.creation.box((1, 1, 1))
    for name, shape in (("a", wr.Mesh(box.vertices, box.faces, 8, uv=box.vertices[:, :2])), ("b", wr.Box((1, 1, 1)))):
        scene.looks[scene.add_body(shape, name=name)] = wr.Look(image=tmp_path / "image.png")
    (found,) = hinted(lambda: wr.Simulator(scene, device="cpu"))
    assert found.startswith("body b: the image of its look is not shown")
    del scene.looks[1]
    assert hints_on([scene], 1 / 240) == []


def test_a_slide_of_many_metres_is_no_hinge():
    scene = wr.Scene()
    scene.add_body(wr.Box((0.1, 0.1, 0.1)))
    scene.add_joint(wr.PrismaticJoint((0, 1, 0), limits=(-90, 90)), 0)
    assert hints_on([scene], 1 / 240) == []


@pytest.mark.parametrize(
    ("dt", "moving", "words"),
    [
        (1 / 240, {"linear_velocity": (100.0, 0, 0)}, "moves by 2.1 times"),
        (1 / 240, {"linear_velocity": (40.0, 0, 0)}, None),
        (1 / 60, {"linear_velocity": (40.0, 0, 0)}, "moves by 3.3 times"),
        (0.2, {}, "moves by 2 times"),
        (1 / 60, {}, None),
        (1 / 60, {"angular_velocity": (0, 0, 120.0)}, "turns by 2 rad"),
        (1 / 240, {"angular_velocity": (0, 0, 120.0)}, None),
        (1 / 60, {"linear_velocity": (40.0, 0, 0), "active": False}, None),
    ],
)
def test_steps_that_do_not_resolve_the_start(dt, moving, words):
    """A ball of 0.2 m: v dt + g dt^2 over its size, and omega dt."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    scene.add_body(wr.Sphere(0.1), name="ball", position=(0, 0, 1), **moving)
    found = hinted(lambda: wr.Simulator(scene, settings=wr.Settings(dt=dt), device="cpu"))
    assert len(found) == (words is not None) and all(words in text and "ball" in text for text in found)


@pytest.mark.parametrize(("seconds", "words"), [(0.01, "gate moves by 3.3 times its size"), (0.1, None)])
def test_steps_that_do_not_resolve_a_path(seconds, words):
    """A gate of 0.25 m that rises by 2 m in its last interval, at dt 1/240."""
    scene = wr.Scene()
    path = wr.PosePath([0, 1, 1 + seconds], [(0, 0, 0.1), (0, 0, 0.1), (0, 0, 2.1)])
    scene.add_kinematic(wr.Box((0.02, 0.125, 0.1)), path=path, name="gate")
    found = hints_on([scene], 1 / 240)
    assert len(found) == (words is not None) and all(words in text for text in found)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off", "glb"])
def test_meshes_in_millimetres(tmp_path, suffix):
    """glTF is in metres by definition."""
    path = tmp_path / f"part.{suffix}"
    trimesh.creation.box((60, 30, 10)).export(path)
    found = hinted(lambda: wr.Mesh.from_file(path, sdf_resolution=8))
    assert len(found) == (suffix != "glb") and all("60 m long" in text and "scale=0.001" in text for text in found)
    assert hinted(lambda: wr.Mesh.from_file(path, scale=0.001, sdf_resolution=8)) == []


def test_meshes_of_trimesh_without_units():
    part = trimesh.creation.box((60, 30, 10))
    assert len(hinted(lambda: wr.Mesh.from_trimesh(part, sdf_resolution=8))) == 1
    part.units = "m"
    assert hinted(lambda: wr.Mesh.from_trimesh(part, sdf_resolution=8)) == []


def every_quantity():
    scene = hinge(None)
    for field in (wr.PointField((0, 0, 9), 1.0), wr.UniformField((0, 0, 1)), wr.DragField(0.1, (1, 0, 0))):
        scene.add_force_field(field)
    return wr.Simulator(scene, device="cpu")


@pytest.mark.parametrize("name", SETTABLE)
def test_a_nan_is_named(name):
    sim = every_quantity()
    shape = sim.get(name).shape
    with pytest.raises(ValueError, match=f"^{name}: must .*got .*nan"):
        sim.set(name, np.full(shape, np.nan) if owner_of(name) != "envs" or name == "gravity" else np.nan)


@pytest.mark.parametrize("text", ["friction=nan", "friction=0.1,nan", "mass=nan", "friction[box_1]=nan", "dt=nan"])
def test_a_nan_of_the_command_line_is_named(text, capsys):
    assert cli.main(["run", "box_stack", "--set", text, "--device", "cpu"]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert text.partition("=")[0].partition("[")[0] in error and "got nan" in error and "broadcast" not in error
