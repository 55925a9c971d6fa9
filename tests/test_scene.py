"""The scene keeps what it is given, in order, and refuses bad values in one clear line."""

import inspect
import math

import numpy as np
import pytest

from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.fields import PointField, UniformField
from warp_rigid.scene.joints import SphericalJoint
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import Sphere
from warp_rigid.scene.shapes.base import Shape


class Lump(Shape):
    """Stands in for a shape: half a litre, with the inertia of a 0.1 x 0.1 x 0.05 m box."""

    volume = 5e-4
    inertia = np.diag([5e-4 * (0.1**2 + 0.05**2) / 12] * 2 + [5e-4 * 0.1**2 / 6])


class Ground(Lump):
    volume = 0.0
    static_only = True


class Flat(Lump):
    volume = 0.0


def test_bodies_keep_the_order_of_adding():
    scene = Scene()
    assert scene.add_static(Ground()) == 0
    assert scene.add_body(Lump()) == 1
    assert scene.add_kinematic(Lump()) == 2
    assert [body.motion for body in scene.bodies] == [Motion.STATIC, Motion.DYNAMIC, Motion.KINEMATIC]
    assert repr(scene) == "Scene(1 dynamic, 1 kinematic, 1 static bodies)"


def test_every_argument_arrives():
    scene = Scene()
    shape = Lump()
    scene.add_body(
        shape,
        position=(1, 2, 3),
        orientation=(0, 0, 2, 0),
        linear_velocity=np.array([4.0, 5.0, 6.0], dtype=np.float32),
        angular_velocity=[7, 8, 9],
        mass=3,
        friction=0.25,
        restitution=1,
        rolling_friction=0.01,
        spinning_friction=0.02,
        name="brick",
    )
    body = scene.bodies[0]
    assert body.shape is shape
    assert body.position == (1.0, 2.0, 3.0)
    assert body.orientation == (0.0, 0.0, 1.0, 0.0)
    assert body.linear_velocity == (4.0, 5.0, 6.0)
    assert body.angular_velocity == (7.0, 8.0, 9.0)
    assert body.mass == 3.0
    assert (body.friction, body.restitution) == (0.25, 1.0)
    assert (body.rolling_friction, body.spinning_friction) == (0.01, 0.02)
    assert body.name == "brick"


def test_kinematic_keeps_its_velocity_and_has_no_mass():
    scene = Scene()
    scene.add_kinematic(Lump(), linear_velocity=(1, 0, 0), angular_velocity=(0, 0, 2))
    body = scene.bodies[0]
    assert body.linear_velocity == (1.0, 0.0, 0.0)
    assert body.angular_velocity == (0.0, 0.0, 2.0)
    assert body.mass == 0.0


def test_static_is_at_rest_and_has_no_mass():
    scene = Scene()
    scene.add_static(Ground(), position=(0, 0, 1))
    body = scene.bodies[0]
    assert body.linear_velocity == body.angular_velocity == (0.0, 0.0, 0.0)
    assert body.mass == 0.0
    with pytest.raises(TypeError):
        scene.add_static(Ground(), linear_velocity=(1, 0, 0))


def test_mass_is_density_times_volume():
    scene = Scene()
    scene.add_body(Lump())
    scene.add_body(Lump(), density=2000)
    scene.add_body(Lump(), mass=0.125)
    assert [body.mass for body in scene.bodies] == [0.5, 1.0, 0.125]


def test_names_default_to_kind_and_index():
    scene = Scene()
    scene.add_static(Ground())
    scene.add_body(Lump())
    assert [body.name for body in scene.bodies] == ["ground_0", "lump_1"]


def test_orientation_is_scaled_to_unit_length():
    scene = Scene()
    scene.add_body(Lump(), orientation=(1, -2, 3, 4))
    assert math.hypot(*scene.bodies[0].orientation) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_allclose(np.array(scene.bodies[0].orientation) * math.sqrt(30), (1, -2, 3, 4), rtol=1e-15)


def test_defaults_are_those_of_the_2003_method():
    scene = Scene()
    assert scene.gravity == (0.0, 0.0, -9.81)
    assert (scene.friction_combine, scene.restitution_combine) == ("min", "min")


BAD = [
    ("position", (1, 2)),
    ("position", (1, 2, math.nan)),
    ("position", (1, 2, 1e39)),
    ("position", (1.0, 2, 10**400)),
    ("position", np.array([1.0, np.nan, 2.0])),
    ("position", "abc"),
    ("position", (1, 2, "3")),
    ("position", [[1, 2, 3]]),
    ("position", (1, (2, 3), 4)),
    ("position", None),
    ("position", (True, 0.0, 1)),
    ("position", [0.0, np.True_, 1.0]),
    ("orientation", (0, 0, 0, 0)),
    ("orientation", (0, 0, 1)),
    ("orientation", (0, 0, 0, math.inf)),
    ("linear_velocity", (math.inf, 0, 0)),
    ("angular_velocity", 3.0),
    ("density", 0.0),
    ("density", -1000.0),
    ("density", math.nan),
    ("density", "steel"),
    ("mass", 0.0),
    ("mass", -1),
    ("mass", math.inf),
    ("mass", 1e-38),
    ("mass", 1e39),
    ("mass", (1, 2)),
    ("friction", -0.1),
    ("friction", math.nan),
    ("friction", None),
    ("friction", True),
    ("restitution", -0.1),
    ("restitution", 1.1),
    ("rolling_friction", -1e-3),
    ("spinning_friction", math.inf),
    ("name", 5),
]


@pytest.mark.parametrize(("field", "value"), BAD)
def test_a_bad_value_is_refused_in_one_line_that_names_the_field(field, value):
    scene = Scene()
    with pytest.raises(ValueError) as refusal:
        scene.add_body(Lump(), **{field: value})
    message = str(refusal.value)
    assert message.startswith(f"{field}: ") and "must be" in message or "all must" in message
    assert "\n" not in message
    assert scene.bodies == []


def test_a_pool_whose_names_are_taken_is_refused():
    scene = Scene()
    scene.add_pool(Lump(), 2, "shot")
    with pytest.raises(ValueError, match="^name: must be another one, as there is a body shot_0, got 'shot'"):
        scene.add_pool(Lump(), 3, "shot")
    assert [body.name for body in scene.bodies] == ["shot_0", "shot_1"]


def test_the_message_tells_the_range():
    scene = Scene()
    with pytest.raises(ValueError, match=r"^restitution: must be a number from 0 to 1, got 1\.1$"):
        scene.add_body(Lump(), restitution=1.1)
    with pytest.raises(ValueError, match=r"^friction: must be a finite number >= 0, got -1$"):
        scene.add_static(Ground(), friction=-1)
    with pytest.raises(ValueError, match=r"^mass: must be a number from 1e-17 to 1e\+15, got 0$"):
        scene.add_body(Lump(), mass=0)
    with pytest.raises(ValueError, match=r"^density: must be a finite number > 0, got 0\.0$"):
        scene.add_body(Lump(), density=np.float64(0.0))
    with pytest.raises(ValueError, match=r"^position: must be 3 finite numbers, got \[1\.0, 2\.0\]$"):
        scene.add_body(Lump(), position=np.array([1.0, 2.0]))


def test_static_and_kinematic_are_checked_too():
    for add in (Scene().add_static, Scene().add_kinematic):
        with pytest.raises(ValueError, match="^position: "):
            add(Lump(), position=(0, 0))
        with pytest.raises(ValueError, match="^restitution: "):
            add(Lump(), restitution=2)
    with pytest.raises(ValueError, match="^angular_velocity: "):
        Scene().add_kinematic(Lump(), angular_velocity=(0, 0, math.nan))


@pytest.mark.parametrize("add", [Scene.add_body, Scene.add_static, Scene.add_kinematic])
def test_signature_and_keywords_list_the_coefficients(add):
    parameters = inspect.signature(add).parameters
    assert {name: parameters[name].default for name in COEFFICIENTS} == {
        "friction": 0.5, "restitution": 0.0, "rolling_friction": 0.0, "spinning_friction": 0.0,
    }  # fmt: skip
    with pytest.raises(TypeError, match="^unexpected keyword argument 'fricton'; did you mean friction or "):
        add(Scene(), Lump(), fricton=0.5)


def test_an_unknown_keyword_is_answered_with_those_of_the_method():
    with pytest.raises(TypeError, match="'velocity'; did you mean linear_velocity or angular_velocity\\? All names: "):
        Scene().add_body(Lump(), velocity=(1, 0, 0))
    with pytest.raises(TypeError, match="'mass'; .*all names: position, (?!.*mass|.*density)"):
        Scene().add_static(Lump(), mass=1)


def test_density_and_mass_exclude_each_other():
    with pytest.raises(ValueError, match="^mass: must not be given together with density$"):
        Scene().add_body(Lump(), density=1000, mass=1)


def test_shapes_that_cannot_move_are_refused():
    with pytest.raises(ValueError, match="^shape: a Ground can only be static, not dynamic$"):
        Scene().add_body(Ground())
    with pytest.raises(ValueError, match="^shape: a Ground can only be static, not kinematic$"):
        Scene().add_kinematic(Ground())
    with pytest.raises(ValueError, match="^shape: a dynamic body must have a volume > 0"):
        Scene().add_body(Flat())


@pytest.mark.parametrize("thing", [None, 3, "box", Lump])
def test_what_is_no_shape_is_refused(thing):
    for add in (Scene().add_body, Scene().add_static, Scene().add_kinematic):
        with pytest.raises(ValueError, match="^shape: must be a shape"):
            add(thing)


def test_rules_and_gravity_are_checked():
    assert Scene(friction_combine="max", restitution_combine="multiply").friction_combine == "max"
    with pytest.raises(ValueError, match="^friction_combine: must be one of min, average"):
        Scene(friction_combine="mean")
    with pytest.raises(ValueError, match="^restitution_combine: must be one of min, average"):
        Scene(restitution_combine=1)
    with pytest.raises(ValueError, match="^gravity: must be 3 finite numbers"):
        Scene(gravity=-9.81)


def test_fields():
    scene = Scene(gravity=(0, 0, 0))
    scene.add_force_field(PointField(center=(0, 0, -10), strength=100))
    scene.add_force_field(UniformField(acceleration=[0, 0, -9.81]))
    assert scene.force_fields[0].center == (0.0, 0.0, -10.0)
    assert scene.force_fields[0].strength == 100.0
    assert scene.force_fields[1].acceleration == (0.0, 0.0, -9.81)
    with pytest.raises(ValueError, match="^field: must be a UniformField or a PointField"):
        scene.add_force_field((0, 0, -9.81))
    with pytest.raises(ValueError, match="^center: must be 3 finite numbers"):
        PointField(center=(0, 0), strength=1)
    with pytest.raises(ValueError, match="^strength: must be a finite number"):
        PointField(center=(0, 0, 0), strength=math.nan)
    with pytest.raises(ValueError, match="^acceleration: must be 3 finite numbers"):
        UniformField(acceleration=(0, math.inf, 0))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gravity", -9.81),
        ("gravity", (0, 0, math.nan)),
        ("friction_combine", "mean"),
        ("restitution_combine", None),
        ("bounds", 10),
        ("out_of_bounds", "kill"),
        ("camera", "front"),
    ],
)
def test_attributes_are_checked_when_they_are_set(name, value):
    scene = Scene()
    before = getattr(scene, name)
    with pytest.raises(ValueError, match=f"^{name}: must be "):
        setattr(scene, name, value)
    assert getattr(scene, name) == before


def test_a_copy_and_its_original_are_named_and_extended_independently():
    scene = Scene()
    scene.add_body(Sphere(0.1), name="ball")
    copied = scene.copy()
    for one in (copied, scene):
        added = one.add_body(Sphere(0.1), name="stone", position=(1, 0, 0))
        one.add_joint(SphericalJoint(), added, anchor=(1, 0, 0), name="string")
        one.add_pool(Sphere(0.1), 1, "spare")
        assert [body.name for body in one.bodies] == ["ball", "stone", "spare_0"]
        assert [joint.name for joint in one.joints] == ["string"] and one.pools == {"spare": [2]}
