"""Capacity: the number of entries that each step requires of the pools, and overflow handling.

If a pool is too small, the step is invalid: the list is emptied, so that nothing is read or written out of bounds, and
the required size is recorded for this step. The host then undoes the step, enlarges the pool and repeats the step.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def note_wanted(which: int, start: wp.array[int], wanted_row: wp.array[int], wanted: wp.array2d[int]):
    """Record the largest number of entries required in this step; `start` holds the exclusive sums of counts >= 0.

    Sums that exceed 32 bits wrap around. The first such sum is negative, as the sum of two numbers < 2^31 is < 2^32.
    """
    i = wp.tid()
    if start[i] < 0:
        # In place of a total that exceeds 32 bits.
        wp.atomic_max(wanted, wanted_row[0], which, 0x7FFFFFFF)
    elif i == start.shape[0] - 1:
        wp.atomic_max(wanted, wanted_row[0], which, start[i])


@wp.kernel
def note_longest(which: int, lengths: wp.array[int], wanted: wp.array2d[int]):
    """Record in the first row the capacity that lists of equal capacity require, by the longest of them."""
    length = lengths[wp.tid()]
    if length > 0:
        wp.atomic_max(wanted, 0, which, length * lengths.shape[0])


@wp.kernel
def close_row(wanted: wp.array2d[int], wanted_row: wp.array[int]):
    """Advance to the next step's row of `wanted`; steps beyond the last row share it."""
    wanted_row[0] = wp.min(wanted_row[0] + 1, wanted.shape[0] - 1)


@wp.kernel
def empty_if_over(which: int, capacity: int, wanted_row: wp.array[int], wanted: wp.array2d[int], start: wp.array[int]):
    """Empty a list that exceeds the capacity of its pool."""
    if wanted[wanted_row[0], which] > capacity:
        start[wp.tid()] = 0


@wp.func
def usable_count(
    thread: int, which: int, count: int, capacity: int, wanted_row: wp.array[int], wanted: wp.array2d[int]
):
    """Record the length of a list that threads have filled. Returns it, or 0 if it exceeds the capacity."""
    if thread == 0:
        wp.atomic_max(wanted, wanted_row[0], which, count)
    return wp.where(count > capacity, 0, count)
