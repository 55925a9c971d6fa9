"""Pools: arrays whose required size is known only during the simulation, such as pairs and contacts.

What the last steps required of them, and from its trend what the next ones may require, is their demand.
"""

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.engine.layout import Layout, exclusive_sums
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.collide.near_samples import NearSamples, Suspects
from warp_rigid.kernels.declare import Lifetime
from warp_rigid.kernels.graph import heap_arrays
from warp_rigid.kernels.joints.arrays import VisitOrder

NAMES = ("pairs", "contacts")
"""Names of the pools whose capacity users can give."""

POOLS = (*NAMES, "candidates", "near_samples")
"""Names of all pools, in the order of `wanted` on the device."""

PAIRS, CONTACTS, CANDIDATES, NEAR_SAMPLES = range(len(POOLS))
"""Columns of `wanted`."""

LARGEST = 2**30
"""Maximum capacity of a pool, as the two ends of each pair are counted in 32 bits."""

CHUNK = 16
"""Maximum number of steps between two capacity checks; as many are repeated after an overflow."""

NEAR_PER_PAIR, LEAST_NEAR = 4, 16384
"""Initial capacity for near samples: per pair, and at least."""

HEADROOM = 1.5
"""A pool that is too small grows to this factor times the required size."""

SOON, LATER = 1.5, 4.0
"""A pool grows if the next steps exceed it that rise by the first number times the last rise, as landings accelerate.
It is sized for a rise by the second number, as are the pools which that exceeds: the step is recorded again anyway."""


def _arrays(struct: Any) -> Any:
    """A field of Pools that holds the arrays of a struct."""
    return field(metadata={"struct": struct})


@dataclass
class Pools:
    """Arrays sized by the number of pairs and contacts, and the sizes that the last steps required.

    Attributes:
        layout: the environments.
        sizes: symbols of the data layout and their values.
        wanted_row: (1,) row of `wanted` for the current step.
        wanted: (CHUNK, 4) required number of pairs, contacts, candidates and near samples of each step; of candidates
            only a number that exceeds the capacity, and in the first row, after the steps, that of the last one.
        pairs: candidate pairs.
        near: samples of the searched pairs that may touch.
        suspects: samples that continuous collision detection traces.
        contacts: contact rows.
        history: contacts of the last step.
        constraints: all constraints of the step.
        graph: contact graph.
        order: constraints that are solved in sweeps, by colour.
        visits: those of mechanisms that are solved where the joints hold, colour by colour.
        rounds: pairs of heaps, which are solved in rounds.
        selected: pairs of heaps with an impact, then those with an overlap.
        slots: velocity changes of the bodies of heaps by each of their pairs.
    """

    layout: Layout
    sizes: dict[str, int]
    wanted_row: wp.array
    wanted: wp.array
    pairs: Any = _arrays(schema.Pairs)
    near: Any = _arrays(NearSamples)
    suspects: Any = _arrays(Suspects)
    contacts: Any = _arrays(schema.Contacts)
    history: Any = _arrays(schema.History)
    constraints: Any = _arrays(schema.Constraints)
    graph: Any = _arrays(schema.Graph)
    order: Any = _arrays(schema.Order)
    visits: Any = _arrays(VisitOrder)
    rounds: Any = _arrays(heap_arrays.Rounds)
    selected: Any = _arrays(heap_arrays.Rounds)
    slots: Any = _arrays(heap_arrays.Slots)

    @classmethod
    def allocate(cls, layout: Layout, sizes: dict[str, int], device: Any) -> "Pools":
        """Allocate empty pools of these sizes (see `sizes_for`)."""
        arrays = {name: declare.allocate(struct, sizes, device) for name, struct in STRUCTS.items()}
        wanted_row = wp.zeros(1, dtype=int, device=device)
        wanted = wp.zeros((CHUNK, len(POOLS)), dtype=int, device=device)
        return cls(layout=layout, sizes=sizes, wanted_row=wanted_row, wanted=wanted, **arrays)

    def begin(self) -> None:
        """Reset the required sizes, and start at the first row."""
        self.wanted_row.zero_()
        self.wanted.zero_()

    def forget_graph(self) -> None:
        """Discard the graph of the last step, so that the next step computes it again."""
        declare.compute_again(self.graph)

    def used(self) -> dict[str, int]:
        """Rows in use of the history, by the symbol that counts them."""
        pairs, contacts = self.history.pair_start.numpy()[-1], self.history.contact_start.numpy()[-1]
        return {"bodies": self.sizes["bodies"], "pairs": int(pairs), "contacts": int(contacts)}

    def remove_pairs(self, bodies: np.ndarray) -> None:
        """Remove the pairs of some bodies from the history, with their contacts; the graph must be forgotten, too."""
        history, used = self.history, self.used()
        start = history.pair_start.numpy()
        of_pair = np.diff(history.contact_start.numpy()[: used["pairs"] + 1])
        body_a = np.repeat(np.arange(used["bodies"]), np.diff(start))
        stays = ~(np.isin(body_a, bodies) | np.isin(history.body_b.numpy()[: used["pairs"]], bodies))
        if stays.all():
            return
        kept = {"pairs": stays, "contacts": np.repeat(stays, of_pair)}
        sums = {"bodies": np.bincount(body_a[stays], minlength=used["bodies"]), "pairs": of_pair[stays]}
        for _, stated, array in declare.arrays_of(history, Lifetime.REMEMBERED):
            symbol = declare.counted_by(stated)
            rows = (
                exclusive_sums(sums[symbol]) if declare.is_sum(stated) else array.numpy()[: used[symbol]][kept[symbol]]
            )
            fill(array, rows)

    def wanted_by_environment(self, name: str) -> np.ndarray:
        """Required size of a pool for each environment in the current step, (envs,); may exceed the capacity."""
        if name == "pairs":
            body, count = np.arange(self.sizes["bodies"]), self.pairs.count.numpy()[:-1]
        else:
            listed = int(self.pairs.start.numpy()[-1])
            body, count = self.pairs.body_a.numpy()[:listed], self.pairs.contact_count.numpy()[:listed]
        env = self.layout.env_of_row[body]
        return np.bincount(env, weights=count, minlength=self.layout.num_envs).astype(np.int64)

    def larger_sizes(self, shortage: dict[str, int]) -> dict[str, int]:
        """Sizes enlarged to the required numbers of entries, times HEADROOM."""
        larger = {name: min(int(n * HEADROOM) + 1, LARGEST) for name, n in shortage.items()}
        return with_lists({**self.sizes, **larger})

    def grown(self, sizes: dict[str, int]) -> "Pools":
        """Larger pools with the same history."""
        pools = Pools.allocate(self.layout, sizes, self.wanted.device)
        pools.history.contact_start.fill_(int(self.history.contact_start.numpy()[-1]))
        for name in declare.field_names(schema.History):
            array = getattr(self.history, name)
            wp.copy(getattr(pools.history, name), array, count=array.size)
        for name, _, array in declare.arrays_of(self.graph, Lifetime.REMEMBERED):
            wp.copy(getattr(pools.graph, name), array)
        return pools


STRUCTS = {entry.name: entry.metadata["struct"] for entry in fields(Pools) if entry.metadata}
"""The structs of the pools, by their attribute."""


class Demand:
    """Sizes that the last steps of a shard required of the pools.

    Attributes:
        wanted: (steps, 4) sizes that each of the last 2 CHUNK steps required, in the order of the pools.
    """

    def __init__(self) -> None:
        """Nothing is known before the first step."""
        self.wanted = np.zeros((0, len(POOLS)), np.int64)

    @property
    def known(self) -> bool:
        """Whether a step has been noted."""
        return len(self.wanted) > 0

    def note(self, wanted: np.ndarray) -> None:
        """Add the sizes that valid steps required, (steps, 4)."""
        self.wanted = np.concatenate([self.wanted, wanted])[-2 * CHUNK :]

    def missing(self, sizes: dict[str, int]) -> dict[str, int]:
        """Pools that should grow before the next steps, with the sizes that these may require.

        Args:
            sizes: the present sizes of the pools.
        """
        if not self.known:
            return {}
        last = self.wanted[-CHUNK:].max(axis=0)
        before = (self.wanted[:-CHUNK] if len(self.wanted) > CHUNK else self.wanted[:1]).max(axis=0)
        # The first contacts of a stack are most of those that it will have: a rise from nothing is no trend.
        rise = np.where(before > 0, np.maximum(last - before, 0), 0)
        present = np.array([sizes[name] for name in POOLS])
        soon, later = (np.minimum(last + times * rise, LARGEST) for times in (SOON, LATER))
        if (soon <= present).all():
            return {}
        expected = np.maximum(later, present).astype(np.int64).tolist()
        return {name: n for name, n, low in zip(POOLS, expected, later > present, strict=True) if low}


def expected_pairs(dynamic: np.ndarray) -> np.ndarray:
    """Initial capacity for pairs of environments with a number of dynamic bodies: six pairs each."""
    return np.maximum(8, 6 * dynamic)


def sizes_for(pairs: int, contacts: int, layout: dict[str, int]) -> dict[str, int]:
    """Symbols of the data layout and their values.

    Args:
        pairs: capacity for pairs.
        contacts: capacity for contacts.
        layout: sizes of the layout, with those of `grid_sizes`.
    """
    near = min(max(NEAR_PER_PAIR * pairs, LEAST_NEAR), LARGEST)
    return with_lists({**layout, "pairs": pairs, "contacts": contacts, "near_samples": near})


def with_lists(sizes: dict[str, int]) -> dict[str, int]:
    """Sizes of the data layout with those of the lists of pairs."""
    count = sizes["pairs"]
    return {**sizes, "crowd_pairs": count if sizes["crowd"] > 0 else 0, "visits": count if sizes["joints"] > 0 else 0}


def fill(array: wp.array, rows: np.ndarray) -> None:
    """Write the first rows of an array, and the last of them to all that follow (sums stay what they are)."""
    host = array.numpy().copy()
    host[: len(rows)] = rows
    if 0 < len(rows) < len(host):
        host[len(rows) :] = rows[-1]
    array.assign(host)
