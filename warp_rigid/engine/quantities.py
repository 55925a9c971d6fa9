"""Reading and writing a simulator's quantities by their names, with every check in one place."""

from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_rigid import rotations
from warp_rigid.checks import shown
from warp_rigid.engine import joint_quantities
from warp_rigid.engine.model import KINDS, mass_arrays
from warp_rigid.engine.settings import PER_ENVIRONMENT, check_setting, setting_from_device
from warp_rigid.engine.shard import WATCHED, Shard
from warp_rigid.engine.world import World
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.enums import ShockMode
from warp_rigid.kernels.solve.gauss_seidel import INEFFECTIVE_STEPS
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.scene import Motion

STATE_NAMES = ("position", "orientation", "linear_velocity", "angular_velocity", "force", "torque")
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
STATUS_RECORD = np.dtype([("status", "U13"), ("step", np.int64), ("time", np.float64), ("body", np.int64)])


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
        level = world.shards.gather(lambda shard: shard.pools.graph.level.numpy())
        return level.reshape(world.num_envs, world.num_bodies)
    if name == "asleep":
        return _rows(world, world.sleep_state.asleep).astype(bool)
    if name == "active":
        return _rows(world, world.state.active).astype(bool)
    if name in DERIVED:
        return _DERIVE[name](world)
    if name in joint_quantities.READABLE:
        return joint_quantities.read(world, name)
    names = (*WRITABLE, *DERIVED, *joint_quantities.READABLE)
    raise ValueError(f"name: must be one of {', '.join(names)}, got {shown(name)}")


def write(world: World, name: str, value: Any, envs: Any, bodies: Any, joints: Any = None) -> None:
    """Change a quantity; see Simulator.set."""
    if name not in WRITABLE and name not in joint_quantities.READABLE:
        names = (*WRITABLE, *joint_quantities.WRITABLE)
        raise ValueError(f"name: must be one of {', '.join(names)}, got {shown(name)}")
    chosen = env_indices(world, envs)
    if name in joint_quantities.READABLE:
        touched = _indices("joints", joints, len(world.scene.joints))
        joint_quantities.write(world, name, value, chosen, touched)
        wake(world, chosen, joint_quantities.bodies_of(world, touched))
        return
    if name in PER_ENVIRONMENT:
        _write_setting(world, name, value, chosen)
        return
    if name == "gravity":
        touched = np.arange(world.num_bodies)
        rows = world.envs.gravity.numpy()
        rows[chosen] = _broadcast(name, value, (len(chosen), 3))
        world.envs.gravity.assign(rows)
    else:
        touched = _body_indices(world, bodies)
        writer = {"mass": _write_mass, "active": _write_active}.get(name)
        if writer is None:
            _write_rows(world, name, value, chosen, touched)
        else:
            writer(world, value, chosen, touched)
    wake(world, chosen, touched)


def wake(world: World, chosen: np.ndarray, bodies: np.ndarray) -> None:
    """Wake the islands of bodies that were changed, and those that lie on them."""
    if world.shards.sleeping:
        _assign_rows(world, world.sleep_state.disturbed, 1, chosen, bodies)
        for shard, _ in world.shards.of(chosen):
            shard.stages.wake_disturbed_islands()


def live_array(world: World, name: str) -> wp.array:
    """The device array of a quantity, without a copy."""
    if name in STATE_NAMES:
        return getattr(world.state, name)
    if name in COEFFICIENTS:
        return getattr(world.model.bodies, name)
    raise ValueError(f"name: must be one of {', '.join((*STATE_NAMES, *COEFFICIENTS))}, got {shown(name)}")


def env_indices(world: World, envs: Any) -> np.ndarray:
    """Indices of the chosen environments."""
    return _indices("envs", envs, world.num_envs)


def _body_indices(world: World, bodies: Any) -> np.ndarray:
    return _indices("bodies", bodies, world.num_bodies)


def _indices(name: str, value: Any, size: int) -> np.ndarray:
    if value is None:
        return np.arange(size)
    chosen = np.atleast_1d(np.asarray(value))
    if chosen.ndim != 1 or chosen.dtype.kind not in "iu" or (chosen < 0).any() or (chosen >= size).any():
        raise ValueError(f"{name}: must be indices from 0 to {size - 1}, got {shown(value)}")
    return chosen


def _rows(world: World, array: wp.array) -> np.ndarray:
    """A copy of a body array as (envs, bodies, ...)."""
    values = array.numpy().copy()
    return values.reshape(world.num_envs, world.num_bodies, *values.shape[1:])


def _broadcast(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The value as finite float32 of a shape."""
    try:
        values = np.broadcast_to(np.asarray(value, np.float32), shape)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{name}: must be numbers that broadcast to {shape}, got {_brief(value)}") from error
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: must be finite numbers")
    return values


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
        wake(world, chosen, np.arange(world.num_bodies))
        _count_anew(world, chosen)
    world.record()


def _count_anew(world: World, chosen: np.ndarray) -> None:
    """Forget how long bodies have kept still: the device counted only if others in the batch slept."""
    everyone = np.arange(world.num_bodies)
    _assign_rows(world, world.sleep_state.still_steps, 0, chosen, everyone)
    for name in ("position", "orientation"):
        _assign_rows(world, getattr(world.sleep_state, name), read(world, name)[chosen], chosen, everyone)


def _write_rows(world: World, name: str, value: Any, chosen: np.ndarray, bodies: np.ndarray) -> None:
    owner = world.state if name in STATE_NAMES else world.model.bodies
    rows = _rows(world, getattr(owner, name))
    new = _broadcast(name, value, (len(chosen), len(bodies), *rows.shape[2:]))
    if name in COEFFICIENTS:
        COEFFICIENTS[name].check_array(new)
    if name == "orientation":
        length = np.linalg.norm(new, axis=-1, keepdims=True)
        if (length < 1e-6).any():
            raise ValueError("orientation: must be quaternions (x, y, z, w) of length > 0")
        new = new / length
    _assign_rows(world, getattr(owner, name), new, chosen, bodies)
    if name in REMAINDER_OF:
        _assign_rows(world, getattr(world.state, REMAINDER_OF[name]), 0.0, chosen, bodies)


def _assign_rows(world: World, array: wp.array, values: Any, chosen: np.ndarray, bodies: np.ndarray) -> None:
    """Write the rows of some bodies of some environments."""
    rows = _rows(world, array)
    rows[np.ix_(chosen, bodies)] = values
    array.assign(rows.reshape(-1, *rows.shape[2:]))


def _write_active(world: World, value: Any, chosen: np.ndarray, bodies: np.ndarray) -> None:
    if np.asarray(value).dtype != bool:
        raise ValueError(f"active: must be True or False, got {_brief(value)}")
    _assign_rows(world, world.state.active, _broadcast("active", value, (len(chosen), len(bodies))), chosen, bodies)


def _write_mass(world: World, value: Any, chosen: np.ndarray, bodies: np.ndarray) -> None:
    new = _broadcast("mass", value, (len(chosen), len(bodies)))
    if (new <= 0.0).any():
        raise ValueError("mass: must be > 0 [kg]")
    for column, body in enumerate(bodies):
        if world.scene.bodies[body].motion != Motion.DYNAMIC:
            raise ValueError(f"mass: body {body} is not dynamic and has none")
        rows = chosen * world.num_bodies + body
        for name, values in mass_arrays(world.scene.bodies[body].shape, new[:, column].astype(np.float64)).items():
            array = getattr(world.model.bodies, name)
            host = array.numpy()
            host[rows] = values
            array.assign(host)


def forget_history(world: World, chosen: np.ndarray) -> None:
    """Make environments start their next step without remembered contacts and impulses."""
    for shard, own in world.shards.of(chosen):
        history = shard.pools.history
        pairs = history.pair_start.numpy()
        start = history.contact_start.numpy()[pairs]
        keys, searched = history.key.numpy(), history.searched.numpy()
        for env in own:
            first, last = env * world.num_bodies, (env + 1) * world.num_bodies
            keys[start[first] : start[last]] = -1
            searched[pairs[first] : pairs[last]] = 0
        history.key.assign(keys)
        history.searched.assign(searched)
    for kind in KINDS:
        count = len(kind.definitions(world.scene))
        rows = np.add.outer(chosen * count, np.arange(count)).reshape(-1)
        for name in kind.KEPT:
            array = getattr(world.model.constraint_rows[kind.NAME], name)
            values = array.numpy()
            values[rows] = 0
            array.assign(values)


def reset(world: World, envs: Any) -> None:
    """Reset environments to their initial state; see Simulator.reset."""
    chosen = env_indices(world, envs)
    everyone = np.arange(world.num_bodies)
    for name in declare.field_names(schema.State):
        start = _rows(world, getattr(world.start, name))[chosen]
        _assign_rows(world, getattr(world.state, name), start, chosen, everyone)
    for name in declare.field_names(schema.SleepState):
        _assign_rows(world, getattr(world.sleep_state, name), 0, chosen, everyone)
    for name in WATCHED:
        values = getattr(world.envs, name).numpy()
        values[chosen] = 0
        getattr(world.envs, name).assign(values)
    forget_history(world, chosen)
    if envs is None:
        world.shards.steps = 0


def apply_impulse(world: World, impulse: Any, point: Any, body: int, envs: Any) -> None:
    """Change velocities by an impulse at a world point; see Simulator.apply_impulse."""
    chosen = env_indices(world, envs)
    b = int(_body_indices(world, body)[0])
    push = _broadcast("impulse", impulse, (len(chosen), 3))
    at = _broadcast("point", point, (len(chosen), 3))
    if world.scene.bodies[b].motion != Motion.DYNAMIC:
        return
    arm = at - read(world, "center_of_mass")[chosen, b]
    inverse = np.linalg.inv(read(world, "inertia")[chosen, b].astype(np.float64))
    spin = np.einsum("nij,nj->ni", inverse, np.cross(arm, push))
    mass = read(world, "mass")[chosen, b]
    linear = read(world, "linear_velocity")[chosen, b] + push / mass[:, None]
    angular = read(world, "angular_velocity")[chosen, b] + spin
    write(world, "linear_velocity", linear[:, None], chosen, [b])
    write(world, "angular_velocity", angular[:, None], chosen, [b])


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
    records["env"] = shard.first + first // shard.num_bodies
    records["body_a"] = first % shard.num_bodies
    records["body_b"] = history.body_b.numpy()[pair] % shard.num_bodies
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
    return corners.reshape(world.num_envs, world.num_bodies, 2, 3)


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
    return records


def counts(world: World) -> dict[str, int]:
    """Sizes of the last step; see Simulator.counts."""
    pairs, contacts = counts_of_environments(world)
    sizes = world.shards.sizes()
    return {
        "pairs": int(pairs.sum()),
        "contacts": int(contacts.sum()),
        "levels": int(world.shards.gather(lambda shard: shard.pools.graph.level_count.numpy()).max()),
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
    for name in ("sweeps", "shock_sweeps", "push_out_sweeps", "residual"):
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
    shape = (world.num_envs, world.num_bodies)
    dynamic = np.array([body.motion == Motion.DYNAMIC for body in world.scene.bodies])
    present = dynamic & read(world, "active")
    asleep = read(world, "asleep")
    awake = world.shards.gather(lambda shard: shard.pools.graph.island.numpy() + shard.first_body).reshape(shape)
    slept = (world.sleep_state.island.numpy() + world.shards.gather(_first_body_of_each)).reshape(shape)
    named = np.where(asleep, slept, awake)
    mode = world.envs.shock_propagation.numpy()[:, None]
    converged = world.shards.gather(lambda shard: shard.pools.graph.converged.numpy())[:, None] == 1
    steps = world.shards.gather(lambda shard: shard.pools.graph.ineffective_steps.numpy()).reshape(shape)
    ineffective = (mode == ShockMode.TWO_PASS) & (steps > INEFFECTIVE_STEPS)
    swept = (mode == ShockMode.OFF) | converged | ineffective
    own = named - world.num_bodies * np.arange(world.num_envs)[:, None] == np.arange(world.num_bodies)
    first = present & own
    return {
        "islands": first.sum(axis=1),
        "islands_shock": (first & ~asleep & ~swept).sum(axis=1),
        "islands_sweeps": (first & ~asleep & swept).sum(axis=1),
        "islands_asleep": (first & asleep).sum(axis=1),
    }


def _first_body_of_each(shard: Shard) -> np.ndarray:
    """The first body of the shard, for each of its bodies."""
    return np.full(shard.end_body - shard.first_body, shard.first_body)


def _counts_of_shard(shard: Shard) -> np.ndarray:
    history = shard.pools.history
    pairs = history.pair_start.numpy()[:: shard.num_bodies]
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
    for field in world.scene.force_fields:
        per_mass += field.potential(x)
    return read(world, "active") * read(world, "mass") * per_mass


_DERIVE = {
    "inertia": _inertia,
    "center_of_mass": _center_of_mass,
    "kinetic_energy": _kinetic_energy,
    "potential_energy": _potential_energy,
}
assert set(_DERIVE) | {"asleep", "level"} == set(DERIVED)
assert {*STATE_NAMES, *REMAINDER_OF.values(), "active", "shock_ineffective_steps"} == set(
    declare.field_names(schema.State)
)
