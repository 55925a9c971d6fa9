"""Checkpoints: a simulator in one file, from which it goes on to the same bits.

The file holds the scene with its meshes and their distance grids, all parameters and settings of every environment,
the state, and the contacts of the last step with their impulses; of the pools, only what is in use.
"""

import logging
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_rigid import access, archive
from warp_rigid.archive import shaped
from warp_rigid.checks import whole_in
from warp_rigid.kernels import data
from warp_rigid.kernels.narrowphase import BY_CENTER
from warp_rigid.pools import LARGEST, NAMES
from warp_rigid.scene_data import scene_from_data, scene_to_data
from warp_rigid.settings import PER_ENVIRONMENT, SHOCK_MODES, Settings, check_setting

if TYPE_CHECKING:
    from warp_rigid.simulator import Simulator

KIND = "checkpoint"
VERSION = 2  # raise whenever older files could no longer be read

FROM_SCENE = ("shape", "motion", "wide", "center_of_mass", "apart_start", "apart")
"""Arrays of bodies that follow from the scene."""

log = logging.getLogger("warp_rigid")


def save(sim: "Simulator", path: Any, more: dict[str, Any] | None = None, arrays: dict | None = None) -> None:
    """Write a checkpoint; see Simulator.save.

    Args:
        sim: the simulator.
        path: where.
        more: plain data to keep beside it, in the header under "more".
        arrays: arrays to keep beside it; their names begin with "more_".
    """
    import warp_rigid

    scene, shapes = scene_to_data(sim.scene)
    used = {name: sim.counts()[name] for name in NAMES}
    header = {
        "warp_rigid": warp_rigid.__version__,
        "warp": wp.__version__,
        "device": str(sim.device),
        "scene": scene,
        "num_envs": sim.num_envs,
        "settings": asdict(sim.settings),
        "seed": sim.seed,
        "steps": sim._steps,
        "on_overflow": sim.on_overflow,
        "on_nonfinite": sim.on_nonfinite,
        "memory_limit": sim._memory_limit.given,
        "capacity": {name: sim._pools.sizes[name] for name in NAMES},
        "used": used,
        "fitted": sim._pools.fitted,
        "more": more or {},
    }
    archive.save(path, KIND, VERSION, header, {**shapes, **_device_arrays(sim, used), **(arrays or {})})


def load(path: Any, device: Any = None) -> "Simulator":
    """Read a checkpoint; see Simulator.load."""
    from warp_rigid.simulator import Simulator

    header, arrays = archive.load(path, KIND, VERSION)
    try:
        arguments = _arguments(header, arrays)
        if device is None:
            device = header["device"] if isinstance(header["device"], str) else "cpu"
        sim = Simulator(**arguments, device=device)
        restore(sim, header, arrays)
        return sim
    except archive.UNREADABLE as error:
        if str(error).startswith(("device:", "memory")):
            raise
        raise archive.unusable(path, KIND, error) from None


def restore(sim: "Simulator", header: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Bring a simulator of the same scene and as many environments to where a checkpoint was written.

    Raises:
        ValueError, TypeError, KeyError: header or arrays do not fit.
        CapacityError: there is no room for the contacts of the last step.
    """
    used = {name: whole_in(f"used {name}", header["used"][name], 0, LARGEST) for name in NAMES}
    for name, member in (("pairs", "History.body_b"), ("contacts", "History.key")):
        shaped(arrays, member, np.int32, (used[name],))
    short = {name: used[name] for name in NAMES if used[name] > sim._pools.sizes[name]}
    if short:
        sim._grow(short)
    checked = [(array, _checked(name, array, field, arrays, used, sim)) for name, array, field in _stored(sim)]
    steps = whole_in("steps", header["steps"], 0, 2**62)
    sim._pools.fitted = tuple(whole_in("fitted", n, 0, LARGEST) for n in header["fitted"])
    sim._pools.forget_shortage()
    for array, rows in checked:
        _upload(array, rows)
    sim._steps = steps
    access.renew_stages(sim)


def _arguments(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """The Simulator's arguments, after a look whether the arrays are as large as they would make it."""
    scene = scene_from_data(header["scene"], arrays)
    envs = whole_in("num_envs", header["num_envs"], 1, 10_000_000)
    shaped(arrays, "State.position", np.float32, (envs * len(scene.bodies), 3))
    return {
        "scene": scene,
        "num_envs": envs,
        "settings": Settings(**header["settings"]),
        "seed": header["seed"],
        "on_overflow": header["on_overflow"],
        "on_nonfinite": header["on_nonfinite"],
        "memory_limit": header["memory_limit"],
        # Pools that may grow do without what they had grown to: it would not change a bit.
        "capacity": header["capacity"] if header["on_overflow"] == "raise" else None,
    }


def _stored(sim: "Simulator") -> list[tuple[str, wp.array, data.Field]]:
    """All device arrays that a checkpoint holds: name, array, and how it was declared."""
    pools = sim._pools
    owners = [
        (data.Bodies, sim._model.bodies, [n for n in data.field_names(data.Bodies) if n not in FROM_SCENE]),
        (data.State, sim._state, data.field_names(data.State)),
        (data.Rest, sim._rest, data.field_names(data.Rest)),
        (data.Environments, sim._envs, data.field_names(data.Environments)),
        (data.History, pools.history, data.field_names(data.History)),
        (data.Contacts, pools.contacts, data.field_names(data.Contacts)),
        (data.Graph, pools.graph, ("level",)),
        (data.Order, pools.by_level, ("level_count",)),
    ]
    return [
        (f"{struct.key}.{name}", getattr(owner, name), data.LAYOUTS[struct.key][name])
        for struct, owner, names in owners
        for name in names
    ]


def _rows(field: data.Field, size: int, used: dict[str, int]) -> int:
    """How many rows of an array are in use: of what is listed for pairs or contacts, only these."""
    first = field.shape.split(",")[0].strip()
    name, _, more = first.partition(" + ")
    return used[name] + int(more or 0) if name in used else size


def _device_arrays(sim: "Simulator", used: dict[str, int]) -> dict[str, np.ndarray]:
    return {name: _plain(array.numpy()[: _rows(field, array.shape[0], used)]) for name, array, field in _stored(sim)}


def _plain(rows: np.ndarray) -> np.ndarray:
    """Records as rows of whole numbers of the same bits; other arrays as they are."""
    return (
        rows
        if rows.dtype.names is None
        else np.ascontiguousarray(rows).view(np.int32).reshape(len(rows), rows.dtype.itemsize // 4)
    )


def _checked(
    name: str,
    array: wp.array,
    field: data.Field,
    arrays: dict[str, np.ndarray],
    used: dict[str, int],
    sim: "Simulator",
) -> np.ndarray:
    """The saved rows of an array, if the kernels may trust them."""
    host = array.numpy()
    plain = _plain(host[:1])
    rows = shaped(arrays, name, plain.dtype, (_rows(field, host.shape[0], used), *plain.shape[1:]))
    last = name.partition(".")[2]
    if last in PER_ENVIRONMENT:
        for value in np.unique(rows).tolist():
            _check_stored_setting(last, value)
    if last.endswith("_start"):
        top = used[f"{last.removesuffix('_start')}s"]
        if (np.diff(rows) < 0).any() or rows[0] != 0 or rows[-1] > top:
            raise ValueError(f"{name} must rise from 0 to {top}")
    if last == "contact_start" and np.diff(rows).max(initial=0) > data.PAIR_SLOTS:
        raise ValueError(f"{name} must not give a pair more than {data.PAIR_SLOTS} contacts")
    if host.dtype.names is not None:
        rows = rows.view(host.dtype).reshape(len(rows))
    bodies, samples = sim.num_envs * sim.num_bodies, sim._model.shapes.samples.shape[0]
    for part in {"body_a", "body_b"} & {last, *(host.dtype.names or ())}:
        _within(f"{name} {part}", rows if part == last else rows[part], 0, bodies - 1)
    if name == "Rest.island":
        _within(name, rows, 0, bodies - 1)
    if last == "key":
        _within(name, rows, BY_CENTER - 1, 2 * samples - 1)
    return rows


def _within(name: str, rows: np.ndarray, low: int, high: int) -> None:
    if len(rows) and not low <= rows.min() <= rows.max() <= high:
        raise ValueError(f"{name} must be from {low} to {high}")


def _check_stored_setting(name: str, value: int) -> None:
    """A setting as the device keeps it."""
    if name == "shock_propagation":
        whole_in(name, value, 0, len(SHOCK_MODES) - 1)
    elif name.endswith("_iterations"):
        check_setting(name, value)
    else:
        check_setting(name, bool(whole_in(name, value, 0, 1)))


def _upload(array: wp.array, rows: np.ndarray) -> None:
    """Fill an array: the saved rows, and after them the last one again (sums stay what they are)."""
    host = array.numpy().copy()
    host[: len(rows)] = rows
    if 0 < len(rows) < len(host):
        host[len(rows) :] = rows[-1]
    array.assign(host)
