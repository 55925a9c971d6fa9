"""Demand: what the last steps required of the pools, and from its trend what the next ones may require."""

import numpy as np

from warp_rigid.engine.pools import CHUNK, POOLS

WINDOW = 2 * CHUNK
"""Number of steps whose requirements are kept: those of two capacity checks."""

RISES = 2.0
"""The next steps may require more than the last ones by this factor times the last increase; landings accelerate."""


class Demand:
    """Requirements of the last steps of a shard.

    Attributes:
        wanted: (steps, 4) entries that each of the last steps required of the pools, in their order.
    """

    def __init__(self) -> None:
        """Nothing is known before the first step."""
        self.wanted = np.zeros((0, len(POOLS)), np.int64)

    @property
    def known(self) -> bool:
        """Whether a step has been noted."""
        return len(self.wanted) > 0

    def note(self, wanted: np.ndarray) -> None:
        """Add the requirements of valid steps, (steps, 4)."""
        self.wanted = np.concatenate([self.wanted, wanted])[-WINDOW:]

    def expected(self) -> dict[str, int]:
        """Entries that the next CHUNK steps may require of each pool; 0 before the first step."""
        if not self.known:
            return dict.fromkeys(POOLS, 0)
        last = self.wanted[-CHUNK:]
        before = self.wanted[:-CHUNK] if len(self.wanted) > CHUNK else self.wanted[:1]
        rise = np.maximum(last.max(axis=0) - before.max(axis=0), 0)
        return dict(zip(POOLS, (last.max(axis=0) + RISES * rise).astype(np.int64).tolist(), strict=True))
