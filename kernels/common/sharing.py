"""How the threads of a launch share its rows: on a GPU with a stride, on a CPU in chunks of consecutive rows.

On a CPU a launch is serial. To use several cores, several *workers* execute the same launches at the same time. Each
index of a launch is a chunk there. A worker that reaches it claims it, or continues with the next one if another worker
has. A worker claims a chunk of a launch only when all chunks of the launch before are finished. No worker waits for one
that has not claimed a chunk, so any number of them finishes the work, even a single one.
"""

import warp as wp

from warp_rigid.kernels.declare import Field, layout

wp.set_module_options({"enable_backward": False})

MOST_LAUNCHES = 8
"""Maximum number of successive launches whose rows are shared."""

Tickets = layout(
    "Tickets",
    "Chunks of rows that the workers of a CPU have claimed and finished, for each of some successive launches.",
    claimed=Field(int, f"{MOST_LAUNCHES}", "", "number of chunks that have been claimed, in their order"),
    finished=Field(int, f"{MOST_LAUNCHES}", "", "number of chunks that are finished"),
)


@wp.struct
class Sharing:
    """How the rows of a launch are shared: by `count` threads or teams on a GPU, in `count` chunks on a CPU.

    `launch` is the number of the launch among successive ones on a CPU.
    """

    count: int
    launch: int
    tickets: Tickets


@wp.struct
class RowRange:
    """Rows that a thread processes, from `first` to `end` - 1 with a stride."""

    first: int
    end: int
    stride: int


PATIENCE = wp.constant(1000)
"""Attempts after which a worker that waits for others gives up, so that the host can yield its core to them."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 1;
#else
    return 0;
#endif
""")
def on_gpu() -> int:
    """1 on a GPU, 0 on a CPU. It is known when a kernel is compiled."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__) && defined(__x86_64__)
    __builtin_ia32_pause();
#endif
""")
def pause():
    """Leave the core's units to its other thread for some cycles, in a loop that waits."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return counts.data[index];
#else
    return __atomic_load_n(counts.data + index, __ATOMIC_ACQUIRE);
#endif
""")
def seen(counts: wp.array[int], index: int) -> int:
    """A count that other workers change; what they wrote before is visible afterwards."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return true;
#else
    return __atomic_compare_exchange_n(
        counts.data + index, &expected, expected + 1, false, __ATOMIC_ACQ_REL, __ATOMIC_RELAXED);
#endif
""")
def raise_from(counts: wp.array[int], index: int, expected: int) -> bool:
    """Increment a count if it has the expected value. Returns whether it had; only one worker succeeds."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    __atomic_fetch_add(counts.data + index, 1, __ATOMIC_RELEASE);
#endif
""")
def announce(counts: wp.array[int], index: int):
    """Increment a count with release order: a reader of the new count also reads what this worker wrote before."""
    ...


@wp.func
def claim(index: int, sharing: Sharing):
    """Claim a chunk of the launch, once the launch before is finished. Returns its index, -1 if it is not claimed.

    On a GPU every index is claimed, and so is the only chunk of a single worker. A worker that has waited in vain for
    the launch before claims no chunk, and the host launches again.
    """
    if on_gpu() == 1 or sharing.count == 1:
        return index
    if sharing.launch > 0:
        attempt = int(0)
        while seen(sharing.tickets.finished, sharing.launch - 1) < sharing.count:
            if index > 0 or attempt == PATIENCE:
                return -1
            attempt += 1
            pause()
    if seen(sharing.tickets.claimed, sharing.launch) == index:
        if raise_from(sharing.tickets.claimed, sharing.launch, index):
            return index
    return -1


@wp.func
def rows_of(own: int, count: int, sharing: Sharing):
    """The rows of a claimed index, of `count` rows in all."""
    if on_gpu() == 1:
        return RowRange(own, count, sharing.count)
    if own < 0:
        return RowRange(0, 0, 1)
    size = (count + sharing.count - 1) / sharing.count
    return RowRange(wp.min(own * size, count), wp.min((own + 1) * size, count), 1)


@wp.func
def finish(own: int, sharing: Sharing):
    """Finish the rows of a claimed index; later launches see what was written."""
    if own >= 0 and on_gpu() == 0 and sharing.count > 1:
        announce(sharing.tickets.finished, sharing.launch)
