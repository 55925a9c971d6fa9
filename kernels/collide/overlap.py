"""Diagnostics: penetration depth of surface samples and inner balls in other bodies. Not a stage of the step."""

import warp as wp

from warp_rigid.kernels.collide.distance import is_nearer, signed_distance
from warp_rigid.kernels.collide.samples import bring_to_touch
from warp_rigid.kernels.schema import Bodies, Pairs, Shapes, State

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.func
def inner_ball_depth(own: int, other: int, shapes: Shapes, bodies: Bodies, state: State):
    """Deepest overlap of an inner ball of one body with another that contains its centre [m], else 0.

    Deep inside, the samples of a surface tell too little: they may be near the far side of the other body.
    """
    shape = bodies.shape[own]
    deepest = float(0.0)
    for k in range(shapes.shapes[shape].ball_start, shapes.shapes[shape].ball_end):
        ball = shapes.balls[k]
        x = wp.quat_rotate(state.orientation[own], wp.vec3(ball[0], ball[1], ball[2])) + state.position[own]
        local = wp.quat_rotate_inv(state.orientation[other], x - state.position[other])
        d = signed_distance(shapes, bodies.shape[other], local, 0.0)
        if d[3] < 0.0 and ball[3] > 0.0:
            deepest = wp.max(deepest, ball[3] - d[3])
    return deepest


@wp.func
def deepest_sample(own: int, other: int, shapes: Shapes, bodies: Bodies, state: State):
    """Depth of the deepest sample of one body inside another [m], at least 0."""
    shape = bodies.shape[other]
    back = wp.quat_inverse(state.orientation[other])
    turn = back * state.orientation[own]
    shift = wp.quat_rotate(back, state.position[own] - state.position[other])
    deepest = float(0.0)
    own_shape = bodies.shape[own]
    for cluster in range(shapes.shapes[own_shape].cluster_start, shapes.shapes[own_shape].cluster_end):
        c = wp.quat_rotate(turn, shapes.clusters[cluster].center) + shift
        if is_nearer(shapes, shape, c, shapes.clusters[cluster].radius - deepest):
            for s in range(shapes.clusters[cluster].sample_start, shapes.clusters[cluster].sample_end):
                found = bring_to_touch(shapes, s, own_shape, shape, turn, shift, 0.0, 0.0)
                deepest = wp.max(deepest, -found.distance)
    return deepest


@wp.kernel
def deepest_overlap(shapes: Shapes, bodies: Bodies, state: State, pairs: Pairs, deepest: wp.array2d[float]):
    """One thread per pair: the environment's deepest overlap [m], (envs, 1).

    `deepest` has two dimensions because Warp compiles a kernel with 1D array arguments twice for the CPU, the second
    time for contiguous arrays.
    """
    pair = wp.tid()
    if pair >= pairs.start[pairs.start.shape[0] - 1]:
        return
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    depth = float(0.0)
    side = int(0)
    while side < 2:
        own = wp.where(side == 0, a, b)
        other = a + b - own
        depth = wp.max(depth, deepest_sample(own, other, shapes, bodies, state))
        depth = wp.max(depth, inner_ball_depth(own, other, shapes, bodies, state))
        side += 1
    wp.atomic_max(deepest, bodies.env[a], 0, depth)
