"""Moving ground: height fields whose vertices move vertically in harmonic motion, and surfaces that run along a body.

Each environment has its own copy of such a field in the pool of shapes, so that distance queries read the current
heights. At the start of a step, `move_ground` computes the heights from the environment's step counter. The vertical
velocity of a vertex is its change of height over the step, so that bodies resting on the ground follow it exactly.
`set_surface_velocity` then assigns the surface velocity to each contact. Restitution uses the velocity of the ground in
the previous step, which equals the velocity of a resting body, so that resting bodies do not bounce. The surface of a
conveyor belt or a turntable runs in its tangent plane only, and does not change with time.
"""

import warp as wp

from warp_rigid.kernels.common.surfaces import running_spin, runs, tangential_running
from warp_rigid.kernels.constraints.contact import velocity_of_turning
from warp_rigid.kernels.enums import Role
from warp_rigid.kernels.schema import Bodies, Contacts, Environments, Motions, Pairs, Shapes, State, Surfaces

wp.set_module_options({"enable_backward": False})


@wp.func
def height_at(k: int, time: wp.float64, surfaces: Surfaces):
    """Height of vertex k at a time [m]."""
    wave = wp.sin(wp.float64(surfaces.frequency[k]) * time + wp.float64(surfaces.phase[k]))
    return wp.float64(surfaces.height[k]) + wp.float64(surfaces.amplitude[k]) * wave


@wp.kernel
def move_ground(dt: wp.float64, first: int, envs: Environments, surfaces: Surfaces, shapes: Shapes):
    """One thread per vertex: height, velocity and surface sample. `first`: the first vertex's node in the pool."""
    k = wp.tid()
    time = wp.float64(envs.step[surfaces.env[k]]) * dt
    now = height_at(k, time, surfaces)
    shapes.grid_value[first + k] = float(now)
    surfaces.rise[k] = float((height_at(k, time + dt, surfaces) - now) / dt)
    surfaces.rise_before[k] = float((now - height_at(k, time - dt, surfaces)) / dt)
    around = surfaces.around[k]
    slope_x = (
        float(height_at(k + around[1], time, surfaces) - height_at(k + around[0], time, surfaces)) * surfaces.per_x[k]
    )
    slope_y = (
        float(height_at(k + around[3], time, surfaces) - height_at(k + around[2], time, surfaces)) * surfaces.per_y[k]
    )
    sample = shapes.samples[surfaces.sample[k]]
    sample.point = wp.vec3(sample.point[0], sample.point[1], float(now))
    sample.normal = wp.normalize(wp.vec3(-slope_x, -slope_y, 1.0))
    shapes.samples[surfaces.sample[k]] = sample


@wp.kernel
def drive_ground(shapes: Shapes, bodies: Bodies, envs: Environments, motions: Motions):
    """One thread per body: moving ground counts as kinematic even if its body is at rest. Bodies on it do not sleep."""
    b = wp.tid()
    if shapes.shapes[bodies.shape[b]].rise > 0.0 and motions.role[b] == Role.STATIC:
        motions.role[b] = Role.KINEMATIC
        envs.moving[bodies.env[b]] = envs.step[bodies.env[b]] + 1


@wp.func
def ground_velocity(
    body: int, x: wp.vec3, before: int, first: int, shapes: Shapes, bodies: Bodies, state: State, surfaces: Surfaces
):
    """Velocity of moving ground at a world point, relative to its body [m/s]; zero for other bodies."""
    shape = bodies.shape[body]
    if shapes.shapes[shape].rise == 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    part = shapes.shapes[shape].part_start
    dims = shapes.parts[part].grid_dims
    size = shapes.parts[part].size
    local = wp.quat_rotate_inv(state.orientation[body], x - state.position[body])
    qx = wp.clamp((local[0] / size[0] + 0.5) * float(dims[0] - 1), 0.0, float(dims[0] - 1))
    qy = wp.clamp((local[1] / size[1] + 0.5) * float(dims[1] - 1), 0.0, float(dims[1] - 1))
    i = wp.min(int(qx), dims[0] - 2)
    j = wp.min(int(qy), dims[1] - 2)
    u = qx - float(i)
    v = qy - float(j)
    at = shapes.parts[part].grid_start - first + i * dims[1] + j
    r = surfaces.rise
    if before == 1:
        r = surfaces.rise_before
    far = r[at + dims[1] + 1]
    rise = r[at] + u * (r[at + dims[1]] - r[at]) + v * (far - r[at + dims[1]])
    if v > u:
        rise = r[at] + u * (far - r[at + 1]) + v * (r[at + 1] - r[at])
    return wp.quat_rotate(state.orientation[body], wp.vec3(0.0, 0.0, rise))


@wp.kernel
def set_surface_velocity(
    before: int,
    first: int,
    dt: float,
    shapes: Shapes,
    bodies: Bodies,
    state: State,
    envs: Environments,
    motions: Motions,
    surfaces: Surfaces,
    pairs: Pairs,
    contacts: Contacts,
):
    """One thread per contact: velocity of moving ground, with `before` that of the last step, and of running surfaces.

    It is added to that of a turning carrier. Without `before`, only contacts with moving ground change.
    """
    c = wp.tid()
    if c >= pairs.contact_start[pairs.contact_start.shape[0] - 1]:
        return
    a = pairs.body_a[contacts.pair[c]]
    b = pairs.body_b[contacts.pair[c]]
    rises = shapes.shapes[bodies.shape[a]].rise + shapes.shapes[bodies.shape[b]].rise > 0.0
    # Belts do not change in a step: as bodies may have turned in an impact, a second call would count only in batches
    # in which some ground moves.
    if not (rises or (before == 1 and (runs(a, bodies) or runs(b, bodies)))):
        return
    x = contacts.position[c]
    earlier = before * envs.collision_first[bodies.env[a]]
    v = ground_velocity(a, x, earlier, first, shapes, bodies, state, surfaces)
    v -= ground_velocity(b, x, earlier, first, shapes, bodies, state, surfaces)
    v += tangential_running(a, b, x, contacts.rows[c].normal, dt, bodies, state, motions)
    row = contacts.rows[c]
    count = pairs.contact_start[contacts.pair[c] + 1] - pairs.contact_start[contacts.pair[c]]
    contacts.rows[c].surface = v + velocity_of_turning(row, count, a, b, dt, shapes, bodies, state, motions)
    spin = wp.dot(running_spin(a, bodies, state) - running_spin(b, bodies, state), contacts.rows[c].normal)
    contacts.rows[c].surface_spin = spin
    if wp.length_sq(v) + wp.abs(spin) > 0.0:
        contacts.rows[c].more = 1.0
