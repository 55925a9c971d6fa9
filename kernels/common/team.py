"""Teams of GPU lanes that process one environment, or one pair of bodies, together.

The size of a team is a power of two of neighbouring lanes: a part of a warp, a whole block, or a cluster of blocks,
which the GPU starts together and which has a barrier in hardware. No other blocks wait for each other. On the CPU a
team has one lane, and loops over the team become plain loops.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

BLOCK = 256
"""Lanes of a CUDA block for teams larger than a warp."""

BLOCKS_OF_A_CLUSTER = 8
"""Blocks of a team that is a cluster: as many as every GPU with clusters can start together."""

CLUSTER = BLOCK * BLOCKS_OF_A_CLUSTER
"""Lanes of a team that is a cluster."""

SMALL_BLOCK = 64
"""Lanes of a CUDA block for teams within a warp; small, so that few environments are spread over the whole GPU."""

MOST_REGISTERS = 128
"""Registers of a lane, at most, in the solver and the contact search, which would use up to 255: 16 warps are then
resident on a multiprocessor, and hide each other's waiting. Piles are 4 to 11 % faster; 96 registers gain nothing."""


def block_of(lanes: int) -> int:
    """Lanes of a CUDA block for teams with the given number of lanes."""
    return SMALL_BLOCK if lanes <= 32 else BLOCK


MECHANISM_LANES = 8
"""Largest number of lanes of a team that solves a mechanism: a block of it has six rows."""


CLUSTER_BARRIER = """
#if __CUDA_ARCH__ >= 900
    asm volatile("barrier.cluster.arrive.release;" ::: "memory");
    asm volatile("barrier.cluster.wait.acquire;" ::: "memory");
#endif
"""
"""Barrier for the blocks of a cluster, in CUDA."""

READ_OTHER_BLOCK = """
#if __CUDA_ARCH__ >= 900
    unsigned place;
    int value;
    asm volatile("mapa.shared::cluster.u32 %0, %1, %2;"
        : "=r"(place) : "r"((unsigned)__cvta_generic_to_shared(&of_block)), "r"(threadIdx.x));
    asm volatile("ld.shared::cluster.s32 %0, [%1];" : "=r"(value) : "r"(place) : "memory");
    found |= value;
#endif
"""
"""Combine the flag `found` with that of another block of the cluster, each lane with one."""


@wp.struct
class Team:
    """A lane's index in the team that processes an environment, or a mechanism."""

    env: int
    lane: int
    lanes: int


@wp.func
def team_of(thread: int, lanes: int):
    """The team of a thread: `lanes` neighbouring threads for each environment."""
    team = Team()
    team.env = thread / lanes
    team.lane = thread % lanes
    team.lanes = lanes
    return team


@wp.func
def part_of_team(team: Team):
    """The part of a team to which a lane belongs, which solves a mechanism."""
    part = Team()
    part.env = team.env
    part.lanes = wp.min(team.lanes, MECHANISM_LANES)
    part.lane = team.lane % part.lanes
    return part


@wp.func
def single_lane():
    """A lane that works alone."""
    return Team(0, 0, 1)


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    if (lanes <= 32) {{
        __syncwarp(lanes == 32 ? 0xffffffffu : ((1u << lanes) - 1u) << (threadIdx.x & 31u & ~(lanes - 1u)));
    }} else if (lanes <= {BLOCK}) {{
        __syncthreads();
    }} else {{
        {CLUSTER_BARRIER}
    }}
#endif
""")
def _sync_team(lanes: int):
    """Wait for all lanes of a team; earlier writes are visible to all of them afterwards."""
    ...


@wp.func
def sync_team(team: Team):
    """Barrier for all lanes of a team; earlier writes are visible to all of them afterwards."""
    _sync_team(team.lanes)


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    if (lanes <= 32) {{
        unsigned mask = lanes == 32 ? 0xffffffffu : ((1u << lanes) - 1u) << (threadIdx.x & 31u & ~(lanes - 1u));
        __syncwarp(mask);
        return __any_sync(mask, flag) ? 1 : 0;
    }}
    int found = __syncthreads_or(flag);
    if (lanes > {BLOCK}) {{
        __shared__ int of_block;
        if (threadIdx.x == 0) {{ of_block = found; }}
        {CLUSTER_BARRIER}
        if (threadIdx.x < {BLOCKS_OF_A_CLUSTER}) {{ {READ_OTHER_BLOCK} }}
        found = __syncthreads_or(found);
        // No block may overwrite its flag before the others have read it.
        {CLUSTER_BARRIER}
    }}
    return found;
#else
    return flag;
#endif
""")
def _any_of_team(flag: int, lanes: int) -> int:
    """Whether the flag is set for any lane of a team."""
    ...


@wp.func
def any_of_team(flag: int, team: Team):
    """Whether the flag of any lane of the team is not zero; also a barrier for the team."""
    return _any_of_team(flag, team.lanes)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned active = __activemask();
    unsigned leader = __ffs(active) - 1;
    if (__all_sync(active, index == __shfl_sync(active, index, leader))) {
        int sum = __reduce_add_sync(active, value);
        if ((threadIdx.x & 31u) == leader && sum != 0) { atomicAdd(counts.data + index, sum); }
    } else if (value != 0) {
        atomicAdd(counts.data + index, value);
    }
#else
    __atomic_fetch_add(counts.data + index, value, __ATOMIC_RELAXED);
#endif
""")
def add_together(counts: wp.array[int], index: int, value: int):
    """Atomic addition; the lanes of a warp that add to the same element do so at once."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned active = __activemask();
    unsigned lane = threadIdx.x & 31u, leader = __ffs(active) - 1;
    int first = 0;
    if (lane == leader) { first = atomicAdd(counts.data + index, __popc(active)); }
    return __shfl_sync(active, first, leader) + __popc(active & ((1u << lane) - 1u));
#else
    return __atomic_fetch_add(counts.data + index, 1, __ATOMIC_RELAXED);
#endif
""")
def next_place(counts: wp.array[int], index: int) -> int:
    """Atomically increment a count, one for each lane, and return the lane's value before; the order is arbitrary."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned active = __activemask();
    unsigned lane = threadIdx.x & 31u, leader = __ffs(active) - 1;
    int before = 0, sum = 0, first = 0;
    for (int bit = 0; __any_sync(active, value >> bit); ++bit) {
        unsigned ones = __ballot_sync(active, (value >> bit) & 1);
        before += __popc(ones & ((1u << lane) - 1u)) << bit;
        sum += __popc(ones) << bit;
    }
    if (lane == leader) { first = atomicAdd(counts.data + index, sum); }
    return __shfl_sync(active, first, leader) + before;
#else
    return __atomic_fetch_add(counts.data + index, value, __ATOMIC_RELAXED);
#endif
""")
def take_together(counts: wp.array[int], index: int, value: int) -> int:
    """As `take_places`, for values >= 0; the lanes of a warp add at once. Slow if the lanes diverge."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return atomicAdd(counts.data + index, value);
#else
    return __atomic_fetch_add(counts.data + index, value, __ATOMIC_RELAXED);
#endif
""")
def take_places(counts: wp.array[int], index: int, value: int) -> int:
    """Atomic addition, each lane for itself. Returns the count before."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    if (value > values.data[index]) { wp::atomic_max(values.data + index, value); }
#else
    float before;
    __atomic_load(values.data + index, &before, __ATOMIC_RELAXED);
    while (value > before && !__atomic_compare_exchange(
        values.data + index, &before, &value, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {}
#endif
""")
def raise_to(index: int, value: float, values: wp.array[float]):
    """Atomic maximum that does not write if the element is large enough already."""
    ...


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


@wp.func
def any_of_warp(flag: int, lanes: int):
    """Whether the flag of any lane of a team within a warp is not zero; also a barrier, as `sync_warp`."""
    sync_warp(lanes)
    return wp.where(ballot(flag, lanes) != wp.uint32(0), 1, 0)


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


@wp.func
def broadcast_vector(value: wp.vec3, lane: int, lanes: int):
    """The vector of one lane, broadcast to the whole team. Only for teams within a warp."""
    return wp.vec3(broadcast(value[0], lane, lanes), broadcast(value[1], lane, lanes), broadcast(value[2], lane, lanes))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned mask = lanes == 32 ? 0xffffffffu : ((1u << lanes) - 1u) << (threadIdx.x & 31u & ~(lanes - 1u));
    return __shfl_xor_sync(mask, value, offset, lanes);
#else
    return value;
#endif
""")
def exchanged(value: float, offset: int, lanes: int) -> float:
    """The value of the lane whose number differs by the bit `offset`. Only for teams within a warp."""
    ...


@wp.func
def exchanged_vector(value: wp.vec3, offset: int, lanes: int):
    """The vector of the lane whose number differs by the bit `offset`. Only for teams within a warp."""
    return wp.vec3(
        exchanged(value[0], offset, lanes), exchanged(value[1], offset, lanes), exchanged(value[2], offset, lanes)
    )


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned mask = lanes == 32 ? 0xffffffffu : ((1u << lanes) - 1u) << (threadIdx.x & 31u & ~(lanes - 1u));
    return __shfl_sync(mask, value, lane, lanes);
#else
    return value;
#endif
""")
def broadcast_integer(value: int, lane: int, lanes: int) -> int:
    """The integer of one lane, broadcast to the whole team. Only for teams within a warp."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned mask = lanes == 32 ? 0xffffffffu : ((1u << lanes) - 1u) << (threadIdx.x & 31u & ~(lanes - 1u));
    for (int offset = lanes / 2; offset > 0; offset /= 2) {
        value = fmaxf(value, __shfl_xor_sync(mask, value, offset, lanes));
    }
#endif
    return value;
""")
def max_of_lanes(value: float, lanes: int) -> float:
    """The maximum over a team. Only for teams within a warp."""
    ...


@wp.func
def min_of_lanes(value: float, lanes: int):
    """The minimum over a team. Only for teams within a warp."""
    return -max_of_lanes(-value, lanes)
