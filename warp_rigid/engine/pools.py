"""Pools: arrays whose required size is known only during the simulation, such as pairs and contacts."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.engine.hash_grid import grid_sizes
from warp_rigid.kernels import declare, schema

NAMES = ("pairs", "contacts")
"""Names of the pools whose capacity users can give."""

POOLS = (*NAMES, "candidates")
"""Names of all pools, in the order of `wanted` on the device."""

LARGEST = 2**30
"""Maximum capacity of a pool, as the two ends of each pair are counted in 32 bits."""

CHUNK = 16
"""Maximum number of steps between two capacity checks; as many are repeated after an overflow."""

HEADROOM = 1.5
"""A pool that is too small grows to this factor times the required size."""


@dataclass
class Pools:
    """Arrays sized by the number of pairs and contacts, and the sizes that the last steps required.

    Attributes:
        sizes: symbols of the data layout and their values.
        pairs: candidate pairs.
        contacts: contact rows.
        history: contacts of the last step.
        constraints: all constraints of the step.
        graph: contact graph.
        order: constraints that are solved in sweeps, by colour.
        rounds: pairs of heaps, which are solved in rounds.
        selected: pairs of heaps with an impact, then those with an overlap.
        turn: (1,) row of `wanted` for the current step.
        wanted: (CHUNK, 3) required number of pairs, contacts and candidates of each step.
    """

    sizes: dict[str, int]
    pairs: Any
    contacts: Any
    history: Any
    constraints: Any
    graph: Any
    order: Any
    rounds: Any
    selected: Any
    turn: wp.array
    wanted: wp.array

    @staticmethod
    def sizes_for(num_envs: int, num_bodies: int, others: int, pairs: int, contacts: int) -> dict[str, int]:
        """Symbols of the data layout and their values; bodies and other constraints are given per environment."""
        return {
            "envs": num_envs,
            "bodies": num_envs * num_bodies,
            "others": num_envs * others,
            "pairs": pairs,
            "contacts": contacts,
            "constraints": pairs + num_envs * others,
            **grid_sizes(num_envs, num_bodies),
        }

    @classmethod
    def allocate(cls, sizes: dict[str, int], device: Any) -> "Pools":
        """Allocate empty pools of these sizes."""
        envs = sizes["envs"]
        constraints = declare.allocate(schema.Constraints, sizes, device)
        constraints.other_start.assign(sizes["others"] // envs * np.arange(envs + 1, dtype=np.int32))
        return cls(
            sizes=sizes,
            pairs=declare.allocate(schema.Pairs, sizes, device),
            contacts=declare.allocate(schema.Contacts, sizes, device),
            history=declare.allocate(schema.History, sizes, device),
            constraints=constraints,
            graph=declare.allocate(schema.Graph, sizes, device),
            order=declare.allocate(schema.Order, sizes, device),
            rounds=declare.allocate(schema.Rounds, sizes, device),
            selected=declare.allocate(schema.Rounds, sizes, device),
            turn=wp.zeros(1, dtype=int, device=device),
            wanted=wp.zeros((CHUNK, len(POOLS)), dtype=int, device=device),
        )

    @property
    def levels(self) -> dict[str, wp.array]:
        """Levels of the last step, which users can read."""
        return {"Graph.level": self.graph.level, "Graph.level_count": self.graph.level_count}

    def begin(self) -> None:
        """Reset the required sizes, and start at the first row."""
        self.turn.zero_()
        self.wanted.zero_()

    def forget_graph(self) -> None:
        """Discard the graph of the last step, so that the next step computes it again."""
        self.graph.active_before.zero_()

    def wanted_by_environment(self, name: str) -> np.ndarray:
        """Required size of a pool for each environment in the current step, (envs,); may exceed the capacity."""
        if name == "pairs":
            body, count = np.arange(self.sizes["bodies"]), self.pairs.count.numpy()[:-1]
        else:
            listed = int(self.pairs.start.numpy()[-1])
            body, count = self.pairs.body_a.numpy()[:listed], self.pairs.contact_count.numpy()[:listed]
        envs = self.sizes["envs"]
        return np.bincount(body // (self.sizes["bodies"] // envs), weights=count, minlength=envs).astype(np.int64)

    def larger_sizes(self, shortage: dict[str, int]) -> dict[str, int]:
        """Sizes enlarged to the required numbers of entries, times HEADROOM."""
        larger = {name: min(int(n * HEADROOM) + 1, LARGEST) for name, n in shortage.items()}
        pairs = larger.get("pairs", self.sizes["pairs"])
        return {**self.sizes, **larger, "constraints": pairs + self.sizes["others"]}

    def grown(self, sizes: dict[str, int]) -> "Pools":
        """Larger pools with the same history."""
        pools = Pools.allocate(sizes, self.wanted.device)
        pools.history.contact_start.fill_(int(self.history.contact_start.numpy()[-1]))
        copy_arrays(self.history, pools.history, schema.History)
        for name, array in self.levels.items():
            wp.copy(pools.levels[name], array)
        return pools


def expected_capacity(num_envs: int, dynamic: int) -> tuple[int, int]:
    """Initial pairs and contacts: six pairs per dynamic body in all environments, six contacts per pair."""
    pairs = min(num_envs * max(8, 6 * dynamic), LARGEST)
    return pairs, min(6 * pairs, LARGEST)


def copy_arrays(source: Any, target: Any, struct: Any) -> None:
    """Copy all arrays of a struct to the start of the arrays of another one."""
    for name in declare.field_names(struct):
        array = getattr(source, name)
        wp.copy(getattr(target, name), array, count=array.size)
