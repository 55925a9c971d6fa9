"""State of the search for the contact point of a sample, and the steps that all of its stages share."""

import warp as wp

from warp_rigid.kernels.collide.distance import FAR

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

FLAT = wp.constant(0.01)
"""Slope of the distance along an edge below which the edge lies flat."""

CURVED = wp.constant(1.0e-3)
"""A distance that lies above its tangents by more than this fraction of the interval counts as curved, not kinked."""

DONE = wp.constant(-1)


@wp.struct
class Search:
    """State of the search of a sample. The distance is evaluated next at `query`, with the sample normal `facing`.

    `evaluations`: number of distances so far, for measurements. `least`: the least of them, at most 0.
    """

    stage: int
    evaluations: int
    least: float
    query: wp.vec3
    facing: wp.vec3
    normal: wp.vec3
    direction: wp.vec3
    distance: float
    start: wp.vec3
    along: wp.vec3
    half: float
    first: float
    last: float
    crossing: int
    t: float
    left: float
    right: float
    low: wp.vec4
    high: wp.vec4
    slope_low: float
    slope_high: float
    turning: float
    before: wp.vec4
    way: wp.vec3


@wp.func
def slope(d: wp.vec4, along: wp.vec3):
    """Slope of a distance along a direction."""
    return d[0] * along[0] + d[1] * along[1] + d[2] * along[2]


@wp.func
def gradient(d: wp.vec4):
    """The direction of a distance, its gradient."""
    return wp.vec3(d[0], d[1], d[2])


@wp.func
def nowhere(search: Search):
    """End the search without a contact point."""
    search.stage = DONE
    search.distance = FAR
    return search


@wp.func
def look_at(search: Search, t: float):
    """Evaluate the distance next at parameter t of the edge."""
    search.t = t
    search.query = search.start + t * search.along
    return search


@wp.func
def next_inside(search: Search, curved: bool):
    """Evaluate next where the tangents at both ends meet or, for a curved distance, where the slope becomes zero."""
    bend = wp.max(search.slope_high - search.slope_low, 1.0e-6)
    rise = search.slope_high * search.right - search.slope_low * search.left
    t = (search.low[3] - search.high[3] + rise) / bend
    if curved:
        t = search.left - search.slope_low * (search.right - search.left) / bend
    return look_at(search, wp.clamp(t, search.left, search.right))
