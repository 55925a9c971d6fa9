"""Watches on the host: which bodies they are of, and what they have recorded."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from warp_rigid.checks import shown
from warp_rigid.engine.selection import names_of
from warp_rigid.engine.world import World
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.update.watch import ANY
from warp_rigid.scene.scene import Scene

NONE = -2
"""In place of a body: an environment lacks it."""

MOST_WATCHES = 64
"""Each watch is compared with every pair of bodies."""


def watch(world: World, watched: Sequence[Any]) -> None:
    """Start to record; see Simulator.watch."""
    if not isinstance(watched, list | tuple) or not 1 <= len(watched) <= MOST_WATCHES:
        raise ValueError(f"watched: must be a list of 1 to {MOST_WATCHES} bodies or pairs, got {shown(watched)}")
    layout = world.layout
    table = np.full((len(layout.scenes), len(watched), 2), NONE, np.int32)
    for column, bodies in enumerate(watched):
        for index, scene in enumerate(layout.scenes):
            table[index, column] = _bodies(scene, bodies)
        if (table[:, column] == NONE).any(axis=1).all():
            raise ValueError(f"watched: no scene has the bodies {shown(bodies)}")
    watches: Any = declare.allocate(schema.Watches, {"envs": layout.num_envs, "watches": len(watched)}, world.device)
    for k, name in enumerate(("first", "second")):
        getattr(watches, name).assign(np.ascontiguousarray(table[layout.scene_of, :, k]))
    world.watches = watches
    for shard in world.shards:
        shard.watch(watches)


def watched(world: World) -> dict[str, np.ndarray]:
    """What was recorded; see Simulator.watched."""
    if world.watches is None:
        raise ValueError("watched: nothing is watched; call watch first")
    kept = {name: getattr(world.watches, name).numpy() for name in declare.field_names(schema.Watches)}
    dt = world.settings.dt
    return {
        "peak_impulse": kept["peak"].copy(),
        "summed_impulse": kept["total"].copy(),
        "first_contact": np.where(kept["first_contact"] > 0, kept["first_contact"] * dt, np.nan),
        "impacts": kept["impacts"].copy(),
        "rest_time": kept["moving_step"] * dt,
        "largest_overlap": kept["overlap"].copy(),
    }


def _bodies(scene: Scene, bodies: Any) -> tuple[int, int]:
    """Indices of the two bodies of a watch in a scene; ANY for every body, NONE for one that the scene lacks."""
    if bodies is None:
        return int(ANY), int(ANY)
    pair = bodies if isinstance(bodies, list | tuple) else [bodies]
    known = all(isinstance(one, str | int | np.integer) and not isinstance(one, bool) for one in pair)
    if not known or len(pair) not in (1, 2):
        raise ValueError(f"watched: must be None, a body or a pair of bodies, got {shown(bodies)}")
    place = names_of(scene)
    found = [place.get(one, NONE) if isinstance(one, str) else int(one) for one in pair]
    if not all(0 <= index < len(scene.bodies) for index in found):
        return NONE, NONE
    if len(found) == 2 and found[0] == found[1]:
        raise ValueError(f"watched: must be a pair of two different bodies, got {shown(bodies)}")
    return found[0], found[1] if len(found) == 2 else int(ANY)
