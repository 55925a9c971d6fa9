"""Pairs of inner balls: deep overlaps of bodies of several arms.

Where two arms cross, samples near the crossing find a face of the other arm that they do not oppose, or none, and
neither arm need contain the largest ball of its shape. Each shape therefore has several inner balls
(scene/shapes/inner_balls.py). Two balls that overlap prove that the bodies do, and the line of their centres is a
direction in which they come apart. It points across both arms. The normal of the nearest face of the other body may
point along one of them.
"""

import warp as wp

from warp_rigid.kernels.collide.approach import touch_of
from warp_rigid.kernels.collide.culling import out_of_box
from warp_rigid.kernels.collide.distance import FAR, direction_or_up
from warp_rigid.kernels.collide.samples import Search
from warp_rigid.kernels.common.team import min_of_lanes
from warp_rigid.kernels.schema import Bodies, Shapes, State

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

BY_BALLS = wp.constant(-5)
"""Identity of the contact of the first inner balls of both bodies; those of other balls are less."""

MOST_BALLS = wp.constant(32)
"""Maximum number of inner balls of a shape."""

LAST_BALLS = wp.constant(-4 - MOST_BALLS * MOST_BALLS)
"""Identity of the contact of the last inner balls that two shapes can have."""

DEEP = wp.constant(0.5)
"""Overlap of two balls from which it counts as deep, as a fraction of the smaller radius."""


@wp.func
def ball_of(k: int, shape: int, shapes: Shapes):
    """An inner ball of a shape."""
    return shapes.balls[wp.min(shapes.shapes[shape].ball_start + k, shapes.shapes[shape].ball_end - 1)]


@wp.func
def place_ball(k: int, own: int, other: int, shapes: Shapes, bodies: Bodies, state: State):
    """An inner ball of one body in the frame of another."""
    ball = ball_of(k, bodies.shape[own], shapes)
    x = wp.quat_rotate(state.orientation[own], wp.vec3(ball[0], ball[1], ball[2])) + state.position[own]
    p = wp.quat_rotate_inv(state.orientation[other], x - state.position[other])
    return wp.vec4(p[0], p[1], p[2], ball[3])


@wp.func
def touch_balls(key: int, a: int, b: int, shapes: Shapes, bodies: Bodies, state: State):
    """The contact of two inner balls."""
    index = BY_BALLS - key
    first = place_ball(index / MOST_BALLS, a, b, shapes, bodies, state)
    second = ball_of(index % MOST_BALLS, bodies.shape[b], shapes)
    away = wp.vec3(first[0] - second[0], first[1] - second[1], first[2] - second[2])
    placed = Search()
    placed.direction = direction_or_up(away)
    placed.distance = wp.length(away) - first[3] - second[3]
    placed.query = wp.vec3(first[0], first[1], first[2]) - first[3] * placed.direction
    return touch_of(placed, 0, b, state)


@wp.func
def deepest_balls(a: int, b: int, deepest: float, lane: int, lanes: int, shapes: Shapes, bodies: Bodies, state: State):
    """Identity of the contact of the inner balls that overlap most, 0 if none deeply and by more than `-deepest` [m].

    The lanes share the balls of the first body.
    """
    shape = bodies.shape[b]
    gap = float(deepest)
    key = int(0)
    for i in range(lane, shapes.shapes[bodies.shape[a]].ball_end - shapes.shapes[bodies.shape[a]].ball_start, lanes):
        ball = place_ball(i, a, b, shapes, bodies, state)
        x = wp.vec3(ball[0], ball[1], ball[2])
        if not out_of_box(x, ball[3], shape, shapes):
            for j in range(shapes.shapes[shape].ball_end - shapes.shapes[shape].ball_start):
                other = ball_of(j, shape, shapes)
                way = wp.length(x - wp.vec3(other[0], other[1], other[2]))
                found = way - ball[3] - other[3]
                smaller = wp.min(ball[3], other[3])
                if found < gap and found < -DEEP * smaller and smaller > 0.0:
                    gap = found
                    key = BY_BALLS - (MOST_BALLS * i + j)
    # Of equal gaps the highest identity counts, whichever lane found it.
    lowest = min_of_lanes(gap, lanes)
    return -int(min_of_lanes(wp.where(gap == lowest, float(-key), FAR), lanes))
