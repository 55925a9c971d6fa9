"""How rounds are shared (sharing.py): on a GPU a launch is one round, on a CPU it is all rounds of a stage.

A round takes less time than it takes to wake a thread, so the workers of a CPU stay in one launch until the last round
is finished. They claim the chunks of all rounds in order, those of a round when all chunks of the round before are
finished. The records of the rounds decide, alike for every worker, whether another one follows.
"""

import warp as wp

from warp_rigid.kernels.common.sharing import PATIENCE, Sharing, announce, on_gpu, pause, raise_from, seen
from warp_rigid.kernels.graph.heap_arrays import Rounds

wp.set_module_options({"enable_backward": False})

ROUNDS_OF_A_GROUP = 6
"""Rounds between two decisions on whether more follow."""


@wp.struct
class Share:
    """Pairs that a thread solves in a round, from `first` to `end` - 1 with a stride; `round` is 0 if there is none."""

    round: int
    first: int
    end: int
    stride: int


@wp.func
def chunk_size(sharing: Sharing, rounds: Rounds):
    """Number of pairs of a chunk."""
    # Claiming a chunk takes as long as solving about one pair.
    return wp.max((rounds.count[0] + sharing.count - 1) / sharing.count, 32)


@wp.func
def are_over(round: int, rounds: Rounds):
    """Whether the rounds end before this one, which all earlier ones precede. It is decided once in a group."""
    return round > 1 and (round - 1) % ROUNDS_OF_A_GROUP == 0 and seen(rounds.latest, 0) < round - 1


@wp.func
def next_ticket(chunks: int, sharing: Sharing, rounds: Rounds):
    """Claim the next chunk of all rounds: (round - 1) * chunks + chunk. Returns -1 if there is none."""
    attempt = int(0)
    while attempt < PATIENCE and seen(rounds.again, 0) == 1:
        ticket = seen(sharing.tickets.claimed, sharing.launch)
        before = ticket / chunks
        if seen(sharing.tickets.finished, sharing.launch) < before * chunks:
            attempt += 1
            pause()
        elif are_over(before + 1, rounds):
            rounds.again[0] = 0
        elif raise_from(sharing.tickets.claimed, sharing.launch, ticket):
            return ticket
    return -1


@wp.func
def claimed_share(sharing: Sharing, rounds: Rounds):
    """The next chunk that a worker of a CPU has claimed."""
    share = Share()
    size = chunk_size(sharing, rounds)
    chunks = (rounds.count[0] + size - 1) / size
    ticket = next_ticket(chunks, sharing, rounds)
    if ticket >= 0:
        share.round = ticket / chunks + 1
        share.first = ticket % chunks * size
        share.end = wp.min(share.first + size, rounds.count[0])
        share.stride = 1
    return share


@wp.func
def first_share(index: int, place: int, sharing: Sharing, rounds: Rounds):
    """The share of a GPU's team in the round at `place` of its group, or the first share of a CPU's worker."""
    if on_gpu() == 1:
        return Share(rounds.done[0] + place, index, rounds.count[0], sharing.count)
    return claimed_share(sharing, rounds)


@wp.func
def next_share(sharing: Sharing, rounds: Rounds):
    """Finish a share. Returns the next one of a CPU's worker; a GPU's team has none."""
    if on_gpu() == 1:
        return Share()
    announce(sharing.tickets.finished, sharing.launch)
    return claimed_share(sharing, rounds)
