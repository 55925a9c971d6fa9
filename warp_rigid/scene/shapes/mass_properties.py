"""Volume, centre of mass and inertia at unit density: polyhedra and sums."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class MassProperties:
    """Mass properties of a solid of density 1.

    Attributes:
        volume: [m^3].
        center_of_mass: (3,) float64 [m].
        inertia: (3, 3) float64 about the centre of mass [m^5]; off-diagonal entries are the
            tensor's, that is minus the products of inertia.
    """

    volume: float
    center_of_mass: np.ndarray
    inertia: np.ndarray


def diagonal(volume: float, moments) -> MassProperties:
    """A solid with its centre of mass at the origin and its principal axes along the frame's."""
    inertia = np.diag(np.asarray(moments, dtype=np.float64))
    return MassProperties(float(volume), np.zeros(3), inertia)


def polyhedron(vertices: np.ndarray, faces: np.ndarray) -> MassProperties:
    """Exact mass properties of the solid inside a closed, outward-facing triangle mesh.

    trimesh sums the surface integrals of D. Eberly, "Polyhedral mass properties (revisited)", 2002,
    in float64, here about the mean of the vertices to avoid cancellation. Cavities whose faces point
    into the hollow are subtracted; inverted meshes have a volume < 0.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3) vertex indices.

    Returns:
        The mass properties; if the volume is zero, the mean of the vertices as centre and no inertia.
    """
    from trimesh import triangles

    vertices = np.asarray(vertices, dtype=np.float64)
    middle = vertices.mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):  # a volume of zero
        solid = triangles.mass_properties((vertices - middle)[np.asarray(faces)])
    if solid.volume == 0.0:
        return MassProperties(0.0, middle, np.zeros((3, 3)))
    return MassProperties(float(solid.volume), middle + solid.center_mass, np.asarray(solid.inertia))


def combine(pieces) -> MassProperties:
    """Sum of solids by the parallel axis theorem.

    Args:
        pieces: (mass properties, position (3,), rotation matrix (3, 3)) of each solid in the common
            frame. The overlap of two solids counts twice.
    """
    pieces = list(pieces)
    volume = sum(piece.volume for piece, _, _ in pieces)
    centers = [rotation @ piece.center_of_mass + position for piece, position, rotation in pieces]
    moment = sum(piece.volume * at for (piece, _, _), at in zip(pieces, centers, strict=True))
    center = moment / volume
    inertia = np.zeros((3, 3))
    for (piece, _, rotation), at in zip(pieces, centers, strict=True):
        arm = at - center
        inertia += rotation @ piece.inertia @ rotation.T
        inertia += piece.volume * steiner(arm)
    return MassProperties(float(volume), center, inertia)


def steiner(arm: np.ndarray) -> np.ndarray:
    """Moment of inertia of a unit mass at an arm (3,) from the axes, (3, 3) [m^2]."""
    return arm @ arm * np.eye(3) - np.outer(arm, arm)
