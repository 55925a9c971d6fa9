"""Reading and writing a simulator's quantities by their names, with every check in one place."""

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_rigid import rotations
from warp_rigid.checks import shown
from warp_rigid.engine.model import mass_arrays
from warp_rigid.engine.settings import PER_ENVIRONMENT, check_setting, setting_from_device
from warp_rigid.engine.shard import Shard
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.constraints.rows import OTHER_KINDS
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.scene import Motion

if TYPE_CHECKING:
    from warp_rigid.engine.simulator import Simulator

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


def read(sim: "Simulator", name: str) -> np.ndarray:
    """A copy of a quantity; see Simulator.get."""
    if name in STATE_NAMES:
        return _rows(sim, getattr(sim._state, name))
    if name in COEFFICIENTS or name == "mass":
        return _rows(sim, getattr(sim._model.bodies, name))
    if name == "gravity":
        return sim._envs.gravity.numpy().copy()
    if name in PER_ENVIRONMENT:
        return setting_from_device(name, getattr(sim._envs, name).numpy().copy())
    if name == "level":
        level = sim._shards.gather(lambda shard: shard.pools.graph.level.numpy())
        return level.reshape(sim.num_envs, sim.num_bodies)
    if name == "asleep":
        return _rows(sim, sim._sleep_state.asleep).astype(bool)
    if name == "active":
        return _rows(sim, sim._state.active).astype(bool)
    if name in DERIVED:
        return _DERIVE[name](sim)
    raise ValueError(f"name: must be one of {', '.join((*WRITABLE, *DERIVED))}, got {shown(name)}")


def write(sim: "Simulator", name: str, value: Any, envs: Any, bodies: Any) -> None:
    """Change a quantity; see Simulator.set."""
    if name not in WRITABLE:
        raise ValueError(f"name: must be one of {', '.join(WRITABLE)}, got {shown(name)}")
    chosen = env_indices(sim, envs)
    if name in PER_ENVIRONMENT:
        _write_setting(sim, name, value, chosen)
        return
    if name == "gravity":
        touched = np.arange(sim.num_bodies)
        rows = sim._envs.gravity.numpy()
        rows[chosen] = _broadcast(name, value, (len(chosen), 3))
        sim._envs.gravity.assign(rows)
    else:
        touched = _body_indices(sim, bodies)
        writer = {"mass": _write_mass, "active": _write_active}.get(name)
        if writer is None:
            _write_rows(sim, name, value, chosen, touched)
        else:
            writer(sim, value, chosen, touched)
    wake(sim, chosen, touched)


def wake(sim: "Simulator", chosen: np.ndarray, bodies: np.ndarray) -> None:
    """Wake the islands of bodies that were changed, and those that lie on them."""
    if sim._shards.sleeping:
        _assign_rows(sim, sim._sleep_state.disturbed, 1, chosen, bodies)
        for shard, _ in sim._shards.of(chosen):
            shard.stages.wake_disturbed_islands()


def live_array(sim: "Simulator", name: str) -> wp.array:
    """The device array of a quantity, without a copy."""
    if name in STATE_NAMES:
        return getattr(sim._state, name)
    if name in COEFFICIENTS:
        return getattr(sim._model.bodies, name)
    raise ValueError(f"name: must be one of {', '.join((*STATE_NAMES, *COEFFICIENTS))}, got {shown(name)}")


def env_indices(sim: "Simulator", envs: Any) -> np.ndarray:
    """Indices of the chosen environments."""
    return _indices("envs", envs, sim.num_envs)


def _body_indices(sim: "Simulator", bodies: Any) -> np.ndarray:
    return _indices("bodies", bodies, sim.num_bodies)


def _indices(name: str, value: Any, size: int) -> np.ndarray:
    if value is None:
        return np.arange(size)
    chosen = np.atleast_1d(np.asarray(value))
    if chosen.ndim != 1 or chosen.dtype.kind not in "iu" or (chosen < 0).any() or (chosen >= size).any():
        raise ValueError(f"{name}: must be indices from 0 to {size - 1}, got {shown(value)}")
    return chosen


def _rows(sim: "Simulator", array: wp.array) -> np.ndarray:
    """A copy of a body array as (envs, bodies, ...)."""
    values = array.numpy().copy()
    return values.reshape(sim.num_envs, sim.num_bodies, *values.shape[1:])


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


def _write_setting(sim: "Simulator", name: str, value: Any, chosen: np.ndarray) -> None:
    values = value if isinstance(value, list | tuple | np.ndarray) else [value]
    numbers = [check_setting(name, v.item() if isinstance(v, np.generic) else v) for v in values]
    if len(numbers) not in (1, len(chosen)):
        raise ValueError(f"{name}: must be one value or {len(chosen)}, got {len(numbers)}")
    rows = getattr(sim._envs, name).numpy()
    rows[chosen] = numbers
    getattr(sim._envs, name).assign(rows)
    if name == "sleeping":
        wake(sim, chosen, np.arange(sim.num_bodies))
        _count_anew(sim, chosen)
    renew_stages(sim)


def _count_anew(sim: "Simulator", chosen: np.ndarray) -> None:
    """Forget how long bodies have kept still: the device counted only if others in the batch slept."""
    everyone = np.arange(sim.num_bodies)
    _assign_rows(sim, sim._sleep_state.still_steps, 0, chosen, everyone)
    for name in ("position", "orientation"):
        _assign_rows(sim, getattr(sim._sleep_state, name), read(sim, name)[chosen], chosen, everyone)


def renew_stages(sim: "Simulator") -> None:
    """Record the step anew where settings ask for another one."""
    sim._shards.record(sim.settings.dt, largest_repetition(sim), any_sleeping(sim))


def largest_repetition(sim: "Simulator") -> int:
    """Largest number of shock iterations in any environment."""
    return int(sim._envs.shock_iterations.numpy().max())


def any_sleeping(sim: "Simulator") -> bool:
    """Whether bodies may fall asleep in any environment."""
    return bool(sim._envs.sleeping.numpy().any())


def _write_rows(sim: "Simulator", name: str, value: Any, chosen: np.ndarray, bodies: np.ndarray) -> None:
    owner = sim._state if name in STATE_NAMES else sim._model.bodies
    rows = _rows(sim, getattr(owner, name))
    new = _broadcast(name, value, (len(chosen), len(bodies), *rows.shape[2:]))
    if name in COEFFICIENTS:
        COEFFICIENTS[name].check_array(new)
    if name == "orientation":
        length = np.linalg.norm(new, axis=-1, keepdims=True)
        if (length < 1e-6).any():
            raise ValueError("orientation: must be quaternions (x, y, z, w) of length > 0")
        new = new / length
    _assign_rows(sim, getattr(owner, name), new, chosen, bodies)
    if name in REMAINDER_OF:
        _assign_rows(sim, getattr(sim._state, REMAINDER_OF[name]), 0.0, chosen, bodies)


def _assign_rows(sim: "Simulator", array: wp.array, values: Any, chosen: np.ndarray, bodies: np.ndarray) -> None:
    """Write the rows of some bodies of some environments."""
    rows = _rows(sim, array)
    rows[np.ix_(chosen, bodies)] = values
    array.assign(rows.reshape(-1, *rows.shape[2:]))


def _write_active(sim: "Simulator", value: Any, chosen: np.ndarray, bodies: np.ndarray) -> None:
    if np.asarray(value).dtype != bool:
        raise ValueError(f"active: must be True or False, got {_brief(value)}")
    _assign_rows(sim, sim._state.active, _broadcast("active", value, (len(chosen), len(bodies))), chosen, bodies)


def _write_mass(sim: "Simulator", value: Any, chosen: np.ndarray, bodies: np.ndarray) -> None:
    new = _broadcast("mass", value, (len(chosen), len(bodies)))
    if (new <= 0.0).any():
        raise ValueError("mass: must be > 0 [kg]")
    for column, body in enumerate(bodies):
        if sim.scene.bodies[body].motion != Motion.DYNAMIC:
            raise ValueError(f"mass: body {body} is not dynamic and has none")
        rows = chosen * sim.num_bodies + body
        for name, values in mass_arrays(sim.scene.bodies[body].shape, new[:, column].astype(np.float64)).items():
            array = getattr(sim._model.bodies, name)
            host = array.numpy()
            host[rows] = values
            array.assign(host)


def forget_history(sim: "Simulator", chosen: np.ndarray) -> None:
    """Make environments start their next step without remembered contacts and impulses."""
    for shard, own in sim._shards.of(chosen):
        history = shard.pools.history
        pairs = history.pair_start.numpy()
        start = history.contact_start.numpy()[pairs]
        keys, searched = history.key.numpy(), history.searched.numpy()
        for env in own:
            first, last = env * sim.num_bodies, (env + 1) * sim.num_bodies
            keys[start[first] : start[last]] = -1
            searched[pairs[first] : pairs[last]] = 0
        history.key.assign(keys)
        history.searched.assign(searched)
    for kind in OTHER_KINDS:
        count = len(kind.definitions(sim.scene))
        rows = np.add.outer(chosen * count, np.arange(count)).reshape(-1)
        for name in kind.KEPT:
            array = getattr(sim._model.constraint_rows[kind.NAME], name)
            values = array.numpy()
            values[rows] = 0
            array.assign(values)


def apply_impulse(sim: "Simulator", impulse: Any, point: Any, body: int, envs: Any) -> None:
    """Change velocities by an impulse at a world point; see Simulator.apply_impulse."""
    chosen = env_indices(sim, envs)
    b = int(_body_indices(sim, body)[0])
    push = _broadcast("impulse", impulse, (len(chosen), 3))
    at = _broadcast("point", point, (len(chosen), 3))
    if sim.scene.bodies[b].motion != Motion.DYNAMIC:
        return
    arm = at - read(sim, "center_of_mass")[chosen, b]
    inverse = np.linalg.inv(read(sim, "inertia")[chosen, b].astype(np.float64))
    spin = np.einsum("nij,nj->ni", inverse, np.cross(arm, push))
    mass = read(sim, "mass")[chosen, b]
    linear = read(sim, "linear_velocity")[chosen, b] + push / mass[:, None]
    angular = read(sim, "angular_velocity")[chosen, b] + spin
    write(sim, "linear_velocity", linear[:, None], chosen, [b])
    write(sim, "angular_velocity", angular[:, None], chosen, [b])


def contact_records(sim: "Simulator") -> np.ndarray:
    """Contacts of the last step; see Simulator.contacts."""
    return sim._shards.gather(_contacts_of_shard)


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


def swept_boxes(sim: "Simulator") -> np.ndarray:
    """Boxes of the last look for pairs; see Simulator.swept_boxes."""
    corners = sim._shards.gather(
        lambda shard: np.stack([shard.stages.motions.lower.numpy(), shard.stages.motions.upper.numpy()], axis=1)
    )
    return corners.reshape(sim.num_envs, sim.num_bodies, 2, 3)


def status_records(sim: "Simulator") -> np.ndarray:
    """Health of the environments; see Simulator.status."""
    envs = sim._envs
    records = np.zeros(sim.num_envs, STATUS_RECORD)
    records["status"], records["step"], records["time"], records["body"] = "ok", -1, -1.0, -1
    for name, flag in (("out of bounds", "outside"), ("non-finite", "failed")):
        found = getattr(envs, flag).numpy() == 1
        records["status"][found] = name
        records["step"][found] = getattr(envs, f"{flag}_step").numpy()[found]
        records["body"][found] = getattr(envs, f"{flag}_body").numpy()[found]
    records["time"] = np.where(records["step"] >= 0, records["step"] * sim.settings.dt, -1.0)
    return records


def counts(sim: "Simulator") -> dict[str, int]:
    """Sizes of the last step; see Simulator.counts."""
    pairs, contacts = counts_of_environments(sim)
    sizes = sim._shards.sizes()
    return {
        "pairs": int(pairs.sum()),
        "contacts": int(contacts.sum()),
        "levels": int(sim._shards.gather(lambda shard: shard.pools.graph.level_count.numpy()).max()),
        "pair_capacity": sizes["pairs"],
        "contact_capacity": sizes["contacts"],
        "most_pairs": int(sim._shards.most_wanted[0]),
        "most_contacts": int(sim._shards.most_wanted[1]),
    }


def counts_of_environments(sim: "Simulator") -> tuple[np.ndarray, np.ndarray]:
    """Pairs and contacts of the last step in each environment, two (envs,) arrays."""
    both = sim._shards.gather(_counts_of_shard)
    return both[:, 0], both[:, 1]


def _counts_of_shard(shard: Shard) -> np.ndarray:
    history = shard.pools.history
    pairs = history.pair_start.numpy()[:: shard.num_bodies]
    return np.stack([np.diff(pairs), np.diff(history.contact_start.numpy()[pairs])], axis=1)


def _rotations(sim: "Simulator") -> np.ndarray:
    """Rotation matrices of all bodies in float64, (envs, bodies, 3, 3)."""
    return rotations.matrix(read(sim, "orientation").astype(np.float64))


def _inertia(sim: "Simulator") -> np.ndarray:
    """Inertia in the world frame [kg m^2]."""
    r = _rotations(sim)
    return r @ _rows(sim, sim._model.bodies.inertia) @ np.swapaxes(r, -1, -2)


def _center_of_mass(sim: "Simulator") -> np.ndarray:
    """Centres of mass in the world [m]."""
    local = _rows(sim, sim._model.bodies.center_of_mass)
    return read(sim, "position") + np.einsum("ebij,ebj->ebi", _rotations(sim), local)


def _kinetic_energy(sim: "Simulator") -> np.ndarray:
    """Kinetic energy of each body [J]."""
    v = read(sim, "linear_velocity").astype(np.float64)
    w = read(sim, "angular_velocity").astype(np.float64)
    spin = np.einsum("ebi,ebij,ebj->eb", w, _inertia(sim), w)
    return 0.5 * read(sim, "active") * (read(sim, "mass") * (v * v).sum(-1) + spin)


def _potential_energy(sim: "Simulator") -> np.ndarray:
    """Potential energy of each body in gravity and force fields [J]."""
    x = _center_of_mass(sim)
    per_mass = -np.einsum("ebi,ei->eb", x, sim._envs.gravity.numpy())
    for field in sim.scene.force_fields:
        per_mass += field.potential(x)
    return read(sim, "active") * read(sim, "mass") * per_mass


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
