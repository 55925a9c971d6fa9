"""Values of a checkpoint that a simulator would not have written: refused as they would be by `set`."""

from collections.abc import Callable, Mapping

import numpy as np

from warp_rigid.engine import joint_quantities
from warp_rigid.engine.model import mass_arrays
from warp_rigid.engine.world import World
from warp_rigid.kernels.enums import JointNumber
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.scene import SURFACE_VELOCITIES, Motion, check_mass

FLAGS = ("State.active", "State.fallen", "SleepState.asleep", "SleepState.disturbed", "Joints.broken")
"""Arrays of 0 and 1."""

STEP_NUMBERS = ("step", "failed_step", "outside_step", "warned_step")
BODY_NUMBERS = ("failed_body", "outside_body", "warned_body")

NO_MASS = {name: np.zeros(1) for name in ("mass", "inverse_mass", "inertia", "inverse_inertia")}
"""What a body that is not dynamic has."""

ROUNDING = 1e-5
"""Relative difference of masses from those that follow from each other."""


def check(world: World, rows: Mapping[str, np.ndarray]) -> None:
    """Check the arrays of a checkpoint, by their names.

    Raises:
        ValueError: a value cannot be that of a simulator of these scenes.
    """
    for name in FLAGS:
        within(name, rows.get(name, np.zeros(0)), 0, 1)
    for name in STEP_NUMBERS:
        within(f"Environments.{name}", rows[f"Environments.{name}"], 0, 2**31 - 1)
    for name in BODY_NUMBERS:
        within(f"Environments.{name}", rows[f"Environments.{name}"], 0, world.layout.most_bodies - 1)
    for name, coefficient in COEFFICIENTS.items():
        _finite(f"Bodies.{name}", rows[f"Bodies.{name}"])
        coefficient.check_array(rows[f"Bodies.{name}"])
    dynamic = world.model.bodies.motion.numpy() == Motion.DYNAMIC
    for name in SURFACE_VELOCITIES:
        _finite(f"Bodies.{name}", rows[f"Bodies.{name}"])
        if rows[f"Bodies.{name}"][dynamic].any():
            raise ValueError(f"Bodies.{name} must be 0 for dynamic bodies")
    _finite("Environments.gravity", rows["Environments.gravity"])
    _finite("State.orientation", rows["State.orientation"], _of_unit_length, "quaternions of length 1")
    _check_masses(world, rows)
    fields, source = world.layout.entries(lambda scene: scene.force_fields)
    for index, field in enumerate(fields):
        for row in np.unique(rows["FieldForces.parameters"][: len(source)][source == index], axis=0):
            type(field).from_row(row)
    if world.layout.has_joints:
        numbers = rows["Joints.numbers"]
        for name, column in joint_quantities.NUMBERS.items():
            joint_quantities.check_range(name, numbers[:, column])
        if (numbers[:, JointNumber.LOWER] > numbers[:, JointNumber.UPPER]).any():
            raise ValueError("Joints.numbers: the lower limits must be at most the upper ones")


def within(name: str, rows: np.ndarray, low: int, high: int) -> None:
    """Check the range of whole numbers.

    Raises:
        ValueError: one is outside.
    """
    if rows.size and not low <= rows.min() <= rows.max() <= high:
        raise ValueError(f"{name} must be from {low} to {high}")


def _finite(
    name: str, rows: np.ndarray, fits: Callable[[np.ndarray], np.ndarray] = np.isfinite, what: str = "finite numbers"
) -> None:
    if not fits(rows).all():
        raise ValueError(f"{name} must be {what}")


def _of_unit_length(rows: np.ndarray) -> np.ndarray:
    """Whether quaternions are of unit length, or not finite, as those of a halted environment can be."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(rows.astype(np.float64), axis=-1)
    return ~np.isfinite(length) | (np.abs(length - 1.0) < 1e-3)


def _check_masses(world: World, rows: Mapping[str, np.ndarray]) -> None:
    """Masses are in the range of the solver, and what is derived from them follows; it is 0 for bodies not dynamic."""
    bodies, source = world.layout.scene_bodies, world.layout.source
    names = [body.shape.key if body.motion == Motion.DYNAMIC else "" for body in bodies]
    shape_of = np.array(names, dtype=object)[source]
    for key, shape in {name: body.shape for name, body in zip(names, bodies, strict=True)}.items():
        own = shape_of == key
        mass = rows["Bodies.mass"][own].astype(np.float64)
        for value in (mass.min(), mass.max()) if key else ():
            check_mass(shape, float(value))
        for name, values in mass_arrays(shape, mass).items() if key else NO_MASS.items():
            found = rows[f"Bodies.{name}"][own]
            scale = np.abs(values).max(axis=tuple(range(1, values.ndim)), keepdims=True)
            if not (np.abs(found - values) <= ROUNDING * scale).all():
                raise ValueError(f"Bodies.{name} must follow from the masses")
