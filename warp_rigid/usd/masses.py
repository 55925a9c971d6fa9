"""Masses of UsdPhysics: the mass of a body, its centre and its moments of inertia.

MJCF files state several hinges and sliders in series between two bodies. Light bodies lie between these joints
(`insert_links`). Each takes a share of the mass of the second body, as a point on the next joint, and of its moments of
inertia. The sum of the masses and the common motion of all these bodies stay the same. What changes is the resistance
to a rotation by the later joints alone, by the share.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pxr import Usd, UsdPhysics

from warp_rigid import rotations
from warp_rigid.scene.scene import Body, Scene
from warp_rigid.scene.shapes import Compound, Shape
from warp_rigid.scene.shapes.compound import with_distribution
from warp_rigid.scene.shapes.mass_properties import MassProperties, combine, steiner
from warp_rigid.usd.conventions import polar, transform, xyzw
from warp_rigid.usd.prims import authored
from warp_rigid.usd.usd_file import UsdFile

DEFAULT_DENSITY = 1000.0
"""Default density of UsdPhysics, without mass or density in the file [kg/m^3]."""
TOLERANCE = 1e-3
"""Relative tolerance within which mass properties equal those of the shape."""
MUJOCO_COLLIDER = "MjcCollisionAPI"
"""Schema of the colliders of a file that was converted from one of MuJoCo."""
SHARE = 1e-3
"""Share of a body's mass and moments of inertia that each body between two of its joints takes."""


@dataclass
class Collider:
    """A solid in its body's frame."""

    prim: Usd.Prim
    shape: Shape
    position: np.ndarray
    orientation: np.ndarray
    coefficients: dict[str, float]
    density: float | None
    mass: float | None
    frame: np.ndarray | None
    """Transform from its prim to the body (4, 4), with the length unit [m]; None if that is the prim of the body."""


def mass_of_colliders(
    file: UsdFile, prim: Usd.Prim, group: Sequence[Collider], shape: Shape, stretch: np.ndarray
) -> tuple[Shape, float]:
    """The shape of a body with the distribution of its mass, and the mass [kg].

    Args:
        file: the file.
        prim: of the body.
        group: its colliders.
        shape: their common shape, in the frame of the body.
        stretch: (3, 3) of the body [m].

    Raises:
        ValueError: A mass or density is negative or not finite.
    """
    parts = np.array([_mass_of(file, collider) for collider in group])
    given = positive(UsdPhysics.MassAPI(prim).GetMassAttr())
    mass = float(parts.sum()) if given is None else given * file.kilogram
    weights = parts if parts.sum() > 0.0 else np.array([collider.shape.volume for collider in group])
    own = combine(_piece(file, c, weight) for c, weight in zip(group, weights / weights.sum(), strict=True))
    center, per_mass = _distribution(file, prim, mass, transform(stretch), own)
    if _is_uniform(shape, center, per_mass):
        return shape, mass
    return with_distribution(shape, center, per_mass), mass


def mass_without_colliders(file: UsdFile, prim: Usd.Prim, stretch: np.ndarray) -> tuple[Shape, float]:
    """A shape that touches nothing, and the mass [kg], of a body without colliders.

    Raises:
        ValueError: The file does not state its mass and its moments of inertia.
    """
    mass = positive(UsdPhysics.MassAPI(prim).GetMassAttr())
    if mass is None or _tensor(file, prim) is None:
        raise ValueError(f"and no {'mass' if mass is None else 'moments of inertia'}")
    mass *= file.kilogram
    nothing = MassProperties(1.0, np.zeros(3), np.zeros((3, 3)))
    return Compound([], *_distribution(file, prim, mass, transform(stretch), nothing)), mass


def _mass_of(file: UsdFile, collider: Collider) -> float:
    """Mass of a collider by its own mass or density [kg]."""
    if collider.mass is not None:
        return collider.mass * file.kilogram
    unit = file.kilogram / file.meter**3
    return (DEFAULT_DENSITY if collider.density is None else collider.density * unit) * collider.shape.volume


def _piece(file: UsdFile, collider: Collider, part: float) -> tuple[MassProperties, np.ndarray, np.ndarray]:
    """A collider as a part of the mass of its body, in the frame of the body."""
    own = collider.shape.mass_properties
    scaled = MassProperties(1.0, own.center_of_mass, own.inertia / own.volume)
    placed = combine([(scaled, collider.position, rotations.matrix(collider.orientation))])
    center, per_mass = placed.center_of_mass, placed.inertia
    if collider.frame is not None and (mass := _mass_of(file, collider)) > 0.0:
        center, per_mass = _distribution(file, collider.prim, mass, collider.frame, placed)
    return MassProperties(part, center, part * per_mass), np.zeros(3), np.eye(3)


def _distribution(
    file: UsdFile, prim: Usd.Prim, mass: float, frame: np.ndarray, own: MassProperties
) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass (3,) [m] and inertia about it per mass (3, 3) [m^2]; where not in the file, that of `own`.

    `frame` is the transform from the prim to the body (4, 4), to which the results refer.
    """
    center, per_mass = own.center_of_mass, own.inertia
    given = stated_center(prim)
    if given is not None:
        center = (frame @ np.array([*given, 1.0]))[:3]
        per_mass = per_mass + steiner(center - own.center_of_mass)
    tensor = _tensor(file, prim)
    if tensor is not None:
        rotation, _ = polar(frame[:3, :3])
        per_mass = rotation @ tensor @ rotation.T / mass
    return center, per_mass


def stated_center(prim: Usd.Prim) -> np.ndarray | None:
    """The centre of mass that a file states for a prim, in its frame (3,); None without."""
    given = authored(prim, "physics:centerOfMass")
    # The default of the schema is minus infinity.
    return np.array(given, np.float64) if given is not None and np.isfinite(given).all() else None


def _tensor(file: UsdFile, prim: Usd.Prim) -> np.ndarray | None:
    """The inertia tensor in the frame of the prim (3, 3) [kg m^2]; None if the file does not state it."""
    api = UsdPhysics.MassAPI(prim)
    given = api.GetDiagonalInertiaAttr().Get()
    moments = np.zeros(3) if given is None else np.array(given, dtype=np.float64)
    if not moments.any():
        return None
    if not (np.isfinite(moments).all() and (moments > 0.0).all()):
        file.change(prim, "moments of inertia: must be > 0; those of its shape are used")
        return None
    axes = api.GetPrincipalAxesAttr().Get()
    orientation = xyzw(axes) if axes else np.zeros(4)
    # The default of the schema is a quaternion of zeros.
    length = float(np.linalg.norm(orientation))
    matrix = rotations.matrix(orientation / length) if length > 0.0 else np.eye(3)
    return file.kilogram * file.meter**2 * matrix @ np.diag(moments) @ matrix.T


def states_no_mass(body: Usd.Prim) -> bool:
    """Whether a file states that a body has no mass, such as a link of URDF that has only colliders.

    USD ignores a mass of zero, but such a link also has an inertia tensor of Newton's schema.
    """
    if not body or (tensor := body.GetAttribute("newton:inertia").Get()) is None:
        return False
    mass = UsdPhysics.MassAPI(body).GetMassAttr()
    return not mass.Get() and (not any(tensor) or mass.HasAuthoredValue())


def with_point_mass(body: Body, point: np.ndarray, mass: float, tensor: np.ndarray | float = 0.0) -> Body:
    """A body with a further mass [kg] at a point of its frame (3,), and moments of inertia (3, 3) about it [kg m^2].

    Negative ones are taken away.
    """
    arm = np.asarray(point) - body.shape.center_of_mass
    total = body.mass + mass
    center = body.shape.center_of_mass + mass / total * arm
    inertia = _inertia_of(body) + tensor + body.mass * mass / total * steiner(arm)
    shape = with_distribution(body.shape, center, inertia / total)
    return replace(body, shape=shape, mass=total, linear_velocity=velocity_at(body, center))


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
        now = scene.bodies[body]
        tensor, arm = _inertia_of(now), np.asarray(anchor) - now.shape.center_of_mass
        # A mass far outside a slender body must not take all of its smallest moment of inertia.
        least = float(np.linalg.eigvalsh(tensor)[0])
        mass = SHARE * min(now.mass, least / max(float(arm @ arm), 1e-30))
        tensor = SHARE * tensor
        scene.bodies[body] = with_point_mass(now, anchor, -mass, -tensor)
        links.append(
            scene.add_body(
                Compound([], anchor, tensor / mass),
                mass=mass,
                position=given.position,
                orientation=given.orientation,
                linear_velocity=velocity_at(given, anchor),
                angular_velocity=given.angular_velocity,
                name=name,
            )
        )
    return links


def _inertia_of(body: Body) -> np.ndarray:
    """Moments of inertia about the centre of mass (3, 3) [kg m^2]."""
    return body.shape.inertia * (body.mass / body.shape.volume)


def velocity_at(body: Body, point: np.ndarray) -> tuple[float, float, float]:
    """Velocity of a point in the frame of a body [m/s]."""
    arm = rotations.rotate(np.array(body.orientation), np.asarray(point) - body.shape.center_of_mass)
    x, y, z = (np.array(body.linear_velocity) + np.cross(body.angular_velocity, arm)).tolist()
    return x, y, z


def scale_to_total(file: UsdFile, scene: Scene) -> None:
    """Scale all masses to the total that a file of MuJoCo states (`settotalmass`), if it does."""
    for prim in file.stage.Traverse():
        total = prim.GetAttribute("mjc:compiler:setTotalMass").Get()
        if total is not None and 0.0 < total < math.inf:
            share = float(total) / max(sum(body.mass for body in scene.bodies), 1e-30)
            scene.bodies[:] = [replace(body, mass=share * body.mass) for body in scene.bodies]
            return


def positive(attribute: Usd.Attribute) -> float | None:
    """A mass or density; None if it is not authored or zero, which USD ignores.

    Raises:
        ValueError: It is negative or not finite.
    """
    value = attribute.Get() if attribute else None
    if value is None or value == 0.0:
        return None
    if not 0.0 < value < math.inf:
        raise ValueError(f"{attribute.GetName()}: must be a finite number >= 0, got {value:g}")
    return float(value)


def _is_uniform(shape: Shape, center: np.ndarray, per_mass: np.ndarray) -> bool:
    """Whether this is the distribution of a mass that is uniform over the shape."""
    size = float(np.max(shape.bounds[1] - shape.bounds[0]))
    own = shape.inertia / shape.volume
    near = np.linalg.norm(center - shape.center_of_mass) <= TOLERANCE * size
    return bool(near and np.abs(per_mass - own).max() <= TOLERANCE * np.abs(own).max())
