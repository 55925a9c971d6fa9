"""What scenes have in common, for the identity of a sweep and the groups of its trajectories."""

from collections.abc import Hashable

from warp_rigid.scene.scene import Scene


def structure(scene: Scene) -> Hashable:
    """All properties of a scene but the poses, velocities, masses, coefficients and activity of bodies, and gravity."""
    bodies = tuple((body.shape.key, int(body.motion), body.name) for body in scene.bodies)
    fields = tuple(repr(field) for field in scene.force_fields)
    apart = tuple(sorted(scene.filtered_pairs))
    joints = tuple(repr(joint) for joint in scene.joints)
    limits = repr(scene.bounds), scene.out_of_bounds
    return bodies, fields, apart, joints, limits, scene.friction_combine, scene.restitution_combine
