"""Keeping count of what the pools were asked to hold.

A pool that is too small makes the whole step void: its list is emptied, so that nothing is read or written out of
bounds, and the wanted size is kept. The host then undoes the step, enlarges the pool and repeats it.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def note_wanted(which: int, capacity: int, start: wp.array[int], wanted: wp.array[int], over: wp.array[int]):
    """Keep the largest number of entries wanted so far, and whether this time they exceed the capacity."""
    total = start[start.shape[0] - 1]
    wanted[which] = wp.max(wanted[which], total)
    over[which] = wp.where(total > capacity, 1, 0)


@wp.kernel
def empty_if_over(which: int, over: wp.array[int], start: wp.array[int]):
    """Empty a list that does not fit into its pool."""
    if over[which] == 1:
        start[wp.tid()] = 0
