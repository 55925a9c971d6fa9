"""Memory that a simulation needs on a device, computed before allocation."""

import os
from pathlib import Path
from typing import Any

import warp as wp

from warp_rigid.checks import number_in, whole_in
from warp_rigid.engine.layout import Layout
from warp_rigid.engine.pools import STRUCTS
from warp_rigid.engine.shape_pool import distinct_shapes
from warp_rigid.errors import CapacityError
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.joints.arrays import Joints
from warp_rigid.scene.shapes.triangle_tree import tree_bytes

LARGEST_LIMIT = 2**50


def pool_bytes(sizes: dict[str, int]) -> int:
    """Bytes of all arrays sized with the pools: candidates, lists, contacts, history and rounds twice, and so on."""
    return sum(declare.byte_size(struct, sizes) for struct in (schema.Cells, schema.History, *STRUCTS.values()))


def body_bytes(sizes: dict[str, int]) -> int:
    """Bytes of all arrays sized with bodies, environments or joints, and of their copies."""
    structs = [schema.Bodies, *[schema.State] * 3, *[schema.SleepState] * 2, schema.Motions, schema.Environments]
    structs += [Joints] * 2
    return sum(declare.byte_size(struct, sizes) for struct in structs)


def bytes_by_shape(layout: Layout, known: dict[str, int] | None = None) -> dict[str, int]:
    """Bytes of the grids, triangles and samples of each distinct shape and its copies, by the key of the shape.

    No grid is computed for it.

    Args:
        layout: the environments.
        known: bytes of single shapes by their keys, to which those of new ones are added.
    """
    known = {} if known is None else known
    sample, cluster = map(wp.types.type_size_in_bytes, (schema.SampleRecord, schema.ClusterRecord))
    found = {}
    for shape, copies in distinct_shapes(layout):
        if shape.key not in known:
            samples = shape.samples()
            records = sample * len(samples.kind) + cluster * len(samples.cluster_radius)
            known[shape.key] = records + 4 * shape.grid_nodes + tree_bytes(shape.tree_triangles)
        found[shape.key] = copies * known[shape.key]
    return found


def device_memory(device: Any) -> tuple[int, int]:
    """Total and free memory of a device [bytes]; on the CPU that of the machine or its container."""
    if device.is_cuda:
        return device.total_memory, device.free_memory
    page = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096
    total = os.sysconf("SC_PHYS_PAGES") * page if hasattr(os, "sysconf") else LARGEST_LIMIT
    free = _available(total)
    limit, used = _number(Path("/sys/fs/cgroup/memory.max")), _number(Path("/sys/fs/cgroup/memory.current"))
    if limit is not None and used is not None:
        total, free = min(total, limit), min(free, max(0, limit - used))
    return total, free


def _available(total: int) -> int:
    """Available memory as reported by Linux [bytes]; on other systems the total."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return total
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")), total)


def _number(file: Path) -> int | None:
    try:
        return int(file.read_text())
    except (OSError, ValueError):
        return None


class MemoryLimit:
    """Limit of the memory that a simulator may use on its device.

    Args:
        device: the Warp device.
        limit: bytes (int), a fraction of the device's memory (float), or None for all free memory.

    Raises:
        ValueError: the limit is none of these.
    """

    def __init__(self, device: Any, limit: int | float | None) -> None:
        """Check the limit."""
        self.device, self.given = device, limit
        if isinstance(limit, float):
            fraction = number_in("memory_limit", limit, high=1.0, above=0.0)
            self.bytes = int(fraction * device_memory(device)[0])
        else:
            self.bytes = LARGEST_LIMIT if limit is None else whole_in("memory_limit", limit, 1, LARGEST_LIMIT)

    def check(self, held: int, more: int, what: str) -> None:
        """Check that `more` bytes can be allocated in addition to the `held` ones.

        Raises:
            CapacityError: the limit or the free memory is exceeded; it states the bytes required.
        """
        total = held + more
        if total > self.bytes:
            raise CapacityError(
                f"memory_limit: {what} needs {_size(total)}, {_size(self.bytes)} are allowed; "
                f"raise memory_limit to {total} bytes or more, or simulate fewer environments",
                "memory",
                total,
                self.bytes,
            )
        free = device_memory(self.device)[1]
        if more > free:
            raise CapacityError(
                f"memory: {what} needs {_size(more)} more on {self.device}, {_size(free)} are free; "
                "simulate fewer environments at once",
                "memory",
                total,
                held + free,
            )


def _size(count: int) -> str:
    return f"{count / 1e9:.3g} GB" if count >= 1e8 else f"{count / 1e6:.3g} MB"
