"""Scene: the bodies, fields and rules of one environment, as plain data.

A scene is described once and simulated in many environments. It holds no device data. Every value is checked when it
is given, so that an error is reported at the line that caused it.
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from inspect import signature
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from warp_rigid.checks import (
    LARGEST,
    box_corners,
    finite_vector,
    instance_of,
    listed,
    number_in,
    one_of,
    shown,
    suggestion,
    unit_quaternion,
    whole_in,
)
from warp_rigid.display import html_of
from warp_rigid.kernels.enums import CombineRule, Coordinate, Motion
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.coefficients import COEFFICIENTS, CoefficientKeywords, Coefficients, list_coefficients
from warp_rigid.scene.fields import FIELDS, ForceField
from warp_rigid.scene.joints import Drive, Joint, JointEntry, JointFrame, place_joint
from warp_rigid.scene.look import Look
from warp_rigid.scene.pose_path import PosePath
from warp_rigid.scene.shapes.base import Shape
from warp_rigid.scene.shapes.heightfield import Heightfield

if TYPE_CHECKING:
    from warp_rigid.scene.import_report import ImportReport

Vector = Sequence[float] | np.ndarray

COMBINE_RULES = tuple(rule.name.lower() for rule in CombineRule)

SURFACE_VELOCITIES = ("surface_velocity", "surface_angular_velocity")

OUT_OF_BOUNDS = ("report", "remove")

STILL, UNTURNED = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
"""Velocity and orientation of a body for which none is given."""

MOST_IN_A_POOL = 1_000_000

LIGHTEST, HEAVIEST = 1e-17, 1e15
"""Range of masses [kg]: the squares of their inverses are numbers of single precision."""

_SMALLEST = float(np.finfo(np.float32).tiny)


_CHECKS: dict[str, Callable[[str, Any], Any]] = {
    "gravity": finite_vector,
    "friction_combine": partial(one_of, choices=COMBINE_RULES),
    "restitution_combine": partial(one_of, choices=COMBINE_RULES),
    "bounds": lambda name, value: None if value is None else box_corners(name, value),
    "out_of_bounds": partial(one_of, choices=OUT_OF_BOUNDS),
    "camera": partial(instance_of, kind=Camera | None, words="a Camera or None"),
}
"""Checks of the attributes of a scene that may be set, which return the value to store."""


@dataclass(frozen=True)
class Body(Coefficients):
    """One body of a scene, with the attributes of Coefficients in addition to these.

    Attributes:
        shape: its shape, in the shape's own frame.
        motion: static, kinematic or dynamic.
        position: (3,) origin of the shape's frame in the world [m].
        orientation: (4,) rotation of the shape's frame, unit quaternion (x, y, z, w).
        linear_velocity: (3,) velocity of the centre of mass [m/s].
        angular_velocity: (3,) in the world frame [rad/s].
        mass: [kg]; 0 for static and kinematic bodies, on which impulses have no effect.
        name: selects the body in a simulation and labels it in tables and files; unique in its scene.
        active: whether it is simulated from the start.
        surface_velocity: (3,) velocity with which the surface runs along the body, in the shape's frame [m/s].
        surface_angular_velocity: (3,) the same for a surface that turns about the origin of that frame [rad/s].
        path: PosePath that the body follows; None for a body that follows none.
    """

    shape: Shape
    motion: Motion
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]
    linear_velocity: tuple[float, float, float]
    angular_velocity: tuple[float, float, float]
    mass: float
    name: str
    active: bool = True
    surface_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    surface_angular_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    path: PosePath | None = None


OF_LOOKS = ("color", "colour", "rgb", "rgba", "look")
"""Keywords that programs of other engines give a body for what is in `Scene.looks` here."""


class Scene:
    """One environment: bodies, gravity, force fields and the rules for a pair's coefficients.

    Args:
        gravity: (3,) acceleration of every dynamic body [m/s^2].
        friction_combine: how the friction coefficients of two bodies (also rolling and spinning) are
            combined: "min" (the 2003 method), "average", "multiply" or "max".
        restitution_combine: the same for restitution.
        bounds: (lower, upper) corners of the box that bodies should not leave, infinite where there is no bound [m];
            None for no bounds. `Simulator.status` reports a moving body whose centre leaves the box.
        out_of_bounds: what happens to such a body: "report" changes nothing else, "remove" switches it off (`active`
            becomes False).
        camera: camera of pictures, films, pages and USD files; None for one that keeps the moving bodies in view.

    Attributes:
        bodies: list of Body, in the order in which they were added.
        force_fields: list of fields that act on the dynamic bodies besides gravity.
        filtered_pairs: pairs of bodies' indices, the smaller one first, that never touch.
        pools: indices of the bodies of each pool by its name.
        joints: list of JointEntry, in the order in which they were added.
        import_report: what import_usd left out or changed; None for a scene that was not imported.
        parameters: with which the function scene() of a .py file was called, by name; {} for other scenes.
        gravity: as given; may be set, as the following.
        friction_combine: as given.
        restitution_combine: as given.
        bounds: as given, or None.
        out_of_bounds: as given.
        camera: as given, or None.
        looks: Look of bodies by their index; imports fill it from the materials of their files.

    Raises:
        ValueError: gravity is not three finite numbers, a rule is unknown, the bounds are not a box, or the camera is
            not a Camera.
    """

    def __init__(
        self,
        gravity: Vector = (0.0, 0.0, -9.81),
        friction_combine: str = "min",
        restitution_combine: str = "min",
        bounds: tuple[Vector, Vector] | None = None,
        out_of_bounds: str = "report",
        camera: Camera | None = None,
    ) -> None:
        """Start an empty scene."""
        self.camera = camera
        self.bounds: Any = bounds
        self.out_of_bounds = out_of_bounds
        self.gravity: Any = gravity
        self.friction_combine = friction_combine
        self.restitution_combine = restitution_combine
        self.bodies: list[Body] = []
        self._copies: dict[str, int] = {}
        self._copies_of_joints: dict[str, int] = {}
        self.force_fields: list[ForceField] = []
        self.filtered_pairs: set[tuple[int, int]] = set()
        self.pools: dict[str, list[int]] = {}
        self.joints: list[JointEntry] = []
        self.looks: dict[int, Look] = {}
        self.import_report: ImportReport | None = None
        self.parameters: dict[str, Any] = {}

    def __repr__(self) -> str:
        """Return the number of bodies of each kind as text."""
        counts = [sum(body.motion == motion for body in self.bodies) for motion in Motion]
        return f"Scene({counts[2]} dynamic, {counts[1]} kinematic, {counts[0]} static bodies)"

    def _repr_html_(self) -> str:
        return html_of(self)

    def __setattr__(self, name: str, value: Any) -> None:
        """Check the attributes that may be set."""
        super().__setattr__(name, _CHECKS[name](name, value) if name in _CHECKS else value)

    def copy(self) -> "Scene":
        """Return a scene with the same content, which later additions to this one do not change."""
        found = copy(self)
        for name, value in vars(self).items():
            if isinstance(value, list | dict | set):
                setattr(found, name, copy(value))
        return found

    @list_coefficients
    def add_body(
        self,
        shape: Shape,
        *,
        position: Vector = (0.0, 0.0, 0.0),
        orientation: Vector = (0.0, 0.0, 0.0, 1.0),
        linear_velocity: Vector = (0.0, 0.0, 0.0),
        angular_velocity: Vector = (0.0, 0.0, 0.0),
        density: float | None = None,
        mass: float | None = None,
        name: str | None = None,
        active: bool = True,
        **coefficients: Unpack[CoefficientKeywords],
    ) -> int:
        """Add a dynamic body, which moves under forces and contacts.

        Of the coefficients of two bodies in contact the smaller one counts, unless the scene has other rules: a ball of
        restitution 0.8 does not bounce on a plane whose restitution is 0, the default.

        Args:
            shape: a shape with a volume (no Plane, no Heightfield).
            position: (3,) origin of the shape's frame in the world [m].
            orientation: (4,) quaternion (x, y, z, w); scaled to unit length.
            linear_velocity: (3,) velocity of the centre of mass [m/s].
            angular_velocity: (3,) in the world frame [rad/s].
            density: [kg/m^3], > 0; 1000 if neither density nor mass is given.
            mass: [kg], from 1e-17 to 1e15; instead of density.
            name: of the body; by default the shape's kind and the body's index. If another body has this
                name, a number is added: "box", "box_1", "box_2".
            active: False for a body that is not simulated until `sim.set("active", True, ...)` switches it on.
            **coefficients: coefficients of the body by name; see Coefficients.

        Returns:
            The body's index.

        Raises:
            ValueError: A value has the wrong type or is outside its range.
            TypeError: A keyword is unknown.
        """
        self._check_shape(shape, Motion.DYNAMIC)
        state = (position, orientation, linear_velocity, angular_velocity)
        return self._add(shape, Motion.DYNAMIC, state, _mass(shape, density, mass), name, active, coefficients)

    def add_pool(self, shape: Shape, count: int, name: str, **more: Any) -> list[int]:
        """Add inactive dynamic bodies for `Simulator.spawn`, named NAME_0, NAME_1, and so on.

        Args:
            shape: of all bodies.
            count: number of bodies, at least 1.
            name: of the pool.
            **more: as for add_body, such as density and friction.

        Returns:
            Indices of the bodies.

        Raises:
            ValueError: A value has the wrong type or is outside its range.
        """
        whole_in("count", count, 1, MOST_IN_A_POOL)
        names = [f"{name}_{i}" for i in range(count)]
        taken = sorted(self._copies.keys() & names)
        if taken:
            raise ValueError(f"name: must be another one, as there is a body {taken[0]}, got {shown(name)}")
        self.pools[name] = [self.add_body(shape, name=own, active=False, **more) for own in names]
        return list(self.pools[name])

    @list_coefficients
    def add_static(
        self,
        shape: Shape,
        *,
        position: Vector = (0.0, 0.0, 0.0),
        orientation: Vector = (0.0, 0.0, 0.0, 1.0),
        surface_velocity: Vector = (0.0, 0.0, 0.0),
        surface_angular_velocity: Vector = (0.0, 0.0, 0.0),
        name: str | None = None,
        active: bool = True,
        **coefficients: Unpack[CoefficientKeywords],
    ) -> int:
        """Add a body that never moves; its surface can run, as that of a conveyor belt or a turntable.

        Args:
            shape: a shape.
            position: as for add_body.
            orientation: as for add_body.
            surface_velocity: (3,) velocity of the surface relative to the body, in the shape's frame [m/s]. At a
                contact only the part along the surface counts.
            surface_angular_velocity: (3,) the same for a surface that turns about the origin of that frame [rad/s].
            name: as for add_body.
            active: as for add_body.
            **coefficients: coefficients of the body by name; see Coefficients.

        Returns:
            The body's index.

        Raises:
            ValueError: A value has the wrong type or is outside its range.
            TypeError: A keyword is unknown.
        """
        self._check_shape(shape, Motion.STATIC)
        state, surface = (position, orientation, STILL, STILL), (surface_velocity, surface_angular_velocity)
        return self._add(shape, Motion.STATIC, state, 0.0, name, active, coefficients, surface)

    @list_coefficients
    def add_kinematic(
        self,
        shape: Shape,
        *,
        position: Vector = (0.0, 0.0, 0.0),
        orientation: Vector = (0.0, 0.0, 0.0, 1.0),
        linear_velocity: Vector = (0.0, 0.0, 0.0),
        angular_velocity: Vector = (0.0, 0.0, 0.0),
        surface_velocity: Vector = (0.0, 0.0, 0.0),
        surface_angular_velocity: Vector = (0.0, 0.0, 0.0),
        path: PosePath | None = None,
        name: str | None = None,
        active: bool = True,
        **coefficients: Unpack[CoefficientKeywords],
    ) -> int:
        """Add a body that moves with a prescribed velocity, or along a path; contacts do not change it.

        Args:
            shape: a shape, no Plane.
            position: as for add_body; not together with a path.
            orientation: as for add_body; not together with a path.
            linear_velocity: as for add_body; not together with a path.
            angular_velocity: as for add_body; not together with a path.
            surface_velocity: as for add_static.
            surface_angular_velocity: as for add_static.
            path: a PosePath, which gives the pose at each time of the simulation, and with it the velocity.
            name: as for add_body.
            active: as for add_body.
            **coefficients: coefficients of the body by name; see Coefficients.

        Returns:
            The body's index.

        Raises:
            ValueError: A value has the wrong type or is outside its range.
            TypeError: A keyword is unknown.
        """
        self._check_shape(shape, Motion.KINEMATIC)
        state = _start((position, orientation, linear_velocity, angular_velocity), path)
        surface = (surface_velocity, surface_angular_velocity)
        return self._add(shape, Motion.KINEMATIC, state, 0.0, name, active, coefficients, surface, path)

    def add_force_field(self, field: ForceField) -> None:
        """Add a force field, such as a UniformField or PointField, which acts on all dynamic bodies besides gravity.

        Raises:
            ValueError: The argument is not a force field.
        """
        instance_of("field", field, ForceField, f"a {' or a '.join(FIELDS)}")
        self.force_fields.append(field)

    def index(self, body: int | str, name: str = "body") -> int:
        """Return the index of a body.

        Args:
            body: its index or name.
            name: of the argument, for the error message.

        Raises:
            ValueError: There is no such body.
        """
        return index_of(name, body, self.bodies, "a body")

    def filter_pair(self, a: int | str, b: int | str) -> None:
        """Disable contacts between two bodies.

        Args:
            a: index of one body, as returned by add_body, or its name.
            b: index or name of the other.

        Raises:
            ValueError: There is no such body, or both are the same.
        """
        first, second = sorted((self.index(a, "a"), self.index(b, "b")))
        if first == second:
            raise ValueError(f"b: must be another body than a, got {b} for both")
        self.filtered_pairs.add((first, second))

    def add_joint(
        self,
        joint: Joint,
        body_a: int | str,
        body_b: int | str | None = None,
        *,
        anchor: Vector = (0.0, 0.0, 0.0),
        anchor_b: Vector | None = None,
        frame_a: JointFrame | None = None,
        frame_b: JointFrame | None = None,
        name: str | None = None,
        break_force: float = np.inf,
        break_torque: float = np.inf,
        collide: bool = False,
        armature: float = 0.0,
    ) -> int:
        """Add a joint between two bodies, or between a body and the world.

        Points and axes are in the world frame, at the initial poses of the bodies.

        Args:
            joint: a FixedJoint, SphericalJoint, RevoluteJoint, PrismaticJoint or DistanceJoint.
            body_a: index or name of the first body. The coordinate is its motion relative to the second one.
            body_b: index or name of the second body; None for the world.
            anchor: (3,) point at which the joint holds the bodies [m].
            anchor_b: (3,) point of the second body if it is not `anchor`, as for the ends of a DistanceJoint [m].
            frame_a: frame fixed to the first body, whose x axis is the joint's axis; given together with `frame_b`
                instead of the anchors and the axis.
            frame_b: frame fixed to the second body, or to the world.
            name: of the joint; by default the kind and the joint's index. If another joint has this name, a
                number is added, as for bodies.
            break_force: the joint breaks at a larger force [N].
            break_torque: the joint breaks at a larger torque [N m].
            collide: whether the two bodies can touch each other; if not, their pair is filtered.
            armature: inertia that the rotor of a motor, seen through its gear, adds to the coordinate of a revolute
                joint [kg m^2] or a prismatic one [kg].

        Returns:
            The joint's index.

        Raises:
            ValueError: There is no such body, both are the same or neither is dynamic, the anchors are further apart
                than a tenth of the smaller body's size, or a value is outside its range.
        """
        first = self.index(body_a, "body_a")
        second = None if body_b is None else self.index(body_b, "body_b")
        entry = place_joint(
            self.bodies,
            joint,
            first,
            second,
            (anchor, anchor_b),
            (frame_a, frame_b),
            name=f"{type(joint).__name__.lower()}_{len(self.joints)}" if name is None else name,
            break_force=break_force,
            break_torque=break_torque,
            collide=collide,
            armature=armature,
        )
        self.joints.append(replace(entry, name=unique_name(entry.name, self._copies_of_joints)))
        if second is not None and not collide:
            self.filter_pair(first, second)
        return len(self.joints) - 1

    def add_drive(
        self,
        joint: int | str,
        *,
        stiffness: float = 0.0,
        damping: float = 0.0,
        max_force: float = np.inf,
        target_position: float = 0.0,
        target_velocity: float = 0.0,
    ) -> None:
        """Drive a revolute or prismatic joint by stiffness (target_position - q) + damping (target_velocity - v).

        q and v are its position and velocity. A spherical joint can be damped: a torque of `damping` times its angular
        velocity acts against all rotations.

        Args:
            joint: index of the joint, as returned by add_joint, or its name.
            stiffness: [N m/rad] for a revolute joint, [N/m] for a prismatic one, 0 for a spherical one.
            damping: [N m s/rad] or [N s/m].
            max_force: largest torque [N m] or force [N].
            target_position: [rad] or [m]; `Simulator.set("joint_target_position", ...)` changes it.
            target_velocity: [rad/s] or [m/s]; `Simulator.set("joint_target_velocity", ...)` changes it.

        Raises:
            ValueError: There is no such joint, it cannot be driven, or a value is outside its range.
        """
        index = index_of("joint", joint, self.joints, "a joint")
        entry = self.joints[index]
        drive = Drive(stiffness, damping, max_force, target_position, target_velocity)
        kind = type(entry.joint).__name__
        if entry.joint.coordinate == Coordinate.CONE:
            if drive != Drive(damping=drive.damping):
                raise ValueError(f"joint: a {kind} can be damped, but not driven: only damping can be given")
        elif entry.joint.coordinate not in (Coordinate.ANGLE, Coordinate.SLIDE):
            raise ValueError(f"joint: a drive needs a RevoluteJoint or a PrismaticJoint, got a {kind}")
        self.joints[index] = replace(entry, drive=drive)

    def _check_shape(self, shape, motion):
        instance_of("shape", shape, Shape, "a shape such as Box or Mesh")
        if isinstance(shape, Heightfield) and motion != Motion.DYNAMIC:
            if shape.moving and motion == Motion.STATIC:
                raise ValueError("shape: a Heightfield with a motion can only be kinematic, not static")
        elif shape.static_only and motion != Motion.STATIC:
            kind = type(shape).__name__
            raise ValueError(f"shape: a {kind} can only be static, not {motion.name.lower()}")

    def _add(self, shape, motion, state, mass, name, active, coefficients, surface=(STILL, STILL), path=None):
        position, orientation, linear_velocity, angular_velocity = state
        for keyword in coefficients:
            if keyword in SURFACE_VELOCITIES:
                raise ValueError(f"{keyword}: must be of a static or kinematic body, not of a dynamic one")
            if keyword not in COEFFICIENTS:
                add = self.add_body if motion == Motion.DYNAMIC else getattr(self, f"add_{motion.name.lower()}")
                known = suggestion(keyword, list(signature(add).parameters)[1:])
                hint = "; set it with scene.looks[index] = Look((red, green, blue))" if keyword in OF_LOOKS else known
                raise TypeError(f"unexpected keyword argument {keyword!r}{hint}")
        instance_of("name", name, str | None, "a string")
        instance_of("active", active, bool, "True or False")
        body = Body(
            shape=shape,
            motion=motion,
            position=finite_vector("position", position),
            orientation=unit_quaternion("orientation", orientation),
            linear_velocity=finite_vector("linear_velocity", linear_velocity),
            angular_velocity=finite_vector("angular_velocity", angular_velocity),
            mass=mass,
            name=unique_name(name or f"{type(shape).__name__.lower()}_{len(self.bodies)}", self._copies),
            active=active,
            surface_velocity=finite_vector("surface_velocity", surface[0]),
            surface_angular_velocity=finite_vector("surface_angular_velocity", surface[1]),
            path=path,
            **coefficients,
        )
        self.bodies.append(body)
        if shape.image is not None:
            self.looks[len(self.bodies) - 1] = Look(image=shape.image)
        return len(self.bodies) - 1


def _start(state: tuple, path: PosePath | None) -> tuple:
    """Pose and velocities of a kinematic body as given, or those of the start of its path."""
    if path is None:
        return state
    instance_of("path", path, PosePath, "a PosePath")
    names = ("position", "orientation", "linear_velocity", "angular_velocity")
    for name, value, start in zip(names, state, (STILL, UNTURNED, STILL, STILL), strict=True):
        if not np.array_equal(value, start):
            raise ValueError(f"{name}: must not be given together with a path, which has it")
    return (*path.at(0.0), STILL, STILL)


def index_of(name: str, wanted: int | str, entries: Sequence[Body | JointEntry], owner: str) -> int:
    """The index of the entry with an index or a name.

    Args:
        name: of the argument, for the error message.
        wanted: the index or the name.
        entries: all bodies or all joints.
        owner: "a body" or "a joint", for the error message.

    Raises:
        ValueError: There is no such entry.
    """
    if not isinstance(wanted, str) and entries:
        return whole_in(name, wanted, 0, len(entries) - 1)
    names = [entry.name for entry in entries]
    if wanted in names:
        return names.index(wanted)
    known = suggestion(wanted, names, listed(names)) if names else ""
    raise ValueError(f"{name}: must be the index or name of {owner}, got {shown(wanted)}{known}")


def unique_name(wanted: str, copies: dict[str, int]) -> str:
    """The wanted name, with a number appended if it is taken; `copies`: next number for each name that is taken."""
    name = wanted
    while name in copies:
        name = f"{wanted}_{copies[wanted]}"
        copies[wanted] += 1
    copies[name] = 1
    return name


def _mass(shape, density, mass):
    """Mass of a dynamic body from its density or as given [kg]."""
    if density is not None and mass is not None:
        raise ValueError("mass: must not be given together with density")
    volume = float(shape.volume)
    if not 0.0 < volume < np.inf:
        raise ValueError(f"shape: a dynamic body must have a volume > 0, got {volume:g} m^3")
    if mass is None:
        density = number_in("density", 1000.0 if density is None else density, above=0.0)
        mass = density * volume
    check_mass(shape, mass)
    return float(mass)


def check_mass(shape: Shape, mass: float) -> None:
    """Check that the mass of a body [kg], and its moments of inertia with it, are in the range of the solver.

    Raises:
        ValueError: One of them is not.
    """
    mass = number_in("mass", mass, LIGHTEST, HEAVIEST)
    least, most = mass * shape.moments[0], mass * shape.moments[2]
    if not (least >= _SMALLEST and most <= LARGEST):
        raise ValueError(
            f"mass: {mass:g} kg gives moments of inertia {least:g} to {most:g} kg m^2; "
            f"all must be from {_SMALLEST:g} to {LARGEST:g}"
        )
