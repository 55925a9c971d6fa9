"""Teams of GPU lanes that work on one environment, or on one pair of bodies, together.

A team is a power of two of neighbouring lanes: a part of a warp, or a whole block. On the CPU a team has one lane, and
what is written for a team is a plain loop there.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

BLOCK = 256
"""Lanes of a CUDA block; a team is at most that, and more than a warp only if it is exactly that."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    if (lanes > 32) { __syncthreads(); }
    else { __syncwarp(lanes == 32 ? 0xffffffffu : ((1u << lanes) - 1u) << (threadIdx.x & 31u & ~(lanes - 1u))); }
#endif
""")
def meet(lanes: int):
    """Let all lanes of a team arrive, and see what the others wrote, before any goes on."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    if (lanes > 32) { return __syncthreads_or(flag); }
    unsigned mask = lanes == 32 ? 0xffffffffu : ((1u << lanes) - 1u) << (threadIdx.x & 31u & ~(lanes - 1u));
    __syncwarp(mask);
    return __any_sync(mask, flag) ? 1 : 0;
#else
    return flag;
#endif
""")
def any_of_team(flag: int, lanes: int) -> int:
    """Whether the flag of any lane of the team is not zero; all lanes meet."""
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
def votes(flag: int, lanes: int) -> wp.uint32:
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
    """Place of the lowest bit that is set; bits is not zero."""
    ...


@wp.func
def bits_below(bits: wp.uint32, place: int):
    """How many bits are set below a place."""
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
def of_lane(value: float, lane: int, lanes: int) -> float:
    """A lane's value, told to the whole team. Teams within a warp only."""
    ...
