"""The hash grid of the broad phase: its bodies, and sorting them into buckets."""

import math
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.engine.layout import exclusive_sums
from warp_rigid.engine.model import Model
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.collide import broadphase

TRY_ALL_UP_TO = 256
"""Up to this number of small bodies per environment, testing all pairs is faster than the grid."""

BUCKETS_PER_BODY = 2
"""Minimum number of buckets for each small body, so that cells seldom share a bucket."""


class HashGrid:
    """Lists of small and oversized bodies, and buckets of the small bodies of environments that have many.

    Args:
        model: the scenes on the device.
        device: the Warp device.

    Attributes:
        buckets: number of buckets of all environments; 0 if all pairs are tested in each of them.
        cells: the device arrays.
    """

    def __init__(self, model: Model, device: Any) -> None:
        """Allocate the arrays."""
        self.device, layout = device, model.layout
        groups = [model.size_groups[scene] for scene in layout.scenes]
        small = np.array([len(group.small) for group in groups])[layout.scene_of]
        oversized = np.array([len(group.oversized) for group in groups])[layout.scene_of]
        first_bucket = exclusive_sums(np.array([_buckets_of(len(group.small)) for group in groups])[layout.scene_of])
        self.count, self.buckets = int(small.sum()), int(first_bucket[-1])
        sizes = {
            "envs": layout.num_envs,
            "small": self.count,
            "oversized": int(oversized.sum()),
            "points": self.count if self.buckets else 0,
            "buckets": self.buckets,
        }
        cells: Any = declare.allocate(schema.Cells, sizes, device)
        self.cells = cells
        cells.small_start.assign(exclusive_sums(small).astype(np.int32))
        cells.oversized_start.assign(exclusive_sums(oversized).astype(np.int32))
        cells.width.assign(np.array([group.width for group in groups], np.float32)[layout.scene_of])
        cells.first_bucket.assign(first_bucket.astype(np.int32))
        if self.count:
            cells.small.assign(_copied(model, [group.small for group in groups]))
            cells.small_env.assign(np.repeat(np.arange(layout.num_envs, dtype=np.int32), small))
        if oversized.any():
            cells.oversized.assign(_copied(model, [group.oversized for group in groups]))

    def fill(self, envs: Any, motions: Any) -> None:
        """Sort the small bodies into buckets, if there are buckets; bodies in the same bucket keep their order."""
        if not self.buckets:
            return
        cells, device = self.cells, self.device
        cells.reach.zero_()
        inputs = [envs, motions]
        wp.launch(broadphase.choose_buckets, dim=self.count, inputs=inputs, outputs=[cells], device=device)
        end_bit = self.buckets.bit_length()
        wp.utils.radix_sort_pairs(cells.key, cells.member, self.count, end_bit=end_bit)
        inputs = [self.count]
        wp.launch(broadphase.find_bucket_starts, dim=self.count + 1, inputs=inputs, outputs=[cells], device=device)


def _buckets_of(small: int) -> int:
    """Number of buckets of an environment, a power of two; 0 if all pairs are tested."""
    return 1 << math.ceil(math.log2(BUCKETS_PER_BODY * small)) if small > TRY_ALL_UP_TO else 0


def _copied(model: Model, lists: list[np.ndarray]) -> np.ndarray:
    """The lists of the scenes, copied to the environments."""
    return np.concatenate(lists)[model.layout.copies([len(some) for some in lists])].astype(np.int32)
