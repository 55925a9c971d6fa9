"""Scene: the bodies, fields and rules of one environment, as plain data.

A scene is described once and simulated many times over; it holds nothing of the device. Every
value is checked when it is given, so that a mistake is reported at the line that made it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warp_rigid.checks import LARGEST, box_corners, finite_vector, number_in, one_of, shown, unit_quaternion, whole_in
from warp_rigid.kernels.enums import CombineRule, Motion
from warp_rigid.scene.fields import PointField, UniformField
from warp_rigid.scene.shapes.base import Shape
from warp_rigid.scene.shapes.heightfield import Heightfield

if TYPE_CHECKING:
    from warp_rigid.scene.import_report import ImportReport

__all__ = ["COMBINE_RULES", "Body", "Motion", "Scene"]

Vector = Sequence[float] | np.ndarray

COMBINE_RULES = tuple(rule.name.lower() for rule in CombineRule)

OUT_OF_BOUNDS = ("report", "remove")

_SMALLEST = float(np.finfo(np.float32).tiny)


@dataclass(frozen=True)
class Body:
    """One body of a scene.

    Attributes:
        shape: its shape, in the shape's own frame.
        motion: how it moves.
        position: (3,) origin of the shape's frame in the world [m].
        orientation: (4,) rotation of the shape's frame, unit quaternion (x, y, z, w).
        linear_velocity: (3,) velocity of the centre of mass [m/s].
        angular_velocity: (3,) in the world frame [rad/s].
        mass: [kg]; 0 for static and kinematic bodies, on which impulses have no effect.
        friction: Coulomb coefficient, static and sliding alike.
        restitution: rebound speed over approach speed.
        rolling_friction: resisting torque over normal force, against rolling [m].
        spinning_friction: resisting torque over normal force, about the contact normal [m].
        name: a label for tables and files; need not be unique.
        active: whether it takes part from the start.
    """

    shape: Shape
    motion: Motion
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]
    linear_velocity: tuple[float, float, float]
    angular_velocity: tuple[float, float, float]
    mass: float
    friction: float
    restitution: float
    rolling_friction: float
    spinning_friction: float
    name: str
    active: bool = True


class Scene:
    """One environment: bodies, gravity, force fields and the rules for a pair's coefficients.

    Args:
        gravity: (3,) acceleration of every dynamic body [m/s^2].
        friction_combine: how two bodies' friction coefficients (rolling and spinning ones too)
            make the pair's: "min" (the 2003 method), "average", "multiply" or "max".
        restitution_combine: the same for restitution.
        bounds: (lower, upper) corners of the box within which bodies belong, infinite where there is no bound [m];
            None for no bounds at all. A moving body whose centre leaves it is told of by Simulator.status.
        out_of_bounds: what becomes of such a body: "report", nothing else, or "remove", it is switched off
            (`active` becomes False).

    Attributes:
        bodies: list of Body, in the order in which they were added.
        force_fields: list of fields that act on the dynamic bodies beside gravity.
        filtered_pairs: pairs of bodies' indices, the smaller one first, that never touch.
        import_report: what a file had that the scene has not; None unless import_usd made the scene.
        gravity: as given.
        friction_combine: as given.
        restitution_combine: as given.
        bounds: as given, or None.
        out_of_bounds: as given.

    Raises:
        ValueError: gravity is not three finite numbers, a rule is unknown, or the bounds are no box.
    """

    def __init__(
        self,
        gravity: Vector = (0.0, 0.0, -9.81),
        friction_combine: str = "min",
        restitution_combine: str = "min",
        bounds: tuple[Vector, Vector] | None = None,
        out_of_bounds: str = "report",
    ) -> None:
        """Start an empty scene."""
        self.bounds = None if bounds is None else box_corners("bounds", bounds)
        self.out_of_bounds = one_of("out_of_bounds", out_of_bounds, OUT_OF_BOUNDS)
        self.gravity = finite_vector("gravity", gravity)
        self.friction_combine = one_of("friction_combine", friction_combine, COMBINE_RULES)
        self.restitution_combine = one_of("restitution_combine", restitution_combine, COMBINE_RULES)
        self.bodies: list[Body] = []
        self.force_fields: list[UniformField | PointField] = []
        self.filtered_pairs: set[tuple[int, int]] = set()
        self.import_report: ImportReport | None = None

    def __repr__(self) -> str:
        """Tell how many bodies of each kind the scene holds."""
        counts = [sum(body.motion == motion for body in self.bodies) for motion in Motion]
        return f"Scene({counts[2]} dynamic, {counts[1]} kinematic, {counts[0]} static bodies)"

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
        friction: float = 0.5,
        restitution: float = 0.0,
        rolling_friction: float = 0.0,
        spinning_friction: float = 0.0,
        name: str | None = None,
        active: bool = True,
    ) -> int:
        """Add a body that forces and contacts move.

        Args:
            shape: a shape with a volume (no Plane, no Heightfield).
            position: (3,) origin of the shape's frame in the world [m].
            orientation: (4,) quaternion (x, y, z, w); scaled to unit length.
            linear_velocity: (3,) velocity of the centre of mass [m/s].
            angular_velocity: (3,) in the world frame [rad/s].
            density: [kg/m^3], > 0; 1000 where neither density nor mass is given.
            mass: [kg], > 0; instead of density.
            friction: Coulomb coefficient, >= 0.
            restitution: from 0 (no rebound) to 1 (elastic).
            rolling_friction: resisting torque over normal force, >= 0 [m].
            spinning_friction: the same about the contact normal, >= 0 [m].
            name: label; the shape's kind and the body's index where none is given.
            active: False for a body that waits to be switched on, `sim.set("active", True, ...)`; until then it takes
                no part.

        Returns:
            The body's index.

        Raises:
            ValueError: A value is not of the kind or not in the range above.
        """
        self._check_shape(shape, Motion.DYNAMIC)
        return self._add(
            shape,
            Motion.DYNAMIC,
            (position, orientation, linear_velocity, angular_velocity),
            _mass(shape, density, mass),
            (friction, restitution, rolling_friction, spinning_friction),
            name,
            active,
        )

    def add_static(
        self,
        shape: Shape,
        *,
        position: Vector = (0.0, 0.0, 0.0),
        orientation: Vector = (0.0, 0.0, 0.0, 1.0),
        friction: float = 0.5,
        restitution: float = 0.0,
        rolling_friction: float = 0.0,
        spinning_friction: float = 0.0,
        name: str | None = None,
        active: bool = True,
    ) -> int:
        """Add a body that never moves. Arguments, result and errors as in add_body."""
        self._check_shape(shape, Motion.STATIC)
        return self._add(
            shape,
            Motion.STATIC,
            (position, orientation, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
            0.0,
            (friction, restitution, rolling_friction, spinning_friction),
            name,
            active,
        )

    def add_kinematic(
        self,
        shape: Shape,
        *,
        position: Vector = (0.0, 0.0, 0.0),
        orientation: Vector = (0.0, 0.0, 0.0, 1.0),
        linear_velocity: Vector = (0.0, 0.0, 0.0),
        angular_velocity: Vector = (0.0, 0.0, 0.0),
        friction: float = 0.5,
        restitution: float = 0.0,
        rolling_friction: float = 0.0,
        spinning_friction: float = 0.0,
        name: str | None = None,
        active: bool = True,
    ) -> int:
        """Add a body that moves with its own velocity, whatever it meets.

        Arguments, result and errors as in add_body.
        """
        self._check_shape(shape, Motion.KINEMATIC)
        return self._add(
            shape,
            Motion.KINEMATIC,
            (position, orientation, linear_velocity, angular_velocity),
            0.0,
            (friction, restitution, rolling_friction, spinning_friction),
            name,
            active,
        )

    def add_force_field(self, field: UniformField | PointField) -> None:
        """Add a UniformField or PointField, which acts on all dynamic bodies beside gravity.

        Raises:
            ValueError: The field is of another kind.
        """
        if not isinstance(field, UniformField | PointField):
            raise ValueError(f"field: must be a UniformField or a PointField, got {shown(field)}")
        self.force_fields.append(field)

    def filter_pair(self, a: int, b: int) -> None:
        """Let two bodies pass through each other.

        Args:
            a: index of one body, as add_body gave it.
            b: index of the other.

        Raises:
            ValueError: There is no such body, or both are the same.
        """
        last = len(self.bodies) - 1
        first, second = sorted((whole_in("a", a, 0, last), whole_in("b", b, 0, last)))
        if first == second:
            raise ValueError(f"b: must be another body than a, got {b} for both")
        self.filtered_pairs.add((first, second))

    def _check_shape(self, shape, motion):
        if not isinstance(shape, Shape):
            raise ValueError(f"shape: must be a shape such as Box or Mesh, got {shown(shape)}")
        if isinstance(shape, Heightfield) and motion != Motion.DYNAMIC:
            if shape.moving and motion == Motion.STATIC:
                raise ValueError("shape: a Heightfield with a motion can only be kinematic, not static")
        elif shape.static_only and motion != Motion.STATIC:
            kind = type(shape).__name__
            raise ValueError(f"shape: a {kind} can only be static, not {motion.name.lower()}")

    def _add(self, shape, motion, state, mass, surface, name, active):
        position, orientation, linear_velocity, angular_velocity = state
        friction, restitution, rolling_friction, spinning_friction = surface
        if name is not None and not isinstance(name, str):
            raise ValueError(f"name: must be a string, got {shown(name)}")
        if not isinstance(active, bool):
            raise ValueError(f"active: must be True or False, got {shown(active)}")
        body = Body(
            shape=shape,
            motion=motion,
            position=finite_vector("position", position),
            orientation=unit_quaternion("orientation", orientation),
            linear_velocity=finite_vector("linear_velocity", linear_velocity),
            angular_velocity=finite_vector("angular_velocity", angular_velocity),
            mass=mass,
            friction=number_in("friction", friction, 0.0),
            restitution=number_in("restitution", restitution, 0.0, 1.0),
            rolling_friction=number_in("rolling_friction", rolling_friction, 0.0),
            spinning_friction=number_in("spinning_friction", spinning_friction, 0.0),
            name=name or f"{type(shape).__name__.lower()}_{len(self.bodies)}",
            active=active,
        )
        self.bodies.append(body)
        return len(self.bodies) - 1


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
    mass = number_in("mass", mass, above=0.0)
    moments = np.linalg.eigvalsh(np.asarray(shape.inertia, dtype=np.float64)) * (mass / volume)
    if not (min(mass, *moments) >= _SMALLEST and max(mass, *moments) <= LARGEST):
        raise ValueError(
            f"mass: {mass:g} kg gives moments of inertia {moments[0]:g} to {moments[2]:g} kg m^2; "
            f"all must be from {_SMALLEST:g} to {LARGEST:g}"
        )
    return mass
