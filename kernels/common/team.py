"""Teams of GPU lanes that process one environment, or one pair of bodies, together.

The size of a team is a power of two of neighbouring lanes: a part of a warp, a whole block, or several blocks. Several
blocks synchronize at a barrier in global memory. This requires that all of them are resident at the same time, so there
are no more of them than multiprocessors. On the CPU a team has one lane, and loops over the team become plain loops.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

BLOCK = 256
"""Lanes of a CUDA block for teams larger than a warp; such a team has one or more blocks."""

MOST_OF_A_BLOCK = wp.constant(BLOCK)

SMALL_BLOCK = 64
"""Lanes of a CUDA block for teams within a warp; small, so that few environments are spread over the whole GPU."""


def block_of(lanes: int) -> int:
    """Lanes of a CUDA block for teams with the given number of lanes."""
    return SMALL_BLOCK if lanes <= 32 else BLOCK


@wp.struct
class Team:
    """A lane's index in the team that processes an environment."""

    env: int
    lane: int
    lanes: int
    gate: wp.array2d[wp.uint32]


@wp.func
def team_of(thread: int, lanes: int, gate: wp.array2d[wp.uint32]):
    """The team of a thread: `lanes` neighbouring threads for each environment.

    In a team of several blocks, lane indices are assigned to the warps of the blocks round-robin, so that small
    workloads are spread over all blocks.
    """
    team = Team()
    team.env = thread / lanes
    team.lane = thread % lanes
    if lanes > MOST_OF_A_BLOCK:
        block = team.lane / MOST_OF_A_BLOCK
        within = team.lane % MOST_OF_A_BLOCK
        team.lane = ((within / 32) * (lanes / MOST_OF_A_BLOCK) + block) * 32 + within % 32
    team.lanes = lanes
    team.gate = gate
    return team


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    if (lanes <= 32) {
        __syncwarp(lanes == 32 ? 0xffffffffu : ((1u << lanes) - 1u) << (threadIdx.x & 31u & ~(lanes - 1u)));
    } else if (lanes == blockDim.x) {
        __syncthreads();
    } else {
        volatile unsigned* opened = gate.data + 4 * env + 1;
        unsigned before = threadIdx.x == 0 ? *opened : 0u;
        __syncthreads();
        if (threadIdx.x == 0) {
            __threadfence();
            if (atomicAdd(gate.data + 4 * env, 1u) + 1u == lanes / blockDim.x) {
                gate.data[4 * env] = 0u;
                __threadfence();
                *opened = before + 2u;
            } else {
                while (*opened == before) { }
            }
            __threadfence();
        }
        __syncthreads();
    }
#endif
""")
def _sync_team(env: int, lanes: int, gate: wp.array2d[wp.uint32]):
    """Wait for all lanes of a team; earlier writes are visible to all of them afterwards."""
    ...


@wp.func
def sync_team(team: Team):
    """Barrier for all lanes of a team; earlier writes are visible to all of them afterwards."""
    _sync_team(team.env, team.lanes, team.gate)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    if (lanes <= 32) {
        unsigned mask = lanes == 32 ? 0xffffffffu : ((1u << lanes) - 1u) << (threadIdx.x & 31u & ~(lanes - 1u));
        __syncwarp(mask);
        return __any_sync(mask, flag) ? 1 : 0;
    }
    if (lanes == blockDim.x) { return __syncthreads_or(flag); }
    volatile unsigned* opened = gate.data + 4 * env + 1;
    unsigned before = threadIdx.x == 0 ? *opened : 0u;
    int any = __syncthreads_or(flag);
    if (threadIdx.x == 0) {
        __threadfence();
        unsigned arrived = atomicAdd(gate.data + 4 * env, any ? 0x10001u : 1u) + (any ? 0x10001u : 1u);
        if ((arrived & 0xffffu) == lanes / blockDim.x) {
            gate.data[4 * env] = 0u;
            __threadfence();
            *opened = ((before + 2u) & ~1u) | (arrived > 0xffffu ? 1u : 0u);
        }
        while ((*opened ^ before) < 2u) { }
        any = *opened & 1u;
        __threadfence();
    }
    return __syncthreads_or(threadIdx.x == 0 ? any : 0);
#else
    return flag;
#endif
""")
def _any_of_team(flag: int, env: int, lanes: int, gate: wp.array2d[wp.uint32]) -> int:
    """Whether the flag is set for any lane of a team."""
    ...


@wp.func
def any_of_team(flag: int, team: Team):
    """Whether the flag of any lane of the team is not zero; also a barrier for the team."""
    return _any_of_team(flag, team.env, team.lanes, team.gate)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp(lanes == 32 ? 0xffffffffu : ((1u << lanes) - 1u) << (threadIdx.x & 31u & ~(lanes - 1u)));
#endif
""")
def sync_warp(lanes: int):
    """Barrier for all lanes of a team within a warp; earlier writes are visible to all of them afterwards."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned shift = threadIdx.x & 31u & ~(lanes - 1u);
    unsigned mask = (lanes == 32 ? 0xffffffffu : (1u << lanes) - 1u) << shift;
    return __ballot_sync(mask, flag) >> shift;
#else
    return flag != 0 ? 1u : 0u;
#endif
""")
def ballot(flag: int, lanes: int) -> wp.uint32:
    """One bit a lane: whether its flag is not zero. Teams within a warp only."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    int at = 0;
    while (((bits >> at) & 1u) == 0u) { ++at; }
    return at;
#endif
""")
def lowest_bit(bits: wp.uint32) -> int:
    """Index of the lowest set bit; `bits` is not zero."""
    ...


@wp.func
def bits_below(bits: wp.uint32, place: int):
    """Number of bits that are set below an index."""
    count = int(0)
    left = bits
    while left != wp.uint32(0) and lowest_bit(left) < place:
        left = left & (left - wp.uint32(1))
        count += 1
    return count


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned mask = lanes == 32 ? 0xffffffffu : ((1u << lanes) - 1u) << (threadIdx.x & 31u & ~(lanes - 1u));
    return __shfl_sync(mask, value, lane, lanes);
#else
    return value;
#endif
""")
def broadcast(value: float, lane: int, lanes: int) -> float:
    """The value of one lane, broadcast to the whole team. Only for teams within a warp."""
    ...
