"""Keeping count of what the pools were asked to hold.

A pool that is too small makes the whole step void: its list is emptied, so that nothing is read or written out of
bounds, and the wanted size is kept, step by step. The host then undoes the step, enlarges the pool and repeats it.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


UNCOUNTABLE = wp.constant(2**31 - 1)
"""Stands for all totals that 32 bits cannot hold."""


@wp.kernel
def note_wanted(which: int, start: wp.array[int], turn: wp.array[int], wanted: wp.array2d[int]):
    """Keep the largest number of entries wanted in this step; `start` holds the exclusive sums of counts >= 0.

    Sums that do not fit into 32 bits wrap, and the first of them is negative: two numbers < 2^31 make one < 2^32.
    """
    i = wp.tid()
    if start[i] < 0:
        wp.atomic_max(wanted, turn[0], which, UNCOUNTABLE)
    elif i == start.shape[0] - 1:
        wp.atomic_max(wanted, turn[0], which, start[i])


@wp.kernel
def close_turn(wanted: wp.array2d[int], turn: wp.array[int]):
    """Go on to the next step's row; steps beyond the last one share it."""
    turn[0] = wp.min(turn[0] + 1, wanted.shape[0] - 1)


@wp.kernel
def empty_if_over(which: int, capacity: int, turn: wp.array[int], wanted: wp.array2d[int], start: wp.array[int]):
    """Empty a list that does not fit into its pool."""
    if wanted[turn[0], which] > capacity:
        start[wp.tid()] = 0
