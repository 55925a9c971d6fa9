"""What the last steps did: contacts, counts, solver statistics and the health of the environments."""

import numpy as np

from warp_rigid.engine import health_checks
from warp_rigid.engine.shard import Shard
from warp_rigid.engine.world import World
from warp_rigid.kernels.enums import IslandSolver
from warp_rigid.scene.scene import Motion

COUNTED = (
    "impact_sweeps",
    "impact_rounds",
    "sweeps",
    "rounds",
    "shock_sweeps",
    "push_out_sweeps",
    "push_out_rounds",
    "residual",
)
"""Arrays of the contact graph that `Simulator.stats` reports."""

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


def contacts_of_shard(shard: Shard) -> np.ndarray:
    """Contacts of the last step in a shard; see Simulator.contacts."""
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
    """Swept boxes of the last broad phase; see Simulator.swept_boxes."""
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
    warned = health_checks.warning_records(envs, world.settings.dt)
    for env in np.unique(warned["env"]):
        records["warning"][env] = ", ".join(warned["warning"][warned["env"] == env])
    return records


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
        "repeated_steps": world.shards.repeated,
    }


def counts_of_environments(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Pairs and contacts of the last step in each environment, two (envs,) arrays."""
    both = world.shards.gather(_counts_of_shard)
    return both[:, 0], both[:, 1]


def solver_stats(world: World) -> dict[str, np.ndarray]:
    """What the solver did in the last step; see Simulator.stats."""
    pairs, contacts = counts_of_environments(world)
    found = {"pairs": pairs, "contacts": contacts, **_island_counts(world)}
    found |= {name: world.shards.of_graph(name) for name in COUNTED}
    # The graph of the last step before a reset is left as it is.
    stepped = world.envs.step.numpy() > 0
    found = {name: np.where(stepped, values, name == "accepted_share") for name, values in found.items()}
    used = world.shards.gather(_capacity_used)
    return found | {"pair_capacity_used": used[:, 0], "contact_capacity_used": used[:, 1]}


def _capacity_used(shard: Shard) -> np.ndarray:
    """Fractions of a shard's pools that all its environments used in the last step, for each of them, (envs, 2)."""
    used = shard.pools.used()
    return np.tile([used[name] / shard.pools.sizes[name] for name in ("pairs", "contacts")], (shard.num_envs, 1))


def _island_counts(world: World) -> dict[str, np.ndarray]:
    """Islands of each environment in the last step, by how they were solved, and their accepted share, (envs,) each."""
    env = world.layout.env_of_row
    present = (world.model.bodies.motion.numpy() == Motion.DYNAMIC) & (world.state.active.numpy() == 1)
    asleep = world.sleep_state.asleep.numpy() == 1
    awake, slept = world.shards.of_graph("island"), world.sleep_state.island.numpy()
    island = np.where(asleep, slept, awake) + world.shards.first_bodies()
    converged, solver = world.shards.of_graph("converged")[env] == 1, world.shards.of_graph("solver")
    solver = np.where((solver == IslandSolver.SHOCK) & converged, IslandSolver.SWEEPS, solver)
    first = present & (island == np.arange(len(env)))
    by_solver = {f"islands_{one.name.lower()}": first & ~asleep & (solver == one) for one in IslandSolver}
    counted = {"islands": first, **by_solver, "islands_asleep": first & asleep}
    counts = {name: np.bincount(env[those], minlength=world.num_envs) for name, those in counted.items()}
    least = np.ones(world.num_envs)
    np.minimum.at(least, env, world.shards.of_graph("accepted"))
    return counts | {"accepted_share": least}


def _counts_of_shard(shard: Shard) -> np.ndarray:
    history = shard.pools.history
    pairs = history.pair_start.numpy()[shard.layout.first_body]
    return np.stack([np.diff(pairs), np.diff(history.contact_start.numpy()[pairs])], axis=1)
