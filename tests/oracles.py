"""Independent float64 answers to what the stages compute, and the way to the stages of a simulator."""

from unittest import mock

import numpy as np
from scipy.spatial import ConvexHull

from warp_rigid import rotations
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Motion
from warp_rigid.scene.shapes import Box, Plane, Sphere
from warp_rigid.scenes.builders import grounds, stacks
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.builders.grounds import level_scene as ground_scene

GROUND = Plane(normal=(0, 0, 1), offset=0.0)


def stages_of(sim):
    """The stages of a simulator of one shard: the only way in which these tests reach behind its surface."""
    (shard,) = sim._world.shards
    return shard.stages


def opened(scene, device, num_envs=1, settings=None):
    """A simulator with room for every pair of bodies, so that single stages never run out of it, and its stages.

    All environments are one shard, on any number of cores.
    """
    bodies = len(scene.bodies)
    pairs = num_envs * max(8, bodies * (bodies - 1) // 2)
    room = {"pairs": pairs, "contacts": min(36 * pairs, 100 * num_envs * bodies)}
    with (
        mock.patch("warp_rigid.engine.batch.usable_cores", return_value=1),
        mock.patch("warp_rigid.engine.hash_grid.CANDIDATES_PER_BODY", bodies),
    ):
        sim = Simulator(scene, num_envs=num_envs, settings=settings, device=device, capacity=room)
    return sim, stages_of(sim)


def find_contacts(stages):
    """Run the stages up to the contact records."""
    stages.predict(stages.dt)
    stages.find_pairs()
    stages.find_contacts()


def table(struct, names, count):
    """The first `count` rows of some arrays of a struct."""
    return {name: getattr(struct, name).numpy()[:count].copy() for name in names}


def pair_list(stages):
    """Rows (body_a, body_b) of the broad phase, in order."""
    pairs = stages.pools.pairs
    count = int(pairs.start.numpy()[-1])
    return np.stack([pairs.body_a.numpy()[:count], pairs.body_b.numpy()[:count]], axis=1)


def contact_list(stages):
    """The contact records of the present step, by field."""
    contacts = stages.pools.contacts
    count = int(stages.pools.pairs.contact_start.numpy()[-1])
    fields = table(contacts, ("key", "position"), count)
    for records in (contacts.rows.numpy()[:count], contacts.impulses.numpy()[:count]):
        fields |= {name: records[name].copy() for name in records.dtype.names}
    pairs, pair = stages.pools.pairs, contacts.pair.numpy()[:count]
    return fields | {name: getattr(pairs, name).numpy()[pair] for name in ("body_a", "body_b")}


def rotation_matrix(quaternion):
    """Rotation matrices of unit quaternions (..., 4), from the rotated unit vectors v + 2 q x (q x v + w v)."""
    q = np.asarray(quaternion, np.float64)
    axis, w = q[..., None, :3], q[..., None, 3:]
    unit = np.broadcast_to(np.eye(3), (*q.shape[:-1], 3, 3))
    turned = unit + 2.0 * np.cross(axis, np.cross(axis, unit) + w * unit)
    return np.swapaxes(turned, -1, -2)


def rotate_about(axis, degrees):
    """Quaternion (x, y, z, w) of a rotation about an axis."""
    axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    half = 0.5 * np.radians(degrees)
    return (*(np.sin(half) * axis), np.cos(half))


def random_quaternion(generator, count=None):
    """Uniform unit quaternions."""
    q = generator.normal(size=4 if count is None else (count, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def tangent_basis(normal):
    """The engine's two tangents of each normal (its convention: the impulse's components refer to them)."""
    n = np.asarray(normal, np.float64)
    other = np.where(np.abs(n[:, :1]) > 0.7, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(n, other)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return u, np.cross(n, u)


class ContactProblem:
    """The contact problem of a step in float64: masses, Jacobian, biases and friction limits.

    Rows of the Jacobian come in threes: normal and two tangents of a contact. Velocities are (bodies, 6): linear
    and angular.
    """

    def __init__(self, stages):
        bodies, state = stages.model.bodies, stages.state
        self.contacts = contact_list(stages)
        self.inverse_mass = bodies.inverse_mass.numpy().astype(np.float64)
        turn = rotation_matrix(state.orientation.numpy())
        local = bodies.inverse_inertia.numpy().astype(np.float64)
        self.inverse_inertia = turn @ local @ np.swapaxes(turn, -1, -2)
        self.center = state.position.numpy() + np.einsum(
            "bij,bj->bi", turn, bodies.center_of_mass.numpy().astype(np.float64)
        )
        count, rows = len(self.contacts["gap"]), len(self.inverse_mass)
        normal = self.contacts["normal"].astype(np.float64)
        basis = np.stack([normal, *tangent_basis(normal)], axis=1)
        self.jacobian = np.zeros((count, 3, rows, 6))
        each = np.arange(count)
        # Bodies that are still apart touch where the surface of the one that moves reaches the immovable one.
        immovable = np.minimum(*(self.inverse_mass[self.contacts[name]] for name in ("body_a", "body_b"))) == 0.0
        apart = 0.5 * np.where(immovable & (self.contacts["bias_velocity"] > 0.0), self.contacts["gap"], 0.0)
        for name, sign in (("body_a", 1.0), ("body_b", -1.0)):
            body = self.contacts[name]
            arm = self.contacts["position"] + sign * apart[:, None] * normal - self.center[body]
            self.jacobian[each, :, body, :3] = sign * basis
            self.jacobian[each, :, body, 3:] = sign * np.cross(arm[:, None, :], basis)
        # What surfaces do beyond the velocities of the bodies counts as a bias along the normal and both tangents.
        self.surface = np.einsum("cki,ci->ck", basis, self.contacts["surface"].astype(np.float64))
        self.bias = self.contacts["bias_velocity"].astype(np.float64)
        self.inverse_mass_matrix = np.zeros((rows, 6, 6))
        self.inverse_mass_matrix[:, range(3), range(3)] = self.inverse_mass[:, None]
        self.inverse_mass_matrix[:, 3:, 3:] = self.inverse_inertia

    def delassus(self):
        """W = J M^-1 J^T, (3 contacts, 3 contacts)."""
        count, rows = self.jacobian.shape[0], self.jacobian.shape[2]
        flat = self.jacobian.reshape(3 * count, rows, 6)
        weighted = np.einsum("bij,cbj->cbi", self.inverse_mass_matrix, flat)
        return flat.reshape(3 * count, -1) @ weighted.reshape(3 * count, -1).T

    def velocity(self, stages):
        """The present velocities, (bodies, 6)."""
        solver_bodies = stages.motions.solver_bodies.numpy()
        return np.concatenate([solver_bodies["linear"], solver_bodies["angular"]], axis=1).astype(np.float64)

    def slip(self, velocity):
        """Relative velocities at the contacts, (contacts, 3)."""
        return np.einsum("ckbi,bi->ck", self.jacobian, velocity) + self.surface

    def change(self, impulse):
        """Velocity change that impulses (contacts, 3) make, (bodies, 6)."""
        return np.einsum("bij,ckbj,ck->bi", self.inverse_mass_matrix, self.jacobian, impulse)

    def energy(self, velocity, impulse):
        """The contact problem's energy f = v.Mv / 2 + b.l [J], of the bodies that move."""
        return self.energy_of(velocity, impulse, np.ones(len(velocity), bool))

    def energy_of(self, velocity, impulse, chosen):
        """The same, of the chosen bodies and their contacts."""
        moving = np.flatnonzero(chosen & (self.inverse_mass > 0.0))
        mass = np.linalg.inv(self.inverse_mass_matrix[moving])
        kinetic = 0.5 * np.einsum("bi,bij,bj->", velocity[moving], mass, velocity[moving])
        a, b = self.contacts["body_a"], self.contacts["body_b"]
        counted = np.isin(a, moving) | np.isin(b, moving)
        biased = self.bias * impulse[:, 0] + np.einsum("ck,ck->c", self.surface, impulse)
        return kinetic + float(biased[counted].sum())

    def coulomb_residual(self, velocity, impulse):
        """How far each contact is from Coulomb's law [m/s]: zero exactly at a solution.

        The natural map: the normal impulse and the normal velocity beyond the gap are complementary; the
        tangential impulse lies in the disk of radius friction times normal impulse and opposes the slip.
        """
        slip = self.slip(velocity)
        k = np.einsum("ckbi,bij,ckbj->ck", self.jacobian, self.inverse_mass_matrix, self.jacobian)
        normal = impulse[:, 0] - np.maximum(impulse[:, 0] - (slip[:, 0] + self.bias) / k[:, 0], 0.0)
        scale = k[:, 1:].max(axis=1)
        trial = impulse[:, 1:] - slip[:, 1:] / scale[:, None]
        limit = self.contacts["friction"] * impulse[:, 0]
        length = np.linalg.norm(trial, axis=1)
        shrink = np.minimum(1.0, limit / np.maximum(length, 1e-300))
        tangential_inverse_mass = np.linalg.norm(impulse[:, 1:] - shrink[:, None] * trial, axis=1)
        return np.maximum(np.abs(normal) * k[:, 0], tangential_inverse_mass * scale)


def hull_polygon(points):
    """Corners of the convex hull of points (n, 2), counter-clockwise."""
    return points[ConvexHull(points).vertices]


def clip_polygon(polygon, half):
    """Part of a convex polygon inside the rectangle |x| <= half[0], |y| <= half[1] (Sutherland and Hodgman)."""
    for axis in range(2):
        for sign in (-1.0, 1.0):
            kept = []
            for p, q in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
                a, b = half[axis] - sign * p[axis], half[axis] - sign * q[axis]
                if a >= 0.0:
                    kept.append(p)
                if a * b < 0.0:
                    kept.append(p + a / (a - b) * (q - p))
            polygon = np.array(kept)
    return polygon


def polygon_area(polygon):
    """Area of a polygon by its corners (the shoelace formula)."""
    x, y = np.asarray(polygon).T
    return 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


def distance_outside(points, hull):
    """How far points (n, 2) lie outside a counter-clockwise convex polygon [m], 0 inside."""
    side = np.roll(hull, -1, axis=0) - hull
    outward = np.stack([side[:, 1], -side[:, 0]], axis=1)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    height = np.einsum("pki,ki->pk", points[:, None] - hull[None], outward)
    return np.maximum(height.max(axis=1), 0.0)


def random_pile(generator, count=24, friction=0.6):
    """Boxes and spheres of different sizes over level ground between four walls, some touching, most falling."""
    scene = ground_scene(friction=friction)
    grounds.add_plane_bin(scene, 0.3, friction=friction)
    for k in range(count):
        size = generator.uniform(0.05, 0.12)
        shape = Sphere(size) if k % 4 == 0 else Box(size * generator.uniform(0.6, 1.4, 3))
        position = (*generator.uniform(-0.2, 0.2, 2), 0.15 + 0.09 * k)
        scene.add_body(shape, position=position, orientation=rotations.random(generator, 1)[0], friction=friction)
    return scene


def moving(scene):
    """Which bodies of a scene are dynamic."""
    return np.array([body.motion == Motion.DYNAMIC for body in scene.bodies])


def add_uneven_stack(scene, count, shape=stacks.CUBE, x=0.0, gap=0.0, zigzag=0.0, twist=0.0, **coefficients):
    """A stack whose bodies are offset by +-`zigzag` along x in turn, and turned by `twist` to the one below [rad]."""
    positions = stacks.column(count, shape, gap=gap) + [x, 0.0, 0.0]
    positions[:, 0] += zigzag * np.where(np.arange(count) % 2 == 0, 1.0, -1.0)
    angle = 0.5 * twist * np.arange(count)
    orientations = np.stack([0.0 * angle, 0.0 * angle, np.sin(angle), np.cos(angle)], axis=1)
    return add_bodies(scene, shape, positions, orientations, **coefficients)
