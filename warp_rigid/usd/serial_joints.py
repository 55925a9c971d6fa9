"""Several hinges and sliders in series between two bodies, as MJCF files state them: light bodies lie between.

A body between two joints takes a share of the mass of the second body, as a point on the next joint, and of its
moments of inertia. The sum of the masses and the common motion of all these bodies stay the same. What changes is the
resistance to a rotation by the later joints alone, by the share.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warp_rigid.scene.scene import Body, Scene
from warp_rigid.scene.shapes import Compound
from warp_rigid.scene.shapes.compound import with_distribution
from warp_rigid.scene.shapes.mass_properties import steiner
from warp_rigid.usd.masses import velocity_at

SHARE = 1e-3
"""Share of a body's mass and moments of inertia that each body between two of its joints takes."""


def insert_links(scene: Scene, body: int, anchors: Sequence[np.ndarray], names: Sequence[str]) -> list[int]:
    """Add bodies that connect joints in series, and take their masses from the body that the last joint holds.

    Args:
        scene: the scene.
        body: index of the body.
        anchors: (3,) point in the frame of the body's shape on the joint after each new body [m].
        names: of the new bodies.

    Returns:
        Indices of the new bodies, which have the pose of the body.
    """
    given = scene.bodies[body]
    links = []
    for anchor, name in zip(anchors, names, strict=True):
        rest, link_mass, tensor = _split(scene.bodies[body], anchor)
        scene.bodies[body] = rest
        links.append(
            scene.add_body(
                Compound([], anchor, tensor / link_mass),
                mass=link_mass,
                position=given.position,
                orientation=given.orientation,
                linear_velocity=velocity_at(given, anchor),
                angular_velocity=given.angular_velocity,
                name=name,
            )
        )
    return links


def _split(body: Body, point: np.ndarray) -> tuple[Body, float, np.ndarray]:
    """A body without a part at a point in its frame, and the mass [kg] and the moments of inertia of that part."""
    center, tensor = body.shape.center_of_mass, body.shape.inertia * (body.mass / body.shape.volume)
    arm = np.asarray(point) - center
    least = float(np.linalg.eigvalsh(tensor)[0])
    # A mass far outside a slender body must not take all of its smallest moment of inertia.
    share = SHARE * min(1.0, least / (body.mass * max(float(arm @ arm), 1e-30)))
    taken, left = share * body.mass, (1.0 - share) * body.mass
    part = SHARE * tensor
    rest = tensor - part - (taken / (1.0 - share)) * steiner(arm)
    moved = center - share / (1.0 - share) * arm
    shape = with_distribution(body.shape, moved, rest / left)
    return replace(body, shape=shape, mass=left, linear_velocity=velocity_at(body, moved)), taken, part
