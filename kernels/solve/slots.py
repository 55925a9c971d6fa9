"""Slots: the velocity changes of bodies by each of their pairs (heap_arrays.py), in two buffers.

A round reads the slots that the last one wrote, and writes those of the other buffer.
"""

import warp as wp

from warp_rigid.kernels.common.solver_body import first_three
from warp_rigid.kernels.declare import group_writer
from warp_rigid.kernels.graph.heap_arrays import ChangeRecord, RoundRecord, Rounds, Slots

wp.set_module_options({"enable_backward": False})

write_change = group_writer(ChangeRecord)


@wp.func_native("""
    float x = 0.0f, y = 0.0f, z = 0.0f, w = 0.0f;
    #pragma unroll 4
    for (int s = first; s < end; ++s) {
        const float* p = (const float*)__builtin_assume_aligned((const float*)(changes.data + s) + 4 * group, 16);
        x += p[0]; y += p[1]; z += p[2]; w += p[3];
    }
    return wp::vec4(x, y, z, w);
""")
def sum_of_changes(first: int, end: int, group: int, changes: wp.array[ChangeRecord]) -> wp.vec4:
    """The sum of four words of consecutive slots, in their order."""
    ...


@wp.func
def buffer_start(buffer: int, slots: Slots):
    """Index of the first slot of a buffer, 0 or 1."""
    return buffer * (slots.changes.shape[0] / 2)


@wp.func
def change_of(first: int, end: int, group: int, buffer: int, slots: Slots):
    """Velocity change of a body, the sum over its slots; group 0: linear, 1: angular."""
    start = buffer_start(buffer, slots)
    return first_three(sum_of_changes(start + first, start + end, group, slots.changes))


@wp.func
def store_change(slot: int, group: int, buffer: int, change: wp.vec3, stirring: float, slots: Slots):
    """Store a velocity change in a slot, and whether it differs noticeably; a body that is not dynamic has no slot."""
    if slot >= 0:
        write_change(slots.changes, buffer_start(buffer, slots) + slot, group, change, stirring)


@wp.func
def clear_slots(entry: RoundRecord, slots: Slots):
    """Clear the slots of a pair, which does not take part or starts from zero."""
    for part in range(4):
        store_change(entry.slot_a, part % 2, part / 2, wp.vec3(), 0.0, slots)
        store_change(entry.slot_b, part % 2, part / 2, wp.vec3(), 0.0, slots)


@wp.func
def keep_changes(k: int, entry: RoundRecord, round: int, lane: int, lanes: int, rounds: Rounds, slots: Slots):
    """A pair that is not solved in a round: copy its velocity changes to the buffer of the round, if it has others."""
    if rounds.visited[k] == round - 1:
        for part in range(lane, 4, lanes):
            slot = wp.where(part < 2, entry.slot_a, entry.slot_b)
            if slot >= 0:
                change = change_of(slot, slot + 1, part % 2, (round - 1) % 2, slots)
                store_change(slot, part % 2, round % 2, change, 0.0, slots)
