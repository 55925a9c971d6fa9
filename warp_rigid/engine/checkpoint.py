"""Checkpoints: a simulator in one file, from which it continues with the same bits.

The file holds the scenes with their meshes and their distance grids, all parameters and settings of every environment,
the state, and the contacts of the last step with their impulses; of the pools, only the rows in use. It does not
depend on the number of cores that shared the environments.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.checks import listed, whole_in
from warp_rigid.engine import checkpoint_values, step_reports
from warp_rigid.engine.checkpoint_values import within
from warp_rigid.engine.layout import MOST_ENVIRONMENTS
from warp_rigid.engine.pools import LARGEST, NAMES, fill
from warp_rigid.engine.settings import PER_ENVIRONMENT, SHOCK_MODES, Settings, check_setting
from warp_rigid.engine.shard import Shard
from warp_rigid.engine.world import World
from warp_rigid.files import archive
from warp_rigid.files.archive import shaped
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.collide.pair_contacts import ContactKey
from warp_rigid.kernels.declare import Lifetime
from warp_rigid.kernels.tuning import thresholds
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.scene import SURFACE_VELOCITIES
from warp_rigid.scene.serialization import scenes_from_data, scenes_to_data
from warp_rigid.version import __version__

KIND = "checkpoint"
VERSION = 13  # raise whenever older files could no longer be read

SCENE_OF = "scene_of"

log = logging.getLogger("warp_rigid")


def save(world: World, path: Any, more: dict[str, Any] | None = None, arrays: dict | None = None) -> None:
    """Write a checkpoint; see Simulator.save.

    Args:
        world: that of the simulator.
        path: where.
        more: plain data to keep beside it, in the header under "more".
        arrays: arrays to keep beside it; their names begin with "more_".
    """
    scenes, shapes = scenes_to_data(world.layout.scenes)
    shapes[SCENE_OF] = world.layout.scene_of.astype(np.int32)
    used = {name: step_reports.counts(world)[name] for name in NAMES}
    header = {
        "warp_rigid": __version__,
        "warp": wp.__version__,
        "device": str(world.device),
        **scenes,
        "num_envs": world.num_envs,
        "settings": asdict(world.settings),
        "seed": world.seed,
        "steps": world.shards.steps,
        "on_overflow": world.on_overflow,
        "on_nonfinite": world.on_nonfinite,
        "memory_limit": world.memory_limit.given,
        "capacity": world.shards.capacity,
        "used": used,
        "fitted": world.shards.most_wanted.tolist(),
        "thresholds": _thresholds(),
        "more": more or {},
    }
    archive.save(path, KIND, VERSION, header, {**shapes, **_stored(world), **(arrays or {})})


def _thresholds() -> dict[str, float]:
    return {name: threshold.value for name, threshold in thresholds().items()}


def _name_other_thresholds(stored: Any, path: Any) -> None:
    """Log which thresholds a checkpoint has been written with other values of; older files have none."""
    if isinstance(stored, dict):
        changed = [name for name, value in _thresholds().items() if stored.get(name) != value]
        if changed:
            log.warning("%s: written with other thresholds: %s; results differ", path, listed(changed))


def load(path: Any, device: Any, make: Callable[..., Any]) -> Any:
    """Return the simulator of a checkpoint; see Simulator.load.

    Args:
        path: the file.
        device: None takes the device it was saved on.
        make: called with the arguments of Simulator by name; the result has its World as `_world`.
    """
    header, arrays = archive.load(path, KIND, VERSION)
    _name_other_thresholds(header.get("thresholds"), path)
    try:
        arguments = _arguments(header, arrays)
        if device is None:
            device = header["device"] if isinstance(header["device"], str) else "cpu"
        made = make(**arguments, device=device)
        with made.in_use():
            restore(made._world, header, arrays)
        return made
    except archive.UNREADABLE as error:
        if str(error).startswith(("device:", "memory")):
            raise
        raise archive.unusable(path, KIND, error) from None


def restore(world: World, header: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Bring a simulator of the same environments to where a checkpoint was written.

    Raises:
        ValueError, TypeError, KeyError: header or arrays do not fit.
        CapacityError: the capacity is too small for the contacts of the last step.
    """
    used = {name: whole_in(f"used {name}", header["used"][name], 0, LARGEST) for name in NAMES}
    # Quantities of bodies that were declared after the file was written keep their defaults.
    known = {name for scene in header["scenes"] for body in scene["bodies"] for name in body}
    newer = {f"Bodies.{name}" for name in (*COEFFICIENTS, *SURFACE_VELOCITIES) if name not in known}
    rows = {
        name: own if name in newer else _checked(name, own, arrays, used, world) for name, own in _stored(world).items()
    }
    _check_neighbours(world, rows)
    checkpoint_values.check(world, rows)
    steps = whole_in("steps", header["steps"], 0, 2**62)
    most_wanted = [whole_in("fitted", n, 0, LARGEST) for _, n in zip(NAMES, header["fitted"], strict=True)]
    _upload(world, rows)
    world.shards.most_wanted = np.array(most_wanted, np.int64)
    world.shards.steps = steps
    world.choose_step()


def _arguments(header: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The arguments of the Simulator; checks that the sizes of the arrays agree with them."""
    scenes = scenes_from_data(header, arrays)
    envs = whole_in("num_envs", header["num_envs"], 1, MOST_ENVIRONMENTS)
    scene_of = shaped(arrays, SCENE_OF, np.int32, (envs,))
    within(SCENE_OF, scene_of, 0, len(scenes) - 1)
    bodies = int(np.array([len(scene.bodies) for scene in scenes])[scene_of].sum())
    shaped(arrays, "State.position", np.float32, (bodies, 3))
    return {
        "scene": scenes[0] if len(scenes) == 1 else [scenes[index] for index in scene_of],
        "num_envs": envs if len(scenes) == 1 else 1,
        "settings": Settings(**header["settings"]),
        "seed": header["seed"],
        "on_overflow": header["on_overflow"],
        "on_nonfinite": header["on_nonfinite"],
        "memory_limit": header["memory_limit"],
        "capacity": header["capacity"] if header["on_overflow"] == "raise" else None,
    }


def _whole(world: World) -> dict[str, wp.array]:
    """Device arrays of all environments that are stored as they are."""
    jointless = None if world.layout.has_joints else world.model.joints
    kept = [arrays for arrays in world.lasting if arrays is not world.watches and arrays is not jointless]
    return {
        f"{arrays._cls.key}.{name}": array
        for arrays in kept
        for name, _, array in declare.arrays_of(arrays, Lifetime.SETTING, Lifetime.REMEMBERED)
        if name != "island"
    }


def _stored(world: World) -> dict[str, np.ndarray]:
    """All arrays that a checkpoint holds, numbered as if all environments were one shard."""
    stored = {name: array.numpy() for name, array in _whole(world).items()}
    island = world.sleep_state.island.numpy() + world.shards.first_bodies()
    stored["SleepState.island"] = np.where(stored["SleepState.asleep"] == 1, island, 0).astype(np.int32)
    stored |= {f"History.{name}": rows for name, rows in _history(world).items()}
    remembered = declare.arrays_of(next(iter(world.shards)).pools.graph, Lifetime.REMEMBERED)
    return stored | {f"Graph.{name}": world.shards.of_graph(name) for name, _, _ in remembered}


def _history(world: World) -> dict[str, np.ndarray]:
    """The contacts of the last step, shard after shard; only rows that are in use."""
    parts: dict[str, list[np.ndarray]] = {name: [] for name in declare.field_names(schema.History)}
    last = {"pair_start": 0, "contact_start": 0}
    for shard in world.shards:
        history = shard.pools.history
        used = shard.pools.used()
        shift = {**last, "body_b": shard.first_body}
        for name, field in declare.LAYOUTS["History"].items():
            rows = getattr(history, name).numpy()[: used[declare.counted_by(field)]]
            parts[name].append(rows + np.int32(shift[name]) if name in shift else rows)
        last = {
            "pair_start": last["pair_start"] + used["pairs"],
            "contact_start": last["contact_start"] + used["contacts"],
        }
    for name, total in last.items():
        parts[name].append(np.array([total], np.int32))
    return {name: np.concatenate(some) for name, some in parts.items()}


def _checked(
    name: str, own: np.ndarray, arrays: Mapping[str, np.ndarray], used: dict[str, int], world: World
) -> np.ndarray:
    """The saved rows of an array, after checks of their values; `own` are the present rows of the simulator."""
    struct, _, last = name.partition(".")
    counted = declare.counted_by(declare.LAYOUTS[struct][last])
    count = used[counted] + last.endswith("_start") if counted in used else len(own)
    rows = shaped(arrays, name, own.dtype, (count, *own.shape[1:]))
    if last in PER_ENVIRONMENT:
        for value in np.unique(rows).tolist():
            _check_stored_setting(last, value)
    if last.endswith("_start"):
        top = used[f"{last.removesuffix('_start')}s"]
        if (np.diff(rows) < 0).any() or rows[0] != 0 or rows[-1] != top:
            raise ValueError(f"{name} must rise from 0 to {top}")
    if last == "contact_start" and np.diff(rows).max(initial=0) > schema.PAIR_SLOTS:
        raise ValueError(f"{name} must not give a pair more than {schema.PAIR_SLOTS} contacts")
    if last == "key":
        within(name, rows, ContactKey.BY_AXIS, 2 * world.model.shapes.samples.shape[0] - 1)
    return rows


def _check_neighbours(world: World, rows: dict[str, np.ndarray]) -> None:
    """Pairs and sleeping islands are of bodies of one environment."""
    env, asleep = world.layout.env_of_row, rows["SleepState.asleep"] == 1
    env_of_pair = np.repeat(env, np.diff(rows["History.pair_start"]))
    for name, bodies, envs in (
        ("History.body_b", rows["History.body_b"], env_of_pair),
        ("SleepState.island", rows["SleepState.island"][asleep], env[asleep]),
    ):
        if (bodies < 0).any() or (bodies >= len(env)).any() or (env[bodies] != envs).any():
            raise ValueError(f"{name} must be bodies of the same environment")


def _check_stored_setting(name: str, value: int) -> None:
    """A setting as the device keeps it."""
    if name == "shock_propagation":
        whole_in(name, value, 0, len(SHOCK_MODES) - 1)
    elif name.endswith("_iterations"):
        check_setting(name, value)
    else:
        check_setting(name, bool(whole_in(name, value, 0, 1)))


def _upload(world: World, rows: dict[str, np.ndarray]) -> None:
    """Write all arrays, each shard's part of the contacts to its own pools."""
    parts = [_part_of_history(shard, rows) for shard in world.shards]
    for shard, part in zip(world.shards, parts, strict=True):
        world.shards.ensure_capacity(shard, {"pairs": len(part["body_b"]), "contacts": len(part["key"])})
    for shard, part in zip(world.shards, parts, strict=True):
        for name, values in part.items():
            fill(getattr(shard.pools.history, name), values)
        shard.pools.forget_graph()
        ranges = {"bodies": slice(shard.first_body, shard.end_body), "envs": slice(shard.first, shard.end)}
        for name, field, array in declare.arrays_of(shard.pools.graph, Lifetime.REMEMBERED):
            array.assign(rows[f"Graph.{name}"][ranges[declare.counted_by(field)]])
    for name, array in _whole(world).items():
        array.assign(rows[name])
    island = np.where(rows["SleepState.asleep"] == 1, rows["SleepState.island"] - world.shards.first_bodies(), 0)
    world.sleep_state.island.assign(island.astype(np.int32))
    for shard in world.shards:
        shard.note_masses()


def _part_of_history(shard: Shard, rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A shard's rows of the contacts of the last step, by its own numbers."""
    bodies = (shard.first_body, shard.end_body)
    pairs = tuple(int(rows["History.pair_start"][body]) for body in bodies)
    contacts = tuple(int(rows["History.contact_start"][pair]) for pair in pairs)
    bounds = {"bodies": bodies, "pairs": pairs, "contacts": contacts}
    shift = {"pair_start": pairs[0], "contact_start": contacts[0], "body_b": bodies[0]}
    part = {}
    for name, field in declare.LAYOUTS["History"].items():
        first, end = bounds[declare.counted_by(field)]
        own = rows[f"History.{name}"][first : end + name.endswith("_start")]
        part[name] = own - np.int32(shift[name]) if name in shift else own
    return part
