"""The candidate pairs of the broad phase: their arrays, and the launches that keep them up to date."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.collide import candidates

if TYPE_CHECKING:
    from warp_rigid.engine.model import Model

TRY_ALL_UP_TO = 256
"""Up to this number of bodies per environment, testing all pairs is faster than keeping candidates."""

BUCKETS_PER_BODY = 2
"""Minimum number of buckets for each body, so that cells seldom share a bucket."""

CANDIDATES_PER_BODY = 24
"""Initial capacity of the list of each body; the longest list of a heap of boxes has about as many."""

ORDINARY_WIDTH = 1.3
"""Cell width at the level of ordinary bodies, divided by their diameter, so that most fat boxes at rest fit in."""

LANES = 32
"""GPU lanes that test the candidates of a body of a large environment."""


def grid_sizes(num_envs: int, num_bodies: int) -> dict[str, int]:
    """Symbols of the data layout and their values; all are 0 where all pairs of an environment are tested."""
    if num_bodies <= TRY_ALL_UP_TO:
        return {"boxed": 0, "buckets": 0, "candidates": 0}
    return {
        "boxed": num_envs * num_bodies,
        "buckets": num_envs << math.ceil(math.log2(BUCKETS_PER_BODY * num_bodies)),
        "candidates": num_envs * num_bodies * CANDIDATES_PER_BODY,
    }


class HashGrid:
    """The order of the bodies of an environment and, if it has many, their candidate pairs.

    Args:
        model: the scene on the device.
        sizes: symbols of the data layout and their values, with those of `grid_sizes`.
        device: the Warp device.

    Attributes:
        buckets: number of buckets of each environment, a power of two; 0 if all pairs are tested.
        room: capacity of the list of each body.
        lanes: GPU lanes that test the candidates of a body.
        cells: the device arrays.
    """

    def __init__(self, model: "Model", sizes: dict[str, int], device: Any) -> None:
        """Allocate the arrays; all candidates are computed in the first step."""
        self.device, self.count, self.num_envs = device, sizes["bodies"], model.num_envs
        self.buckets = sizes["buckets"] // model.num_envs
        self.room = sizes["candidates"] // sizes["bodies"]
        self.lanes = LANES if self.buckets and device.is_cuda else 1
        self.cells: Any = declare.allocate(schema.Cells, sizes, device)
        self._model = model
        self._finest = ORDINARY_WIDTH * model.grid_radius / (1 << candidates.FINER_LEVELS)
        order = np.concatenate([model.small, model.oversized]).astype(np.int32)
        self.cells.order.assign(np.tile(order, self.num_envs))
        self.cells.rank.assign(np.tile(np.argsort(order).astype(np.int32), self.num_envs))
        self.cells.listed.fill_(int(candidates.ALL_LATER))
        self.cells.lower.fill_(math.inf)

    def update(self, dt: float, envs: Any, motions: Any, which: int, turn: wp.array, wanted: wp.array) -> None:
        """Compute the candidates of the environments in which a body has left its fat box.

        Args:
            dt: time step [s], for the motion ahead.
            envs: the environments.
            motions: with the swept boxes of this step.
            which: column of `wanted` for the capacity.
            turn: see Pools.
            wanted: see Pools.
        """
        if not self.buckets:
            return
        cells, bodies = self.cells, self._model.bodies
        for array in (cells.stale, cells.levels, cells.dynamic_levels):
            array.zero_()
        inputs = [dt, self.buckets, self._finest, self._model.shapes, bodies, motions]
        self._per_body(candidates.find_stale, [bodies, envs, motions])
        self._per_body(candidates.enlarge_boxes, inputs)
        wp.utils.array_scan(cells.bucket_count, cells.bucket_start, inclusive=False)
        self._per_body(candidates.fill_buckets, [self.buckets, bodies])
        self._per_body(candidates.search_cells, [self.buckets, self.room, self._finest, bodies])
        self._per_body(candidates.finish_lists, [which, self.room, bodies, turn], [wanted])

    def _per_body(self, kernel: Any, inputs: list, more: Sequence = ()) -> None:
        outputs = [self.cells, *more]
        wp.launch(kernel, dim=self.count, inputs=inputs, outputs=outputs, device=self.device)
