"""Demand: what the last steps required of the pools, and from its trend what the next ones may require."""

import numpy as np

from warp_rigid.engine.pools import CHUNK, LARGEST, POOLS

SOON, LATER = 1.5, 4.0
"""A pool grows if the next steps exceed it that rise by the first number times the last rise, as landings accelerate.
It is sized for a rise by the second number, as are the pools which that exceeds: the step is recorded again anyway."""


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
