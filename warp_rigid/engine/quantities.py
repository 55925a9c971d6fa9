"""Reading and writing a simulator's quantities by their names, with every check in one place."""

from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_rigid import rotations
from warp_rigid.checks import LARGEST, shown, whole_in
from warp_rigid.engine import field_values, health_checks, joint_quantities, watching
from warp_rigid.engine.layout import KINDS, spread_rows
from warp_rigid.engine.model import mass_arrays
from warp_rigid.engine.precision import check_mass_ratio
from warp_rigid.engine.selection import body_rows, env_indices, existing, joint_rows
from warp_rigid.engine.settings import PER_ENVIRONMENT, check_setting, setting_from_device
from warp_rigid.engine.shard import WATCHED, Shard
from warp_rigid.engine.world import World
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.enums import IslandSolver
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.scene import Motion

STATE_NAMES = ("position", "orientation", "linear_velocity", "angular_velocity", "force", "torque")
VECTOR_LENGTHS = {
    name: 4 if name == "orientation" else 3 for name in (*STATE_NAMES, "gravity", *field_values.vector_names())
}
"""Numbers of components of the quantities that are vectors."""
ZEROABLE = ("linear_velocity", "angular_velocity", "force", "torque")
MASS_NAMES = ("mass", "inverse_mass", "inertia", "inverse_inertia")
REMAINDER_OF = {"orientation": "orientation_remainder", "angular_velocity": "angular_velocity_remainder"}
"""Where the device keeps what rounding left over of a quantity."""

DERIVED = ("inertia", "center_of_mass", "kinetic_energy", "potential_energy", "asleep", "level")
WRITABLE = (*STATE_NAMES, "active", *COEFFICIENTS, "mass", "gravity", *PER_ENVIRONMENT)

CONTACT_RECORD = np.dtype(
    [
        ("env", np.int32),
        ("body_a", np.int32),
        ("body_b", np.int32),
        ("position", np.float32, 3),
        ("normal", np.float32, 3),
        ("depth", np.float32),
        ("impulse", np.float32, 3),
    ]
)
STATUS_RECORD = np.dtype(
    [("status", "U13"), ("step", np.int64), ("time", np.float64), ("body", np.int64), ("warning", "U32")]
)


def owner_of(name: str) -> str:
    """What a quantity has a value for: "bodies", "joints", "fields" or "envs"."""
    if name in joint_quantities.READABLE:
        return "joints"
    if name in field_values.names():
        return "fields"
    return "envs" if name == "gravity" or name in PER_ENVIRONMENT else "bodies"


def is_of_bodies(name: str) -> bool:
    """Whether a quantity has a value for each body."""
    return owner_of(name) == "bodies"


def read(world: World, name: str) -> np.ndarray:
    """A copy of a quantity; see Simulator.get."""
    if name in STATE_NAMES:
        return _rows(world, getattr(world.state, name))
    if name in COEFFICIENTS or name == "mass":
        return _rows(world, getattr(world.model.bodies, name))
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
    if name in field_values.names():
        return field_values.read(world.layout, world.model.fields.parameters.numpy(), name)
    if name in joint_quantities.READABLE:
        return joint_quantities.read(world, name)
    if name in DERIVED:
        return _DERIVE[name](world)
    raise ValueError(f"name: must be one of {', '.join(readable())}, got {shown(name)}")


def readable() -> tuple[str, ...]:
    """Names of the quantities that `read` knows."""
    return (*writable(), *DERIVED, *joint_quantities.DERIVED)


def is_readable(name: str) -> bool:
    """Whether `read` knows a quantity."""
    return name in readable()


def writable() -> tuple[str, ...]:
    """Names of the quantities that can be set."""
    return (*WRITABLE, *field_values.names(), *joint_quantities.WRITABLE)


def write(world: World, name: str, value: Any, envs: Any, bodies: Any, joints: Any = None) -> None:
    """Change a quantity; see Simulator.set."""
    if name not in writable():
        raise ValueError(f"name: must be one of {', '.join(writable())}, got {shown(name)}")
    of_joints = name in joint_quantities.WRITABLE
    if bodies is not None and not is_of_bodies(name):
        owners = "joints" if of_joints else "environments"
        raise ValueError(f"bodies: must not be given for {name}, which is a quantity of {owners}")
    if joints is not None and not of_joints:
        raise ValueError(f"joints: must not be given for {name}, which is no quantity of joints")
    chosen = env_indices(world.layout, envs)
    if of_joints:
        rows = joint_rows(world.layout, chosen, joints)
        joint_quantities.write(world, name, value, rows)
        wake(world, chosen, joint_quantities.bodies_of(world, rows))
        return
    if name in PER_ENVIRONMENT:
        _write_setting(world, name, value, chosen)
        return
    if name in VECTOR_LENGTHS:
        check_vectors(name, value)
    if name == "gravity":
        touched = body_rows(world.layout, chosen, None)
        rows = world.envs.gravity.numpy()
        rows[chosen] = _broadcast(name, value, (len(chosen), 3))
        world.envs.gravity.assign(rows)
    elif name in field_values.names():
        touched = body_rows(world.layout, chosen, None)
        _write_field(world, name, value, chosen)
    else:
        touched = body_rows(world.layout, chosen, bodies)
        writer = {"mass": _write_mass, "active": _write_active}.get(name)
        if writer is None:
            write_rows(world, name, value, touched)
        else:
            writer(world, value, touched)
    wake(world, chosen, touched)


def wake(world: World, chosen: np.ndarray, rows: np.ndarray) -> None:
    """Wake the islands of bodies that were changed, and those that lie on them."""
    if world.shards.sleeping:
        assign_rows(world.sleep_state.disturbed, 1, rows)
        for shard, _ in world.shards.of(chosen):
            shard.stages.wake_disturbed_islands()


def live_array(world: World, name: str) -> wp.array:
    """The device array of a quantity, without a copy."""
    if name in STATE_NAMES:
        return getattr(world.state, name)
    if name in COEFFICIENTS:
        return getattr(world.model.bodies, name)
    raise ValueError(f"name: must be one of {', '.join((*STATE_NAMES, *COEFFICIENTS))}, got {shown(name)}")


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
    length, shape = VECTOR_LENGTHS[name], np.shape(value)
    if shape[-1:] == (length,) or (name in ZEROABLE and shape == () and not isinstance(value, str) and value == 0):
        return
    raise ValueError(f"{name}: must be vectors of {length} numbers, got {_brief(value)}")


def _broadcast(name: str, value: Any, shape: tuple[int, ...], needed: np.ndarray | None = None) -> np.ndarray:
    """The value as float32 of a shape, each number finite in float32 where it is `needed`.

    Text, complex numbers and booleans are no numbers.
    """
    try:
        numbers = np.asarray(value)
        if numbers.dtype.kind not in "iuf":
            raise TypeError
        values = np.broadcast_to(numbers, shape)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{name}: must be numbers that broadcast to {shape}, got {_brief(value)}") from error
    if not (np.abs(values if needed is None else values[needed]) <= LARGEST).all():
        raise ValueError(f"{name}: must be finite numbers")
    return values.astype(np.float32)


def _brief(value: Any) -> str:
    shape = np.shape(value)
    return f"shape {shape}" if shape else shown(value)


def _write_setting(world: World, name: str, value: Any, chosen: np.ndarray) -> None:
    values = value if isinstance(value, list | tuple | np.ndarray) else [value]
    numbers = [check_setting(name, v.item() if isinstance(v, np.generic) else v) for v in values]
    if len(numbers) not in (1, len(chosen)):
        raise ValueError(f"{name}: must be one value or {len(chosen)}, got {len(numbers)}")
    rows = getattr(world.envs, name).numpy()
    rows[chosen] = numbers
    getattr(world.envs, name).assign(rows)
    if name == "sleeping":
        rows = body_rows(world.layout, chosen, None)
        wake(world, chosen, rows)
        _count_anew(world, rows)
    world.choose_step()


def _write_field(world: World, name: str, value: Any, chosen: np.ndarray) -> None:
    array = world.model.fields.parameters
    rows, needed = world.layout.table("fields")[chosen], field_values.having(world.layout, name)[chosen]
    tail = field_values.read(world.layout, array.numpy(), name).shape[2:]
    host = array.numpy()
    field_values.write(world.layout, host, name, _broadcast(name, value, (*rows.shape, *tail), needed), rows)
    array.assign(host)


def _count_anew(world: World, rows: np.ndarray) -> None:
    """Forget how long bodies have kept still: the device counted only if others in the batch slept."""
    assign_rows(world.sleep_state.still_steps, 0, rows)
    for name in ("position", "orientation"):
        assign_rows(getattr(world.sleep_state, name), spread_rows(getattr(world.state, name).numpy(), rows), rows)


def write_rows(world: World, name: str, value: Any, rows: np.ndarray) -> None:
    """Change a state quantity or coefficient of bodies by their rows (n, m)."""
    array = getattr(world.state if name in STATE_NAMES else world.model.bodies, name)
    new = _broadcast(name, value, (*rows.shape, *getattr(array.dtype, "_shape_", ())), existing(rows))
    if name in COEFFICIENTS:
        COEFFICIENTS[name].check_array(new[existing(rows)])
    if name == "orientation":
        length = np.linalg.norm(new, axis=-1, keepdims=True)
        if (length < 1e-6).any():
            raise ValueError("orientation: must be quaternions (x, y, z, w) of length > 0")
        new = new / length
    assign_rows(array, new, rows)
    if name in REMAINDER_OF:
        assign_rows(getattr(world.state, REMAINDER_OF[name]), 0.0, rows)


def assign_rows(array: wp.array, values: Any, rows: np.ndarray) -> None:
    """Write values (n, m, ...) to rows (n, m), except where a row is LACKING."""
    host = array.numpy()
    present = existing(rows)
    values = np.broadcast_to(values, (*rows.shape, *host.shape[1:]))
    host[rows[present]] = values[present]
    array.assign(host)


def _write_active(world: World, value: Any, rows: np.ndarray) -> None:
    if np.asarray(value).dtype != bool:
        raise ValueError(f"active: must be True or False, got {_brief(value)}")
    numbers = np.asarray(value).astype(np.int32)
    assign_rows(world.state.active, _broadcast("active", numbers, rows.shape), rows)


def _write_mass(world: World, value: Any, rows: np.ndarray) -> None:
    present = existing(rows)
    new, targets = _broadcast("mass", value, rows.shape, present)[present], rows[present]
    if (new <= 0.0).any():
        raise ValueError("mass: must be > 0 [kg]")
    source, layout = world.layout.source[targets], world.layout
    for target in targets[[layout.scene_bodies[index].motion != Motion.DYNAMIC for index in source.tolist()]]:
        number = target - layout.first_body[layout.env_of_row[target]]
        raise ValueError(f"mass: body {number} is not dynamic and has none")
    _check_mass_ratios(world, new, targets)
    hosts = {name: getattr(world.model.bodies, name).numpy() for name in MASS_NAMES}
    for index in np.unique(source).tolist():
        own = source == index
        for name, values in mass_arrays(layout.scene_bodies[index].shape, new[own].astype(np.float64)).items():
            hosts[name][targets[own]] = values
    for name, host in hosts.items():
        getattr(world.model.bodies, name).assign(host)


def _check_mass_ratios(world: World, new: np.ndarray, targets: np.ndarray) -> None:
    """Check the masses that the environments of some dynamic bodies would have with new masses of these."""
    layout = world.layout
    masses = np.where(world.model.bodies.motion.numpy() == Motion.DYNAMIC, world.model.bodies.mass.numpy(), np.nan)
    masses[targets] = new
    rows = layout.by_environment(masses)[np.unique(layout.env_of_row[targets])]
    if len(rows):
        worst = rows[(np.nanmax(rows, axis=1) / np.nanmin(rows, axis=1)).argmax()]
        check_mass_ratio(worst[~np.isnan(worst)].tolist())


def forget_contacts(shard: Shard, bodies: np.ndarray) -> None:
    """Make bodies of a shard start their next step without remembered contacts and impulses."""
    history = shard.pools.history
    pairs, start = history.pair_start.numpy(), history.contact_start.numpy()
    body_a = np.repeat(np.arange(len(pairs) - 1), np.diff(pairs))
    theirs = np.isin(body_a, bodies) | np.isin(history.body_b.numpy()[: len(body_a)], bodies)
    keys, searched = history.key.numpy(), history.searched.numpy()
    for pair in np.flatnonzero(theirs):
        keys[start[pair] : start[pair + 1]] = -1
    searched[: len(theirs)][theirs] = 0
    history.key.assign(keys)
    history.searched.assign(searched)


def forget_history(world: World, chosen: np.ndarray) -> None:
    """Make environments start their next step without remembered contacts and impulses."""
    for shard, own in world.shards.of(chosen):
        history = shard.pools.history
        pairs = history.pair_start.numpy()
        start = history.contact_start.numpy()[pairs]
        keys, searched = history.key.numpy(), history.searched.numpy()
        for env in own:
            first, last = shard.layout.first_body[env : env + 2]
            keys[start[first] : start[last]] = -1
            searched[pairs[first] : pairs[last]] = 0
        history.key.assign(keys)
        history.searched.assign(searched)
    for kind in KINDS:
        start = world.layout.starts[kind.NAME]
        rows = np.concatenate([np.arange(start[env], start[env + 1]) for env in chosen])
        for name in kind.KEPT:
            array = getattr(world.model.constraint_rows[kind.NAME], name)
            values = array.numpy()
            values[rows] = 0
            array.assign(values)


def reset(world: World, envs: Any) -> None:
    """Reset environments to their initial state; see Simulator.reset."""
    chosen = env_indices(world.layout, envs)
    rows = body_rows(world.layout, chosen, None)
    for name in declare.field_names(schema.State):
        start = spread_rows(getattr(world.start, name).numpy(), rows)
        assign_rows(getattr(world.state, name), start, rows)
    for name in declare.field_names(schema.SleepState):
        assign_rows(getattr(world.sleep_state, name), 0, rows)
    for name in WATCHED:
        values = getattr(world.envs, name).numpy()
        values[chosen] = 0
        getattr(world.envs, name).assign(values)
    watching.reset(world, chosen)
    forget_history(world, chosen)
    if envs is None:
        world.shards.steps = 0


def apply_impulse(world: World, impulse: Any, point: Any, body: int | str, envs: Any) -> None:
    """Change velocities by an impulse at a world point; see Simulator.apply_impulse."""
    layout = world.layout
    chosen = env_indices(layout, envs)
    if not isinstance(body, str):
        whole_in("body", body, 0, layout.most_bodies - 1)
    rows = body_rows(layout, chosen, body, "body")[:, 0]
    push = _broadcast("impulse", impulse, (len(chosen), 3))
    at = _broadcast("point", point, (len(chosen), 3))
    free = world.model.bodies.motion.numpy()[rows] == Motion.DYNAMIC
    chosen, rows, push, at = chosen[free], rows[free], push[free], at[free]
    if not len(chosen):
        return
    index = rows - layout.first_body[chosen]
    arm = at - read(world, "center_of_mass")[chosen, index]
    inverse = np.linalg.inv(read(world, "inertia")[chosen, index].astype(np.float64))
    spin = np.einsum("nij,nj->ni", inverse, np.cross(arm, push))
    mass = world.model.bodies.mass.numpy()[rows]
    velocities = {
        "linear_velocity": read(world, "linear_velocity")[chosen, index] + push / mass[:, None],
        "angular_velocity": read(world, "angular_velocity")[chosen, index] + spin,
    }
    # Both are checked before either is written.
    for name, values in velocities.items():
        _broadcast(f"impulse: {name}", values, values.shape)
    for name, values in velocities.items():
        write_rows(world, name, values[:, None], rows[:, None])
    wake(world, chosen, rows[:, None])


def contact_records(world: World) -> np.ndarray:
    """Contacts of the last step; see Simulator.contacts."""
    return world.shards.gather(_contacts_of_shard)


def _contacts_of_shard(shard: Shard) -> np.ndarray:
    history = shard.pools.history
    start = history.contact_start.numpy()
    pairs_before = history.pair_start.numpy()
    count = int(start[-1])
    records = np.zeros(count, CONTACT_RECORD)
    first = np.repeat(np.arange(len(pairs_before) - 1), np.diff(start[pairs_before]))
    pair = np.repeat(np.arange(len(start) - 1), np.diff(start))
    env = shard.layout.env_of_row[first]
    records["env"] = shard.first + env
    records["body_a"] = first - shard.layout.first_body[env]
    records["body_b"] = history.body_b.numpy()[pair] - shard.layout.first_body[env]
    records["position"] = history.position.numpy()[:count]
    records["normal"] = history.normal.numpy()[:count]
    records["depth"] = -history.gap.numpy()[:count]
    records["impulse"] = history.impulse.numpy()[:count]
    return records


def swept_boxes(world: World) -> np.ndarray:
    """Boxes of the last look for pairs; see Simulator.swept_boxes."""
    corners = world.shards.gather(
        lambda shard: np.stack([shard.stages.motions.lower.numpy(), shard.stages.motions.upper.numpy()], axis=1)
    )
    return world.layout.by_environment(corners)


def status_records(world: World) -> np.ndarray:
    """Health of the environments; see Simulator.status."""
    envs = world.envs
    records = np.zeros(world.num_envs, STATUS_RECORD)
    records["status"], records["step"], records["time"], records["body"] = "ok", -1, -1.0, -1
    for name, flag in (("out of bounds", "outside"), ("non-finite", "failed")):
        found = getattr(envs, flag).numpy() == 1
        records["status"][found] = name
        records["step"][found] = getattr(envs, f"{flag}_step").numpy()[found]
        records["body"][found] = getattr(envs, f"{flag}_body").numpy()[found]
    records["time"] = np.where(records["step"] >= 0, records["step"] * world.settings.dt, -1.0)
    warned = warnings(world)
    for env in np.unique(warned["env"]):
        records["warning"][env] = ", ".join(warned["warning"][warned["env"] == env])
    return records


def warnings(world: World) -> np.ndarray:
    """Warnings of the health checks; see Simulator.warnings."""
    return health_checks.warning_records(world.envs, world.settings.dt)


def counts(world: World) -> dict[str, int]:
    """Sizes of the last step; see Simulator.counts."""
    pairs, contacts = counts_of_environments(world)
    sizes = world.shards.sizes()
    return {
        "pairs": int(pairs.sum()),
        "contacts": int(contacts.sum()),
        "levels": int(world.shards.gather(lambda shard: shard.stages.levels()).max()),
        "pair_capacity": sizes["pairs"],
        "contact_capacity": sizes["contacts"],
        "most_pairs": int(world.shards.most_wanted[0]),
        "most_contacts": int(world.shards.most_wanted[1]),
    }


def counts_of_environments(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Pairs and contacts of the last step in each environment, two (envs,) arrays."""
    both = world.shards.gather(_counts_of_shard)
    return both[:, 0], both[:, 1]


def solver_stats(world: World) -> dict[str, np.ndarray]:
    """What the solver did in the last step; see Simulator.stats."""
    pairs, contacts = counts_of_environments(world)
    found = {"pairs": pairs, "contacts": contacts, **_island_counts(world)}
    for name in ("sweeps", "rounds", "shock_sweeps", "push_out_sweeps", "push_out_rounds", "residual"):
        found[name] = world.shards.gather(partial(_graph_column, name=name))
    for name in ("pairs", "contacts"):
        used = world.shards.gather(partial(_capacity_used, name=name))
        found[f"{name.removesuffix('s')}_capacity_used"] = used
    return found


def _graph_column(shard: Shard, name: str) -> np.ndarray:
    """An array of the contact graph of a shard."""
    return getattr(shard.pools.graph, name).numpy()


def _capacity_used(shard: Shard, name: str) -> np.ndarray:
    """Fraction of a shard's pool that all its environments used in the last step, for each of them."""
    history = shard.pools.history
    start = history.pair_start if name == "pairs" else history.contact_start
    return np.full(shard.num_envs, int(start.numpy()[-1]) / shard.pools.sizes[name])


def _island_counts(world: World) -> dict[str, np.ndarray]:
    """Islands of each environment in the last step, by how they were solved, (envs,) each."""
    env = world.layout.env_of_row
    present = (world.model.bodies.motion.numpy() == Motion.DYNAMIC) & (world.state.active.numpy() == 1)
    asleep = world.sleep_state.asleep.numpy() == 1
    awake = world.shards.gather(lambda shard: shard.pools.graph.island.numpy() + shard.first_body)
    slept = world.sleep_state.island.numpy() + world.shards.gather(_first_body_of_each)
    converged = world.shards.gather(lambda shard: shard.pools.graph.converged.numpy())[env] == 1
    solver = world.shards.gather(lambda shard: shard.pools.graph.solver.numpy())
    solver = np.where((solver == IslandSolver.SHOCK) & converged, IslandSolver.SWEEPS, solver)
    first = present & (np.where(asleep, slept, awake) == np.arange(len(env)))
    by_solver = {f"islands_{one.name.lower()}": first & ~asleep & (solver == one) for one in IslandSolver}
    counted = {"islands": first, **by_solver, "islands_asleep": first & asleep}
    return {name: np.bincount(env[those], minlength=world.num_envs) for name, those in counted.items()}


def _first_body_of_each(shard: Shard) -> np.ndarray:
    """The first body of the shard, for each of its bodies."""
    return np.full(shard.end_body - shard.first_body, shard.first_body)


def _counts_of_shard(shard: Shard) -> np.ndarray:
    history = shard.pools.history
    pairs = history.pair_start.numpy()[shard.layout.first_body]
    return np.stack([np.diff(pairs), np.diff(history.contact_start.numpy()[pairs])], axis=1)


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
assert set(_DERIVE) | {"asleep", "level"} == set(DERIVED)
assert {*STATE_NAMES, *REMAINDER_OF.values(), "active", "heap_steps", "fallen", "health"} == set(
    declare.field_names(schema.State)
)
