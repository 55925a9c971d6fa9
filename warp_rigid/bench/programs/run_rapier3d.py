"""Rapier on one core of the CPU; meshes as convex parts."""

from importlib.metadata import version

import rapier3d
from problem import PeerProblem, timed_one_by_one


def run(problem: PeerProblem) -> tuple:
    """Step one world per environment."""
    shapes = _shapes(problem)
    worlds = [_world(problem, shapes, env) for env in range(problem.num_envs)]

    def advance(env: int, frames: int) -> None:
        for _ in range(frames * problem.substeps):
            worlds[env][0].step()

    seconds = timed_one_by_one(problem, advance)
    bodies = [[world.rigid_bodies[handle] for handle in handles] for world, handles in worlds]
    read = [
        [[(b.translation.x, b.translation.y, b.translation.z) for b in row] for row in bodies],
        [[(b.rotation.i, b.rotation.j, b.rotation.k, b.rotation.w) for b in row] for row in bodies],
        [[(b.linvel.x, b.linvel.y, b.linvel.z) for b in row] for row in bodies],
    ]
    figures = {
        "version": version("rapier3d"),
        "collider": "box" if problem.vertices is None else f"{len(shapes)} convex parts",
        "device": "cpu",
        **seconds,
        "contacts": sum(_touching(world) for world, _ in worlds),
    }
    return figures, *read


def _shapes(problem: PeerProblem) -> list:
    if problem.vertices is None:
        return [rapier3d.SharedShape.cuboid(*problem.half_extents.tolist())]
    return [rapier3d.SharedShape.convex_hull(part.astype("float32")) for part, _ in problem.convex_parts()]


def _world(problem: PeerProblem, shapes: list, env: int) -> tuple:
    """World and the bodies' handles, without sleeping."""
    world = rapier3d.PhysicsWorld(gravity=tuple(problem.gravity))
    world.set_num_threads(1)
    world.integration_parameters.dt = problem.dt
    world.add_collider(rapier3d.Collider.halfspace((0.0, 0.0, 1.0)).friction(problem.friction))
    for part in problem.fixed:
        world.add_collider(_fixed(part).friction(problem.friction))
    mass = rapier3d.MassProperties((0.0, 0.0, 0.0), problem.mass, problem.inertia.tolist())
    handles = []
    for place, orientation in zip(problem.position[env].tolist(), problem.real_first[env].tolist(), strict=True):
        pose = rapier3d.Isometry3(place, rapier3d.Rotation3.from_quaternion(*orientation))
        body = rapier3d.RigidBody.dynamic().position(pose).can_sleep(False).additional_mass_properties(mass)
        colliders = [
            rapier3d.Collider.new(s).friction(problem.friction).restitution(problem.restitution).density(0.0)
            for s in shapes
        ]
        handles.append(world.add_body(body, colliders))
    return world, handles


def _fixed(part: dict):
    if part["kind"] == "box":
        return rapier3d.Collider.cuboid(*part["half_extents"]).translation(tuple(part["position"]))
    # The axis of Rapier's cylinders is y.
    upright = rapier3d.Rotation3.from_quaternion(0.5**0.5, 0.5**0.5, 0.0, 0.0)
    made = rapier3d.Collider.cylinder(part["half_height"], part["radius"])
    return made.position(rapier3d.Isometry3(part["position"], upright))


def _touching(world) -> int:
    """Contact points without a gap."""
    manifolds = [m for pair in world.narrow_phase.contact_pairs() for m in pair.manifolds]
    return sum(point.dist <= 0.0 for manifold in manifolds for point in manifold.points)
