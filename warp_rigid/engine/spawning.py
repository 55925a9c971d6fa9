"""Pools of bodies: spawning inactive bodies of a scene during a simulation, and returning them."""

import re
from typing import Any

import numpy as np

from warp_rigid.checks import shape_of, shown
from warp_rigid.engine import forgetting, quantities
from warp_rigid.engine.layout import LACKING
from warp_rigid.engine.selection import env_indices, existing, rows_of
from warp_rigid.engine.world import World
from warp_rigid.scene.scene import Motion, Scene


def spawn(world: World, pool: str, poses: dict[str, Any], envs: Any) -> np.ndarray:
    """Activate the first inactive body of a pool in each environment; see Simulator.spawn."""
    layout = world.layout
    chosen = env_indices(layout.num_envs, envs)
    members = {scene: _members(layout.scenes[scene], scene, pool) for scene in np.unique(layout.scene_of[chosen])}
    active = world.state.active.numpy()
    found = np.full(len(chosen), LACKING)
    for place, env in enumerate(chosen.tolist()):
        own = members[layout.scene_of[env]]
        free = own[active[layout.first_body[env] + own] == 0]
        found[place] = free[0] if len(free) else LACKING
    rows = np.where(found == LACKING, LACKING, layout.first_body[chosen] + found)[:, None]
    given = {name: _one_row_each(world, name, value, rows) for name, value in poses.items()}
    # The check of energies compares sums over all bodies with earlier ones, so that the gained energy is kept.
    only_gained = world.state.health.numpy()[rows] * np.array([1.0, 0.0, 0.0, 0.0])
    forgetting.forget_bodies(world, rows[existing(rows)])
    quantities.assign_rows(world.state.health, only_gained, rows)
    for name, values in given.items():
        quantities.store_rows(world, name, values, rows)
    quantities.assign_rows(world.state.active, 1, rows)
    quantities.wake(world, chosen, rows)
    return found


def despawn(world: World, bodies: Any, envs: Any) -> None:
    """Return bodies to their pools; see Simulator.despawn."""
    chosen = env_indices(world.num_envs, envs)
    rows = rows_of(world.layout, chosen, bodies)
    quantities.assign_rows(world.state.active, 0, rows)
    quantities.wake(world, chosen, rows)


def _members(scene: Scene, number: int, pool: str) -> np.ndarray:
    """Indices of the bodies of a pool; in files that do not state it, the dynamic bodies named NAME_0, NAME_1, ...

    Raises:
        ValueError: the scene has none.
    """
    pattern = re.compile(rf"{re.escape(str(pool))}_\d+")
    named = [i for i, body in enumerate(scene.bodies) if body.motion == Motion.DYNAMIC and pattern.fullmatch(body.name)]
    found = scene.pools.get(str(pool), named)
    if not found:
        raise ValueError(f"pool: scene {number} has no bodies named {pool}_0, {pool}_1, ..., got {shown(pool)}")
    return np.array(found)


def _one_row_each(world: World, name: str, value: Any, rows: np.ndarray) -> np.ndarray:
    """Values of one body per environment by their rows (n, 1), (n, 1, components)."""
    count, length = len(rows), quantities.VECTOR_LENGTHS[name]
    if shape_of(value) not in ((length,), (1, length), (count, length)):
        raise ValueError(f"{name}: must be ({length},) or ({count}, {length}) numbers, got {shown(value)}")
    return quantities.checked_rows(world, name, np.reshape(value, (-1, 1, length)), rows)
