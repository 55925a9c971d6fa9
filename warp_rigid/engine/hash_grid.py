"""The hash grid of the broad phase: its bodies, and sorting them into buckets."""

import math
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.engine.model import Model
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.collide import broadphase

TRY_ALL_UP_TO = 256
"""Up to this number of small bodies per environment, testing all pairs is faster than the grid."""

BUCKETS_PER_BODY = 2
"""Minimum number of buckets for each small body, so that cells seldom share a bucket."""


class HashGrid:
    """Lists of small and oversized bodies, and buckets of the small bodies if an environment has many.

    Args:
        model: the scene on the device.
        device: the Warp device.

    Attributes:
        buckets: number of buckets of each environment, a power of two; 0 if all pairs are tested.
        cells: the device arrays.
    """

    def __init__(self, model: Model, device: Any) -> None:
        """Allocate the arrays."""
        self.device, self.width, self.num_envs = device, model.grid_radius, model.num_envs
        small, oversized = len(model.small), len(model.oversized)
        self.count = self.num_envs * small
        self.buckets = 1 << math.ceil(math.log2(BUCKETS_PER_BODY * small)) if small > TRY_ALL_UP_TO else 0
        sizes = {
            "envs": self.num_envs,
            "small": self.count,
            "oversized": self.num_envs * oversized,
            "points": self.count if self.buckets else 0,
            "buckets": self.num_envs * self.buckets,
        }
        self.cells: Any = declare.allocate(schema.Cells, sizes, device)
        envs = np.arange(self.num_envs + 1, dtype=np.int32)
        self.cells.small_start.assign(small * envs)
        self.cells.oversized_start.assign(oversized * envs)
        if small:
            self.cells.small.assign(np.tile(model.small, self.num_envs))
            self.cells.small_env.assign(np.repeat(envs[:-1], small))
        if oversized:
            self.cells.oversized.assign(np.tile(model.oversized, self.num_envs))

    def fill(self, envs: Any, motions: Any) -> None:
        """Sort the small bodies into buckets, if there are buckets; bodies in the same bucket keep their order."""
        if not self.buckets:
            return
        cells, device = self.cells, self.device
        cells.reach.zero_()
        inputs = [self.buckets, self.width, envs, motions]
        wp.launch(broadphase.choose_buckets, dim=self.count, inputs=inputs, outputs=[cells], device=device)
        end_bit = (self.num_envs * self.buckets).bit_length()
        wp.utils.radix_sort_pairs(cells.key, cells.member, self.count, end_bit=end_bit)
        inputs = [self.count]
        wp.launch(broadphase.find_bucket_starts, dim=self.count + 1, inputs=inputs, outputs=[cells], device=device)
