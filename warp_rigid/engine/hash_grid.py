"""The candidate pairs of the broad phase: their arrays, and the launches that keep them up to date."""

from typing import Any

import numpy as np
import warp as wp

from warp_rigid.engine.layout import exclusive_sums
from warp_rigid.engine.pools import CANDIDATES
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.collide import candidates
from warp_rigid.kernels.common import capacity
from warp_rigid.kernels.common.crowd import CROWDED

TRY_ALL_UP_TO = 256
"""Up to this number of bodies per environment, testing all pairs is faster than keeping candidates."""

BUCKETS_PER_BODY = 2
"""Minimum number of buckets for each body, so that cells seldom share a bucket."""

CANDIDATES_PER_BODY = 48
"""Initial capacity of the list of each body; the longest list of a landing heap of 4096 boxes has 33 entries."""

ORDINARY_WIDTH = 1.3
"""Cell width at the level of ordinary bodies, divided by their diameter, so that most fat boxes at rest fit in."""

LANES = 32
"""GPU lanes that search the cells around a body of a large environment, and that test its candidates."""


def grid_sizes(bodies_per_env: np.ndarray) -> dict[str, int]:
    """Symbols of the data layout and their values; all are 0 in batches of small environments.

    These have no heaps that are solved in rounds, and all of their pairs are tested.

    Args:
        bodies_per_env: (envs,) number of bodies of each environment.
    """
    buckets, bodies = int(_buckets(bodies_per_env).sum()), int(bodies_per_env.sum())
    crowd = bodies if bodies_per_env.max() > CROWDED else 0
    boxed = bodies if buckets > 0 else 0
    return {"crowd": crowd, "boxed": boxed, "buckets": buckets, "candidates": boxed * CANDIDATES_PER_BODY}


class HashGrid:
    """The order of the bodies of each environment and, if one has many, their candidate pairs.

    Args:
        of_step: the Stages of the step.

    Attributes:
        buckets: number of buckets of all environments; 0 if all pairs are tested in each of them.
        room: capacity of the list of each body.
        lanes: GPU lanes that search the cells around a body, and that test its candidates.
        cells: the device arrays.
    """

    def __init__(self, of_step: Any) -> None:
        """Allocate the arrays; all candidates are computed in the first step."""
        self._step = of_step
        layout, sizes = of_step.model.layout, of_step.pools.sizes
        self.buckets = sizes["buckets"]
        self.room = sizes["candidates"] // sizes["bodies"]
        self.lanes = LANES if self.buckets and of_step.device.is_cuda else 1
        self.cells: Any = declare.allocate(schema.Cells, sizes, of_step.device)
        groups = [of_step.model.size_groups[scene] for scene in layout.scenes]
        orders = [np.concatenate([group.small, group.oversized]).astype(np.int32) for group in groups]
        source = layout.copies([len(order) for order in orders])
        self.cells.order.assign(np.concatenate(orders)[source])
        self.cells.rank.assign(np.concatenate([np.argsort(order).astype(np.int32) for order in orders])[source])
        finest = np.array([ORDINARY_WIDTH * group.width / (1 << candidates.FINER_LEVELS) for group in groups])
        self.cells.width.assign(finest[layout.scene_of].astype(np.float32))
        self.cells.first_bucket.assign(exclusive_sums(_buckets(layout.bodies_per_env)).astype(np.int32))

    def update(self) -> None:
        """Compute the candidates of the environments in which a body has left its fat box."""
        if not self.buckets:
            return
        step, cells, bodies, pools = self._step, self.cells, self._step.model.bodies, self._step.pools
        for array in (cells.stale, cells.levels, cells.dynamic_levels):
            array.zero_()
        step.per_body(candidates.find_stale, [bodies, step.envs, step.motions], [cells])
        step.per_body(candidates.enlarge_boxes, [step.dt, step.model.shapes, bodies, step.motions], [cells])
        wp.utils.array_scan(cells.bucket_count, cells.bucket_start, inclusive=False)
        step.per_body(candidates.fill_buckets, [bodies], [cells])
        step.launch(candidates.search_cells, step.rows * self.lanes, [self.room, self.lanes, bodies], [cells])
        inputs = [CANDIDATES, self.room, bodies, pools.wanted_row]
        step.per_body(candidates.finish_lists, inputs, [cells, pools.wanted])

    def note_use(self) -> None:
        """Record the capacity that the current lists require; a step only records what exceeds their capacity."""
        if self.buckets:
            self._step.per_body(capacity.note_longest, [CANDIDATES, self.cells.listed], [self._step.pools.wanted])


def _buckets(bodies_per_env: np.ndarray) -> np.ndarray:
    """Number of buckets of each environment, a power of two; 0 where all pairs are tested."""
    least = np.ceil(np.log2(BUCKETS_PER_BODY * bodies_per_env)).astype(np.int64)
    return np.where(bodies_per_env > TRY_ALL_UP_TO, 1 << least, 0)
