"""The candidate pairs of the broad phase: their arrays, and the launches that keep them up to date."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_rigid.engine.layout import exclusive_sums
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.collide import candidates
from warp_rigid.kernels.common import capacity
from warp_rigid.kernels.common.crowd import CROWDED

if TYPE_CHECKING:
    from warp_rigid.engine.model import Model

TRY_ALL_UP_TO = 256
"""Up to this number of bodies per environment, testing all pairs is faster than keeping candidates."""

BUCKETS_PER_BODY = 2
"""Minimum number of buckets for each body, so that cells seldom share a bucket."""

CANDIDATES_PER_BODY = 32
"""Initial capacity of the list of each body; the longest list of a heap of boxes has about 25 entries."""

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
        model: the scenes on the device.
        sizes: symbols of the data layout and their values, with those of `grid_sizes`.
        device: the Warp device.

    Attributes:
        buckets: number of buckets of all environments; 0 if all pairs are tested in each of them.
        room: capacity of the list of each body.
        lanes: GPU lanes that search the cells around a body, and that test its candidates.
        cells: the device arrays.
    """

    def __init__(self, model: "Model", sizes: dict[str, int], device: Any) -> None:
        """Allocate the arrays; all candidates are computed in the first step."""
        layout = model.layout
        self.device, self.count, self.buckets = device, sizes["bodies"], sizes["buckets"]
        self.room = sizes["candidates"] // sizes["bodies"]
        self.lanes = LANES if self.buckets and device.is_cuda else 1
        self.cells: Any = declare.allocate(schema.Cells, sizes, device)
        self._model = model
        groups = [model.size_groups[scene] for scene in layout.scenes]
        orders = [np.concatenate([group.small, group.oversized]).astype(np.int32) for group in groups]
        source = layout.copies([len(order) for order in orders])
        self.cells.order.assign(np.concatenate(orders)[source])
        self.cells.rank.assign(np.concatenate([np.argsort(order).astype(np.int32) for order in orders])[source])
        finest = np.array([ORDINARY_WIDTH * group.width / (1 << candidates.FINER_LEVELS) for group in groups])
        self.cells.width.assign(finest[layout.scene_of].astype(np.float32))
        self.cells.first_bucket.assign(exclusive_sums(_buckets(layout.bodies_per_env)).astype(np.int32))

    def update(self, dt: float, envs: Any, motions: Any, which: int, wanted_row: wp.array, wanted: wp.array) -> None:
        """Compute the candidates of the environments in which a body has left its fat box.

        Args:
            dt: time step [s], for the motion ahead.
            envs: the environments.
            motions: with the swept boxes of this step.
            which: column of `wanted` for the capacity.
            wanted_row: see Pools.
            wanted: see Pools.
        """
        if not self.buckets:
            return
        cells, bodies = self.cells, self._model.bodies
        for array in (cells.stale, cells.levels, cells.dynamic_levels):
            array.zero_()
        inputs = [dt, self._model.shapes, bodies, motions]
        self._per_body(candidates.find_stale, [bodies, envs, motions])
        self._per_body(candidates.enlarge_boxes, inputs)
        wp.utils.array_scan(cells.bucket_count, cells.bucket_start, inclusive=False)
        self._per_body(candidates.fill_buckets, [bodies])
        inputs = [self.room, self.lanes, bodies]
        wp.launch(
            candidates.search_cells, dim=self.count * self.lanes, inputs=inputs, outputs=[cells], device=self.device
        )
        self._per_body(candidates.finish_lists, [which, self.room, bodies, wanted_row], [wanted])

    def note_use(self, which: int, wanted: wp.array) -> None:
        """Record the capacity that the current lists of candidates require; the arguments are those of `update`."""
        if self.buckets:
            inputs = [which, self.cells.listed]
            wp.launch(capacity.note_longest, dim=self.count, inputs=inputs, outputs=[wanted], device=self.device)

    def _per_body(self, kernel: Any, inputs: list, more: Sequence = ()) -> None:
        outputs = [self.cells, *more]
        wp.launch(kernel, dim=self.count, inputs=inputs, outputs=outputs, device=self.device)


def _buckets(bodies_per_env: np.ndarray) -> np.ndarray:
    """Number of buckets of each environment, a power of two; 0 where all pairs are tested."""
    least = np.ceil(np.log2(BUCKETS_PER_BODY * bodies_per_env)).astype(np.int64)
    return np.where(bodies_per_env > TRY_ALL_UP_TO, 1 << least, 0)
