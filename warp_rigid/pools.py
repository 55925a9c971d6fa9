"""Pools whose needed size is known only while simulating: pairs, contacts, and all that is sized with them."""

import logging
from dataclasses import dataclass
from typing import Any

import warp as wp

from warp_rigid.kernels import data

log = logging.getLogger("warp_rigid")

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
        graph: contact graph and order.
        wanted: (2,) most pairs and most contacts wanted.
        over: (2,) whether this step wanted more than there is.
    """

    sizes: dict[str, int]
    pairs: Any
    contacts: Any
    history: Any
    graph: Any
    wanted: wp.array
    over: wp.array

    @classmethod
    def allocate(cls, num_envs: int, bodies_per_env: int, pairs: int, contacts: int, device: Any) -> "Pools":
        """Make empty pools for so many pairs and contacts over all environments."""
        sizes = {
            "envs": num_envs,
            "bodies": num_envs * bodies_per_env,
            "levels": num_envs * (bodies_per_env + 2),
            "pairs": pairs,
            "contacts": contacts,
        }
        return cls(
            sizes=sizes,
            pairs=data.allocate(data.Pairs, sizes, device),
            contacts=data.allocate(data.Contacts, sizes, device),
            history=data.allocate(data.History, sizes, device),
            graph=data.allocate(data.Graph, sizes, device),
            wanted=wp.zeros(2, dtype=int, device=device),
            over=wp.zeros(2, dtype=int, device=device),
        )

    def shortage(self) -> dict[str, int]:
        """Sizes that the pools should have, for those that were too small (waits for the device)."""
        wanted = dict(zip(("pairs", "contacts"), self.wanted.numpy().tolist(), strict=True))
        return {name: int(n * HEADROOM) + 1 for name, n in wanted.items() if n > self.sizes[name]}

    def grown(self, shortage: dict[str, int], num_envs: int, bodies_per_env: int) -> "Pools":
        """Larger pools that remember the same last step."""
        sizes = {**self.sizes, **shortage}
        log.info(
            "contact pools grow: pairs %d -> %d, contacts %d -> %d; the steps are repeated",
            self.sizes["pairs"],
            sizes["pairs"],
            self.sizes["contacts"],
            sizes["contacts"],
        )
        pools = Pools.allocate(num_envs, bodies_per_env, sizes["pairs"], sizes["contacts"], self.wanted.device)
        pools.history.contact_start.fill_(int(self.history.contact_start.numpy()[-1]))
        copy_arrays(self.history, pools.history, data.History)
        copy_arrays(self.contacts, pools.contacts, data.Contacts)
        wp.copy(pools.graph.level, self.graph.level)
        wp.copy(pools.graph.level_count, self.graph.level_count)
        wp.copy(pools.wanted, self.wanted)
        return pools


def copy_arrays(source: Any, target: Any, struct: Any) -> None:
    """Copy all arrays of a struct into the beginning of another's."""
    for name in data.field_names(struct):
        array = getattr(source, name)
        wp.copy(getattr(target, name), array, count=array.size)
