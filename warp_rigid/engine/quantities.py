"""Reading and writing a simulator's quantities by their names, with every check in one place."""

from typing import Any

import numpy as np
import warp as wp

from warp_rigid import rotations
from warp_rigid.checks import (
    LARGEST,
    array_of,
    brief,
    flags,
    numbers_of_shape,
    refuse_others,
    shape_of,
    shown,
    suggestion,
    whole_in,
)
from warp_rigid.engine import field_values, joint_quantities
from warp_rigid.engine.layout import LACKING, spread_rows
from warp_rigid.engine.model import mass_arrays
from warp_rigid.engine.precision import check_mass_ratio
from warp_rigid.engine.selection import env_indices, existing, rows_of
from warp_rigid.engine.settings import PER_ENVIRONMENT, check_setting, setting_from_device
from warp_rigid.engine.world import World
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.scene import SURFACE_VELOCITIES, Motion, check_mass

STATE_NAMES = ("position", "orientation", "linear_velocity", "angular_velocity", "force", "torque")
VECTOR_LENGTHS = {
    name: 4 if name == "orientation" else 3
    for name in (*STATE_NAMES, *SURFACE_VELOCITIES, "gravity", *field_values.VALUE_SHAPES)
    if field_values.VALUE_SHAPES.get(name) != ()
}
"""Numbers of components of the quantities that are vectors."""
VELOCITIES = ("linear_velocity", "angular_velocity")
ZEROABLE = (*VELOCITIES, *SURFACE_VELOCITIES, "force", "torque")
OF_PATH = ("position", "orientation", *VELOCITIES)
"""What a path prescribes."""
MASS_NAMES = ("mass", "inverse_mass", "inertia", "inverse_inertia")
REMAINDER_OF = {"orientation": "orientation_remainder", "angular_velocity": "angular_velocity_remainder"}
"""Where the device keeps what rounding left over of a quantity."""

LACKED = {
    **dict.fromkeys(VELOCITIES, (Motion.STATIC,)),
    **dict.fromkeys(SURFACE_VELOCITIES, (Motion.DYNAMIC,)),
    **dict.fromkeys(("mass", "force", "torque"), (Motion.STATIC, Motion.KINEMATIC)),
}
"""Quantities that are always 0 for bodies of some kinds, and these kinds."""

WRITABLE = (*STATE_NAMES, *SURFACE_VELOCITIES, "active", *COEFFICIENTS, "mass", "gravity", *PER_ENVIRONMENT)
"""Names of the quantities of bodies and environments that can be set."""
SETTABLE = (*WRITABLE, *field_values.VALUE_SHAPES, *joint_quantities.WRITABLE)
"""Names of all quantities that can be set, also those of force fields and joints."""


def owner_of(name: str) -> str:
    """What a quantity has a value for: "bodies", "joints", "fields" or "envs"."""
    if name in joint_quantities.READABLE:
        return "joints"
    if name in field_values.VALUE_SHAPES:
        return "fields"
    return "envs" if name == "gravity" or name in PER_ENVIRONMENT else "bodies"


def select(world: World, name: str, envs: Any, bodies: Any, joints: Any) -> np.ndarray:
    """A copy of a quantity of chosen environments, bodies and joints; see Simulator.get."""
    if name not in READABLE:
        _refuse_dt(name)
        known = suggestion(name, READABLE, "help(Simulator.get)")
        raise ValueError(f"name: must be a quantity, got {shown(name)}{known}")
    check_owner(name, bodies, joints)
    chosen = env_indices(world.num_envs, envs)
    values, wanted, owner = read(world, name), bodies if joints is None else joints, owner_of(name)
    if wanted is None:
        return values if envs is None else values[chosen]
    rows = rows_of(world.layout, chosen, wanted, owner, of_some=True)
    index = rows - world.layout.starts[owner][chosen, None]
    places = np.where(existing(rows), chosen[:, None] * values.shape[1] + index, LACKING)
    return spread_rows(values.reshape(-1, *values.shape[2:]), places)


def check_owner(name: str, bodies: Any, joints: Any) -> None:
    """Refuse a choice of bodies or joints for a quantity that is not theirs.

    Raises:
        ValueError: bodies or joints are given for a quantity of something else.
    """
    owner = owner_of(name)
    if bodies is not None and owner != "bodies":
        owners = "joints" if owner == "joints" else "environments"
        raise ValueError(f"bodies: must not be given for {name}, which is a quantity of {owners}")
    if joints is not None and owner != "joints":
        raise ValueError(f"joints: must not be given for {name}, which is no quantity of joints")


def read(world: World, name: str) -> np.ndarray:
    """A copy of a quantity of all environments, (envs, ...)."""
    if name in (*STATE_NAMES, *COEFFICIENTS, *SURFACE_VELOCITIES, "mass"):
        return _rows(world, _array_of(world, name))
    if name == "gravity":
        return world.envs.gravity.numpy().copy()
    if name in PER_ENVIRONMENT:
        return setting_from_device(name, getattr(world.envs, name).numpy().copy())
    if name == "level":
        return world.layout.by_environment(world.shards.gather(lambda shard: shard.stages.levels()))
    if name == "asleep":
        return _flags(world, world.sleep_state.asleep)
    if name == "active":
        return _flags(world, world.state.active)
    if name in field_values.VALUE_SHAPES:
        return field_values.read(world.layout, world.model.fields.parameters.numpy(), name)
    if name in joint_quantities.READABLE:
        return joint_quantities.read(world, name)
    return _DERIVE[name](world)


def write(
    world: World, name: str, value: Any, envs: Any, bodies: Any = None, joints: Any = None, of_all: bool = False
) -> None:
    """Change a quantity; see Simulator.set.

    Args:
        world: that of the simulator.
        name: the quantity.
        value: the value.
        envs: as for Simulator.set.
        bodies: as for Simulator.set.
        joints: as for Simulator.set.
        of_all: whether the bodies and joints are all that the environments have, as where none are given.
    """
    if name not in SETTABLE:
        _refuse_dt(name)
        known = suggestion(name, SETTABLE, "help(Simulator.set)")
        raise ValueError(f"name: must be a quantity that can be set, got {shown(name)}{known}")
    check_owner(name, bodies, joints)
    chosen = env_indices(world.num_envs, envs)
    if name in joint_quantities.WRITABLE:
        rows = rows_of(world.layout, chosen, joints, "joints")
        joint_quantities.write(world, name, value, rows, of_all or joints is None)
        wake(world, chosen, joint_quantities.bodies_of(world, rows))
        return
    if name in PER_ENVIRONMENT:
        _write_setting(world, name, value, chosen)
        return
    if name in VECTOR_LENGTHS:
        check_vectors(name, value)
    if name == "gravity":
        touched = rows_of(world.layout, chosen, None)
        rows = world.envs.gravity.numpy()
        rows[chosen] = _broadcast(name, value, (len(chosen), 3))
        world.envs.gravity.assign(rows)
    elif name in field_values.VALUE_SHAPES:
        touched = rows_of(world.layout, chosen, None)
        _write_field(world, name, value, chosen)
    else:
        touched = rows_of(world.layout, chosen, bodies)
        _refuse_lacked(world, name, value, touched, of_all or bodies is None)
        if name == "mass":
            _write_mass(world, value, np.where(_lacks(world, name, touched), LACKING, touched))
        elif name == "active":
            assign_rows(world.state.active, flags("active", value, touched.shape), touched)
        else:
            write_rows(world, name, value, touched)
        if name in SURFACE_VELOCITIES:
            world.choose_step()
    wake(world, chosen, touched)


def _refuse_dt(name: str) -> None:
    """Raise an error for `dt`, the only setting that is not a quantity."""
    if name == "dt":
        raise ValueError(
            "name: dt is constant and the same in all environments; it is Settings(dt=...) of the simulator"
        )


def _refuse_lacked(world: World, name: str, value: Any, rows: np.ndarray, of_all: bool) -> None:
    """Refuse what bodies cannot have; if none were chosen, only where none can have it."""
    if name in OF_PATH and not of_all:
        layout = world.layout
        for index in np.unique(layout.source[rows[existing(rows)]]).tolist() if layout.sizes["paths"] else ():
            if layout.scene_bodies[index].path is not None:
                raise ValueError(f"{name}: {layout.scene_bodies[index].name} follows a path, which prescribes it")
    if name in LACKED:
        lacks = _lacks(world, name, rows)
        if of_all and (existing(rows) & ~lacks).any():
            return
        shape = (*rows.shape, 3) if name in VECTOR_LENGTHS else rows.shape
        values = _broadcast(name, value, shape, existing(rows))
        found = rows[values.any(axis=tuple(range(rows.ndim, values.ndim))) & lacks]
        if len(found):
            body = world.layout.scene_bodies[world.layout.source[found[0]]]
            able = " and ".join(motion.name.lower() for motion in Motion if motion not in LACKED[name])
            kind = body.motion.name.lower()
            raise ValueError(f"{name}: must be 0 for {body.name}, which is {kind}; only {able} bodies can have one")


def _lacks(world: World, name: str, rows: np.ndarray) -> np.ndarray:
    """Mask of the rows that are bodies for which a quantity is always 0."""
    return np.isin(world.model.bodies.motion.numpy()[np.maximum(rows, 0)], LACKED[name]) & existing(rows)


def wake(world: World, chosen: np.ndarray, rows: np.ndarray) -> None:
    """Wake the islands of bodies that were changed, and those that lie on them."""
    if world.shards.sleeping:
        assign_rows(world.sleep_state.disturbed, 1, rows)
        for shard, _ in world.shards.of(chosen):
            shard.stages.wake_disturbed_islands()


def live_array(world: World, name: str) -> wp.array:
    """The device array of a quantity, without a copy."""
    names = (*STATE_NAMES, *COEFFICIENTS)
    if name not in names:
        known = suggestion(name, names)
        raise ValueError(f"name: must be a quantity that has a device array, got {shown(name)}{known}")
    return _array_of(world, name)


def _rows(world: World, array: wp.array) -> np.ndarray:
    """A copy of a body array as (envs, most bodies, ...)."""
    return world.layout.by_environment(array.numpy().copy())


def _flags(world: World, array: wp.array) -> np.ndarray:
    """A copy of flags of the bodies, (envs, most bodies) bool."""
    return world.layout.by_environment(array.numpy().astype(bool))


def check_vectors(name: str, value: Any) -> None:
    """Refuse a value of a vector quantity without an axis of its components: it would fill all of them.

    A velocity, force or torque may be 0, the zero vector.
    """
    length, shape = VECTOR_LENGTHS[name], shape_of(value)
    if shape[-1:] == (length,) or (name in ZEROABLE and shape == () and not isinstance(value, str) and value == 0):
        return
    raise ValueError(f"{name}: must be vectors of {length} numbers, got {brief(value)}")


def _broadcast(name: str, value: Any, shape: tuple[int, ...], needed: np.ndarray | None = None) -> np.ndarray:
    """The value as float32 of a shape, each number finite in float32 where it is `needed`."""
    values = numbers_of_shape(name, value, shape)
    checked = values if needed is None else values[needed]
    refuse_others(name, checked, np.abs(checked) <= LARGEST, "finite numbers")
    return values.astype(np.float32)


def _write_setting(world: World, name: str, value: Any, chosen: np.ndarray) -> None:
    several = isinstance(value, list | tuple | np.ndarray) and len(shape_of(value)) > 0
    numbers = [check_setting(name, _as_python(v)) for v in (value if several else [value])]
    if len(numbers) not in (1, len(chosen)):
        raise ValueError(f"{name}: must be one value or {len(chosen)}, got {len(numbers)}")
    rows = getattr(world.envs, name).numpy()
    rows[chosen] = numbers
    getattr(world.envs, name).assign(rows)
    if name == "sleeping":
        rows = rows_of(world.layout, chosen, None)
        wake(world, chosen, rows)
        # The device counts still steps only if a body of the batch may sleep: the count restarts.
        assign_rows(world.sleep_state.still_steps, 0, rows)
        for state in ("position", "orientation"):
            values = spread_rows(getattr(world.state, state).numpy(), rows)
            assign_rows(getattr(world.sleep_state, state), values, rows)
    world.choose_step()


def _as_python(value: Any) -> Any:
    """The Python value of a NumPy scalar or an array without axes; other values, and masked ones, as they are."""
    scalar = isinstance(value, np.generic | np.ndarray) and np.ndim(value) == 0 and array_of(value) is not None
    return value.item() if scalar else value


def _write_field(world: World, name: str, value: Any, chosen: np.ndarray) -> None:
    array = world.model.fields.parameters
    rows, needed = world.layout.table("fields")[chosen], field_values.having(world.layout, name)[chosen]
    new = _broadcast(name, value, (*rows.shape, *field_values.VALUE_SHAPES[name]), needed)
    host = array.numpy()
    field_values.write(world.layout, host, name, new, rows)
    array.assign(host)


def write_rows(world: World, name: str, value: Any, rows: np.ndarray) -> None:
    """Change a state quantity or coefficient of bodies by their rows (n, m)."""
    store_rows(world, name, checked_rows(world, name, value, rows), rows)


def checked_rows(world: World, name: str, value: Any, rows: np.ndarray) -> np.ndarray:
    """The values of a state quantity or coefficient for bodies by their rows (n, m), as the device stores them.

    Raises:
        ValueError: a value has the wrong shape or is out of range.
    """
    array = _array_of(world, name)
    new = _broadcast(name, value, (*rows.shape, *getattr(array.dtype, "_shape_", ())), existing(rows))
    if name in COEFFICIENTS:
        COEFFICIENTS[name].check_array(new[existing(rows)])
    if name == "orientation":
        with np.errstate(over="ignore"):
            length = np.linalg.norm(new, axis=-1, keepdims=True)
        if not ((length >= 1e-6) & (length <= LARGEST)).all():
            raise ValueError("orientation: must be quaternions (x, y, z, w) of finite length > 0")
        new = new / length
    if name in LACKED:
        new[_lacks(world, name, rows)] = 0.0
    return new


def store_rows(world: World, name: str, values: np.ndarray, rows: np.ndarray) -> None:
    """Store checked values of bodies by their rows (n, m)."""
    if name == "orientation":
        joint_quantities.forget_turns(world, values, rows)
    assign_rows(_array_of(world, name), values, rows)
    if name in REMAINDER_OF:
        assign_rows(getattr(world.state, REMAINDER_OF[name]), 0.0, rows)


def _array_of(world: World, name: str) -> wp.array:
    """The device array of a state quantity, a coefficient or the mass."""
    return getattr(world.state if name in STATE_NAMES else world.model.bodies, name)


def assign_rows(array: wp.array, values: Any, rows: np.ndarray) -> None:
    """Write values (n, m, ...) to rows (n, m), except where a row is LACKING."""
    host = array.numpy()
    present = existing(rows)
    values = np.broadcast_to(values, (*rows.shape, *host.shape[1:]))
    host[rows[present]] = values[present]
    array.assign(host)


def _write_mass(world: World, value: Any, rows: np.ndarray) -> None:
    present = existing(rows)
    new, targets = _broadcast("mass", value, rows.shape, present)[present], rows[present]
    exact = numbers_of_shape("mass", value, rows.shape)[present].astype(np.float64)  # as in a scene
    source, layout = world.layout.source[targets], world.layout
    for index in np.unique(source).tolist():
        for mass in (new[source == index].min(), new[source == index].max()):
            check_mass(layout.scene_bodies[index].shape, float(mass))
    _check_mass_ratios(world, new, targets)
    hosts = {name: getattr(world.model.bodies, name).numpy() for name in MASS_NAMES}
    for index in np.unique(source).tolist():
        own = source == index
        for name, values in mass_arrays(layout.scene_bodies[index].shape, exact[own]).items():
            hosts[name][targets[own]] = values
    for name, host in hosts.items():
        getattr(world.model.bodies, name).assign(host)
    for shard in world.shards:
        shard.note_masses()


def _check_mass_ratios(world: World, new: np.ndarray, targets: np.ndarray) -> None:
    """Check the masses that the environments of some dynamic bodies would have with new masses of these."""
    layout = world.layout
    masses = np.where(world.model.bodies.motion.numpy() == Motion.DYNAMIC, world.model.bodies.mass.numpy(), np.nan)
    masses[targets] = new
    rows = layout.by_environment(masses)[np.unique(layout.env_of_row[targets])]
    if len(rows):
        worst = rows[(np.nanmax(rows, axis=1) / np.nanmin(rows, axis=1)).argmax()]
        check_mass_ratio(worst[~np.isnan(worst)].tolist())


def apply_impulse(world: World, impulse: Any, point: Any, body: int | str | None, envs: Any) -> None:
    """Change velocities by an impulse; see Simulator.apply_impulse."""
    layout = world.layout
    chosen = env_indices(layout.num_envs, envs)
    if not isinstance(body, str):
        whole_in("body", body, 0, layout.most_bodies - 1)
    if not len(chosen):
        return
    rows = rows_of(layout, chosen, body, name="body")[:, 0]
    push = _broadcast("impulse", impulse, (len(chosen), 3))
    at = None if point is None else _broadcast("point", point, (len(chosen), 3))
    for row in rows[world.model.bodies.motion.numpy()[rows] != Motion.DYNAMIC][:1].tolist():
        found = layout.scene_bodies[layout.source[row]]
        raise ValueError(f"body: {found.name} is {found.motion.name.lower()}, and an impulse cannot move it")
    index = rows - layout.first_body[chosen]
    mass = world.model.bodies.mass.numpy()[rows]
    velocities = {"linear_velocity": read(world, "linear_velocity")[chosen, index] + push / mass[:, None]}
    if at is not None:
        arm = at - read(world, "center_of_mass")[chosen, index]
        inverse = np.linalg.inv(read(world, "inertia")[chosen, index].astype(np.float64))
        spin = np.einsum("nij,nj->ni", inverse, np.cross(arm, push))
        velocities["angular_velocity"] = read(world, "angular_velocity")[chosen, index] + spin
    # Both are checked before either is written.
    for name, values in velocities.items():
        _broadcast(f"impulse: {name}", values, values.shape)
    for name, values in velocities.items():
        write_rows(world, name, values[:, None], rows[:, None])
    wake(world, chosen, rows[:, None])


def _rotations(world: World) -> np.ndarray:
    """Rotation matrices of all bodies in float64, (envs, bodies, 3, 3)."""
    return rotations.matrix(read(world, "orientation").astype(np.float64))


def _inertia(world: World) -> np.ndarray:
    """Inertia in the world frame [kg m^2]."""
    r = _rotations(world)
    return r @ _rows(world, world.model.bodies.inertia) @ np.swapaxes(r, -1, -2)


def _center_of_mass(world: World) -> np.ndarray:
    """Centres of mass in the world [m]."""
    local = _rows(world, world.model.bodies.center_of_mass)
    return read(world, "position") + np.einsum("ebij,ebj->ebi", _rotations(world), local)


def _kinetic_energy(world: World) -> np.ndarray:
    """Kinetic energy of each body [J]."""
    v = read(world, "linear_velocity").astype(np.float64)
    w = read(world, "angular_velocity").astype(np.float64)
    spin = np.einsum("ebi,ebij,ebj->eb", w, _inertia(world), w)
    return 0.5 * read(world, "active") * (read(world, "mass") * (v * v).sum(-1) + spin)


def _potential_energy(world: World) -> np.ndarray:
    """Potential energy of each body in gravity and force fields [J]."""
    x = _center_of_mass(world)
    per_mass = -np.einsum("ebi,ei->eb", x, world.envs.gravity.numpy())
    per_mass += field_values.potential(world.layout, world.model.fields.parameters.numpy(), x)
    return read(world, "active") * read(world, "mass") * per_mass


_DERIVE = {
    "inertia": _inertia,
    "center_of_mass": _center_of_mass,
    "kinetic_energy": _kinetic_energy,
    "potential_energy": _potential_energy,
}
READABLE = (*SETTABLE, *_DERIVE, "asleep", "level", *joint_quantities.DERIVED)
"""Names of the quantities that `read` knows."""
