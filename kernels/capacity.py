"""Keeping count of what the pools were asked to hold.

A pool that is too small makes the whole step void: its list is emptied, so that nothing is read or written out of
bounds, and the wanted size is kept. The host then undoes the step, enlarges the pool and repeats it.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


UNCOUNTABLE = wp.constant(2**31 - 1)
"""Stands for all totals that 32 bits cannot hold."""


@wp.kernel
def note_wanted(which: int, start: wp.array[int], wanted: wp.array[int]):
    """Keep the largest number of entries wanted so far; `start` holds the exclusive sums of counts >= 0.

    Sums that do not fit into 32 bits wrap, and the first of them is negative: two numbers < 2^31 make one < 2^32.
    """
    i = wp.tid()
    if start[i] < 0:
        wp.atomic_max(wanted, which, UNCOUNTABLE)
    elif i == start.shape[0] - 1:
        wp.atomic_max(wanted, which, start[i])


@wp.kernel
def empty_if_over(which: int, capacity: int, wanted: wp.array[int], start: wp.array[int]):
    """Empty a list that does not fit into its pool, and those of later steps: they are undone with it."""
    if wanted[which] > capacity:
        start[wp.tid()] = 0
