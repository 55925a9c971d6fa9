"""Pools whose needed size is known only while simulating: pairs, contacts, and all that is sized with them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.kernels import data

NAMES = ("pairs", "contacts")
"""What is counted, in the order of `wanted` on the device."""

LARGEST = 2**30
"""Most entries of a pool: ends of pairs, two each, are counted in 32 bits."""

HEADROOM = 1.5
"""A pool that was too small grows to this many times what was wanted."""


@dataclass
class Pools:
    """Arrays sized by the number of pairs and contacts, and how many were wanted so far.

    Attributes:
        sizes: symbols of the data layout and their values.
        pairs: candidate pairs.
        contacts: contact records.
        history: contacts of the last step.
        graph: contact graph.
        by_color: touching pairs by colour.
        by_level: touching pairs by level and colour.
        wanted: (2,) most pairs and most contacts wanted.
        fitted: most pairs and contacts wanted by the steps that fitted.
    """

    sizes: dict[str, int]
    pairs: Any
    contacts: Any
    history: Any
    graph: Any
    by_color: Any
    by_level: Any
    wanted: wp.array
    fitted: tuple[int, ...] = (0, 0)

    @staticmethod
    def sizes_for(num_envs: int, bodies_per_env: int, pairs: int, contacts: int) -> dict[str, int]:
        """Symbols of the data layout and their values."""
        return {
            "envs": num_envs,
            "bodies": num_envs * bodies_per_env,
            "levels": num_envs * (bodies_per_env + 2),
            "pairs": pairs,
            "contacts": contacts,
        }

    @classmethod
    def allocate(cls, num_envs: int, bodies_per_env: int, pairs: int, contacts: int, device: Any) -> "Pools":
        """Make empty pools for so many pairs and contacts over all environments."""
        sizes = cls.sizes_for(num_envs, bodies_per_env, pairs, contacts)
        return cls(
            sizes=sizes,
            pairs=data.allocate(data.Pairs, sizes, device),
            contacts=data.allocate(data.Contacts, sizes, device),
            history=data.allocate(data.History, sizes, device),
            graph=data.allocate(data.Graph, sizes, device),
            by_color=data.allocate(data.Order, sizes, device),
            by_level=data.allocate(data.Order, sizes, device),
            wanted=wp.zeros(2, dtype=int, device=device),
        )

    def shortage(self) -> dict[str, int]:
        """What was wanted of the pools that were too small (waits for the device)."""
        wanted = self.wanted.numpy().tolist()
        short = {name: n for name, n in zip(NAMES, wanted, strict=True) if n > self.sizes[name]}
        if not short:
            self.fitted = tuple(wanted)
        return short

    def forget_shortage(self) -> None:
        """Count again from what the steps that fitted wanted."""
        self.wanted.assign(np.array(self.fitted, np.int32))

    def environment_with_most(self, name: str, bodies_per_env: int) -> int:
        """The environment that wanted most of a pool in the step that did not fit."""
        if name == "pairs":
            body, count = np.arange(self.sizes["bodies"]), self.pairs.count.numpy()[:-1]
        else:
            listed = int(self.pairs.start.numpy()[-1])
            body, count = self.pairs.body_a.numpy()[:listed], self.pairs.contact_count.numpy()[:listed]
        return int(np.bincount(body // bodies_per_env, weights=count).argmax())

    def larger_sizes(self, shortage: dict[str, int]) -> dict[str, int]:
        """Sizes with room for what was wanted, and more."""
        return {**self.sizes, **{name: min(int(n * HEADROOM) + 1, LARGEST) for name, n in shortage.items()}}

    def grown(self, sizes: dict[str, int], num_envs: int, bodies_per_env: int) -> "Pools":
        """Larger pools that remember the same last step."""
        pools = Pools.allocate(num_envs, bodies_per_env, sizes["pairs"], sizes["contacts"], self.wanted.device)
        pools.history.contact_start.fill_(int(self.history.contact_start.numpy()[-1]))
        copy_arrays(self.history, pools.history, data.History)
        wp.copy(pools.graph.level, self.graph.level)
        wp.copy(pools.by_level.level_count, self.by_level.level_count)
        pools.fitted = self.fitted
        pools.forget_shortage()
        return pools


def expected_room(num_envs: int, dynamic: int) -> tuple[int, int]:
    """Pairs and contacts to begin with: six pairs for each of `dynamic` bodies an environment, six contacts a pair."""
    pairs = min(num_envs * max(8, 6 * dynamic), LARGEST)
    return pairs, min(6 * pairs, LARGEST)


def copy_arrays(source: Any, target: Any, struct: Any) -> None:
    """Copy all arrays of a struct into the beginning of another's."""
    for name in data.field_names(struct):
        array = getattr(source, name)
        wp.copy(getattr(target, name), array, count=array.size)
