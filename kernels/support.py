"""Fifth stage: the contact graph. Who rests on whom, in levels with cycles collapsed, and which bodies form islands.

Body p rests on j if p, moved alone by its own acceleration, presses into j where they touch; without acceleration its
velocity decides. The 2003 method (section 8.1) adds p's velocity to the test; next to it the acceleration of one
step is small, and who carries whom would change with every tremor. No direction is singled out as "up", so this holds
in any force field. A body's level is one more than the highest level that it rests on; bodies that rest on each
other in a cycle are collapsed into one and share a level (Tarjan 1972); statics are level 0.

Here one thread does a whole environment, in plain serial algorithms of linear cost.
"""

import warp as wp

from warp_rigid.kernels.data import MOTION_DYNAMIC, Bodies, Contacts, Graph, Motions, Pairs, State

wp.set_module_options({"enable_backward": False})

DYNAMIC = wp.constant(MOTION_DYNAMIC)
A_ON_B = wp.constant(1)
B_ON_A = wp.constant(2)

SLANT = wp.constant(0.05)
"""A body rests on another if at least this part of its acceleration is along the normal: upright walls do not carry."""


@wp.func
def presses(upper: int, lower: int, arm: wp.vec3, other_arm: wp.vec3, n: wp.vec3, state: State, motions: Motions):
    """Whether `upper`, moved alone by its own acceleration, presses against n into `lower`."""
    pull = motions.acceleration[upper]
    if wp.length_sq(pull) > 0.0:
        return wp.dot(pull, n) < -SLANT * wp.length(pull)
    v = state.linear_velocity[upper] + wp.cross(state.angular_velocity[upper], arm)
    w = state.linear_velocity[lower] + wp.cross(state.angular_velocity[lower], other_arm)
    return wp.dot(v - w, n) < 0.0


@wp.kernel
def find_support(bodies: Bodies, state: State, motions: Motions, pairs: Pairs, contacts: Contacts, graph: Graph):
    """One thread a pair: which of its bodies rests on the other."""
    pair = wp.tid()
    rests = int(0)
    for c in range(pairs.contact_start[pair], pairs.contact_start[pair + 1]):
        a = contacts.body_a[c]
        b = contacts.body_b[c]
        n = contacts.normal[c]
        ra = contacts.arm_a[c]
        rb = contacts.arm_b[c]
        if bodies.motion[a] == DYNAMIC and presses(a, b, ra, rb, n, state, motions):
            rests = rests | A_ON_B
        if bodies.motion[b] == DYNAMIC and presses(b, a, rb, ra, -n, state, motions):
            rests = rests | B_ON_A
    graph.rests[pair] = rests


@wp.func
def touches(pair: int, pairs: Pairs):
    """Whether a pair has contacts."""
    return pairs.contact_start[pair + 1] > pairs.contact_start[pair]


@wp.kernel
def list_incident_pairs(bodies_per_env: int, pairs: Pairs, graph: Graph):
    """One thread an environment: the touching pairs of each body, in the order of the pairs."""
    env = wp.tid()
    first = env * bodies_per_env
    row = first + env
    begin = pairs.start[first]
    end = pairs.start[first + bodies_per_env]
    for k in range(bodies_per_env + 1):
        graph.incident_start[row + k] = 0
    for pair in range(begin, end):
        if touches(pair, pairs):
            ka = row + pairs.body_a[pair] - first
            kb = row + pairs.body_b[pair] - first
            graph.incident_start[ka] = graph.incident_start[ka] + 1
            graph.incident_start[kb] = graph.incident_start[kb] + 1
    at = 2 * begin
    for k in range(bodies_per_env + 1):
        at += graph.incident_start[row + k]
        graph.incident_start[row + k] = at
    for back in range(end - begin):
        pair = end - 1 - back
        if touches(pair, pairs):
            ka = row + pairs.body_a[pair] - first
            kb = row + pairs.body_b[pair] - first
            graph.incident_start[ka] = graph.incident_start[ka] - 1
            graph.incident_pair[graph.incident_start[ka]] = pair
            graph.incident_start[kb] = graph.incident_start[kb] - 1
            graph.incident_pair[graph.incident_start[kb]] = pair


@wp.func
def supporter(body: int, pair: int, pairs: Pairs, graph: Graph):
    """The body on which `body` rests through this pair, or -1."""
    rests = graph.rests[pair]
    if pairs.body_a[pair] == body and (rests & A_ON_B) != 0:
        return pairs.body_b[pair]
    if pairs.body_b[pair] == body and (rests & B_ON_A) != 0:
        return pairs.body_a[pair]
    return -1


@wp.func
def close_component(
    root: int, first: int, open_count: int, bodies_per_env: int, bodies: Bodies, pairs: Pairs, graph: Graph
):
    """Take the root's component off the stack and give it its level: all that it rests on has one already."""
    row = root / bodies_per_env
    bottom = open_count - 1
    while graph.stack[first + bottom] != root:
        bottom -= 1
    for k in range(bottom, open_count):
        graph.component[graph.stack[first + k]] = root
    level = int(1)
    for k in range(bottom, open_count):
        body = graph.stack[first + k]
        for i in range(graph.incident_start[body + row], graph.incident_start[body + row + 1]):
            below = supporter(body, graph.incident_pair[i], pairs, graph)
            if below >= 0 and graph.component[below] != root:
                level = wp.max(level, graph.level[below] + 1)
    if bodies.motion[root] != DYNAMIC:
        level = 0
    for k in range(bottom, open_count):
        graph.level[graph.stack[first + k]] = level
    return bottom


@wp.kernel
def find_levels(bodies_per_env: int, bodies: Bodies, pairs: Pairs, graph: Graph):
    """One thread an environment: strongly connected components and their levels, by Tarjan without recursion."""
    env = wp.tid()
    first = env * bodies_per_env
    for b in range(first, first + bodies_per_env):
        graph.visit[b] = 0
        graph.component[b] = -1
    visited = int(0)
    open_count = int(0)
    for start in range(first, first + bodies_per_env):
        depth = int(0)
        if graph.visit[start] == 0:
            graph.path[first] = start
            depth = 1
        while depth > 0:
            body = graph.path[first + depth - 1]
            if graph.visit[body] == 0:
                visited += 1
                graph.visit[body] = visited
                graph.low[body] = visited
                graph.cursor[body] = graph.incident_start[body + env]
                graph.stack[first + open_count] = body
                open_count += 1
            descend = int(-1)
            while descend < 0 and graph.cursor[body] < graph.incident_start[body + env + 1]:
                below = supporter(body, graph.incident_pair[graph.cursor[body]], pairs, graph)
                graph.cursor[body] = graph.cursor[body] + 1
                if below >= 0:
                    if graph.visit[below] == 0:
                        descend = below
                    elif graph.component[below] < 0:
                        graph.low[body] = wp.min(graph.low[body], graph.visit[below])
            if descend >= 0:
                graph.path[first + depth] = descend
                depth += 1
            else:
                if graph.low[body] == graph.visit[body]:
                    open_count = close_component(body, first, open_count, bodies_per_env, bodies, pairs, graph)
                depth -= 1
                if depth > 0:
                    above = graph.path[first + depth - 1]
                    graph.low[above] = wp.min(graph.low[above], graph.low[body])


@wp.func
def island_root(body: int, graph: Graph):
    """The representative of a body's island; shortens the way for later calls."""
    root = int(body)
    while graph.island[root] != root:
        root = graph.island[root]
    walk = int(body)
    while graph.island[walk] != root:
        up = graph.island[walk]
        graph.island[walk] = root
        walk = up
    return root


@wp.kernel
def find_islands(bodies_per_env: int, bodies: Bodies, pairs: Pairs, graph: Graph):
    """One thread an environment: bodies connected through touching dynamic bodies, named by their lowest body."""
    env = wp.tid()
    first = env * bodies_per_env
    for b in range(first, first + bodies_per_env):
        graph.island[b] = b
    for pair in range(pairs.start[first], pairs.start[first + bodies_per_env]):
        a = pairs.body_a[pair]
        b = pairs.body_b[pair]
        if touches(pair, pairs) and bodies.motion[a] == DYNAMIC and bodies.motion[b] == DYNAMIC:
            root_a = island_root(a, graph)
            root_b = island_root(b, graph)
            graph.island[wp.max(root_a, root_b)] = wp.min(root_a, root_b)
    for b in range(first, first + bodies_per_env):
        graph.island[b] = island_root(b, graph)
