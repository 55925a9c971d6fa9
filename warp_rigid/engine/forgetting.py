"""Resets: environments return to their start, and bodies of a pool lose the history of their last use.

The arrays that are reset follow from the declared lifetimes (kernels/declare.py) and are not listed here.
"""

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np

from warp_rigid.engine import joints
from warp_rigid.engine.pools import Pools
from warp_rigid.engine.selection import env_indices
from warp_rigid.engine.world import World
from warp_rigid.kernels import declare
from warp_rigid.kernels.declare import Lifetime


def reset(world: World, envs: Any) -> None:
    """Reset environments to their initial state; see Simulator.reset."""
    chosen = env_indices(world.num_envs, envs)
    if not len(chosen):
        return
    rows_of = cache(lambda symbol: world.layout.rows_of(symbol, chosen))
    for arrays in world.lasting:
        _return_to_start(arrays, rows_of, world.start if arrays is world.state else None)
    for shard, own in world.shards.of(chosen):
        rows = {symbol: shard.layout.rows_of(symbol, own) for symbol in ("envs", "bodies")}
        _forget_pairs(shard.pools, rows)
    if envs is None:
        world.shards.steps = 0


def forget_bodies(world: World, rows: np.ndarray) -> None:
    """Return all that steps left of bodies to zero, given their rows in the arrays of all environments.

    Their poses and velocities are to be written next.
    """
    for arrays in world.lasting:
        _return_to_start(arrays, lambda symbol: rows if symbol in ("bodies", joints.FROM_BODIES) else ())
    for shard in world.shards:
        inside = rows[(rows >= shard.first_body) & (rows < shard.end_body)] - shard.first_body
        if len(inside):
            _forget_pairs(shard.pools, {"bodies": inside})


def _return_to_start(arrays: Any, rows_of: Callable[[str], Any], start: Any = None) -> None:
    """Write the start of what a step leaves for the next one to some rows of each symbol; `start`: arrays with it."""
    for name, field, array in declare.arrays_of(arrays, Lifetime.REMEMBERED):
        own = rows_of(declare.counted_by(field))
        if len(own):
            host = array.numpy()
            host[own] = (field.start or 0) if start is None else getattr(start, name).numpy()[own]
            array.assign(host)


def _forget_pairs(pools: Pools, rows: Mapping[str, np.ndarray]) -> None:
    """Remove the contacts of bodies of a shard, and the contact graph, whose rows depend on the list of pairs."""
    _return_to_start(pools.graph, lambda symbol: rows.get(symbol, ()))
    pools.remove_pairs(rows["bodies"])
    pools.forget_graph()
