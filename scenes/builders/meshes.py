"""Ready-made meshes: the bunny that ships with Warp, simple solids, and two organic shapes.

All are centred on their centre of mass. `sdf_resolution` means the same as in `Mesh`.
"""

import os
from functools import lru_cache

import numpy as np

from warp_rigid.checks import number_in, whole_in
from warp_rigid.files import mesh_files
from warp_rigid.scene.shapes import mass_properties, tessellation, topology
from warp_rigid.scene.shapes.mesh import Mesh
from warp_rigid.scenes.builders import bones, organic


@lru_cache(maxsize=8)
def bunny(size: float = 0.2, sdf_resolution: int = 64) -> Mesh:
    """The Stanford bunny (6102 vertices, closed) from Warp's examples.

    The frame's axes are the principal ones, that of the smallest moment first; in the upright bunny
    the first two point upwards.

    Args:
        size: longest side of the upright bunny [m].
        sdf_resolution: as in `Mesh`.
    """
    import warp

    path = os.path.join(os.path.dirname(warp.__file__), "examples", "assets", "bunny.usd")
    vertices, faces, *_ = mesh_files.load(path)
    vertices = vertices * (number_in("size", size, above=0) / np.ptp(vertices, axis=0).max())
    solid = mass_properties.polyhedron(vertices, faces)
    _, axes = np.linalg.eigh(solid.inertia)
    axes[:, axes[2] < 0.0] *= -1.0
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return Mesh((vertices - solid.center_of_mass) @ axes, faces, sdf_resolution)


def torus(major: float = 0.07, minor: float = 0.03, segments: int = 32, sdf_resolution: int = 64) -> Mesh:
    """Torus about z, its vertices on the smooth surface.

    Args:
        major: radius of the tube's middle [m].
        minor: radius of the tube, less than major [m].
        segments: around the axis, 8 to 512; half as many around the tube.
        sdf_resolution: as in `Mesh`.
    """
    number_in("minor", minor, above=0)
    number_in("major", major, above=minor)
    segments = whole_in("segments", segments, 8, 512)
    angle = 2.0 * np.pi * np.arange(segments // 2) / (segments // 2)
    section = np.stack([major + minor * np.cos(angle), minor * np.sin(angle)], axis=1)
    return Mesh(*tessellation.wheel(section, segments), sdf_resolution)


def ring(
    inner: float = 0.06,
    outer: float = 0.1,
    height: float = 0.04,
    segments: int = 48,
    sdf_resolution: int = 64,
) -> Mesh:
    """Pierced disc about z: a ring of rectangular section.

    Args:
        inner: radius of the hole [m].
        outer: outer radius, more than inner [m].
        height: along z [m].
        segments: around the axis, 8 to 512.
        sdf_resolution: as in `Mesh`.
    """
    number_in("inner", inner, above=0)
    number_in("outer", outer, above=inner)
    half = 0.5 * number_in("height", height, above=0)
    section = np.array([[inner, -half], [outer, -half], [outer, half], [inner, half]])
    segments = whole_in("segments", segments, 8, 512)
    return Mesh(*tessellation.wheel(section, segments), sdf_resolution)


def tetrahedron(radius: float = 0.1, sdf_resolution: int = 64) -> Mesh:
    """Regular tetrahedron; `radius` is the distance from the centre to the corners [m]."""
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=np.float64)
    return _platonic(corners, tessellation.hull_triangles(corners), radius, sdf_resolution)


def octahedron(radius: float = 0.1, sdf_resolution: int = 64) -> Mesh:
    """Regular octahedron; `radius` is the distance from the centre to the corners [m]."""
    corners = np.concatenate([np.eye(3), -np.eye(3)])
    return _platonic(corners, tessellation.hull_triangles(corners), radius, sdf_resolution)


def icosahedron(radius: float = 0.1, sdf_resolution: int = 64) -> Mesh:
    """Regular icosahedron; `radius` is the distance from the centre to the corners [m]."""
    return _platonic(*tessellation.icosahedron(), radius, sdf_resolution)


def dodecahedron(radius: float = 0.1, sdf_resolution: int = 64) -> Mesh:
    """Regular dodecahedron of 36 triangles; `radius` is the distance from the centre to the corners [m]."""
    return _platonic(*tessellation.dodecahedron(), radius, sdf_resolution)


def skull_like(size: float = 0.25, sdf_resolution: int = 64) -> Mesh:
    """A skull-like shell without thickness, with open eye sockets, nose, mouth and base; the face points along +x.

    As a body it is the solid skull with its holes capped (see `Mesh`).

    Args:
        size: longest side [m].
        sdf_resolution: as in `Mesh`.
    """
    return _centered(*organic.skull(), size, sdf_resolution)


def brain_like(size: float = 0.18, sdf_resolution: int = 64) -> Mesh:
    """A closed, folded surface of two halves with a cerebellum; the front points along +x.

    Args:
        size: longest side [m].
        sdf_resolution: as in `Mesh`.
    """
    return _centered(*organic.brain(), size, sdf_resolution)


def cranium(size: float = 0.2, sdf_resolution: int = 64) -> Mesh:
    """A closed skull with hollow eye sockets; `size` is its longest side [m]."""
    return _centered(*bones.cranium(), size, sdf_resolution)


def pelvis(size: float = 0.25, sdf_resolution: int = 64) -> Mesh:
    """A pelvis: a ring with two wings, through which other bones can pass; `size` is its longest side [m]."""
    return _centered(*bones.pelvis(), size, sdf_resolution)


def femur(size: float = 0.44, sdf_resolution: int = 64) -> Mesh:
    """A thigh bone with condyles, neck and head; `size` is its longest side [m]."""
    return _centered(*bones.femur(), size, sdf_resolution)


def _platonic(corners, faces, radius, sdf_resolution) -> Mesh:
    scale = number_in("radius", radius, above=0) / np.linalg.norm(corners[0])
    return Mesh(scale * corners, faces, sdf_resolution)


def _centered(vertices, faces, size, sdf_resolution) -> Mesh:
    """Scale to a longest side and move the centre of mass of the solid to the origin."""
    vertices = vertices * (number_in("size", size, above=0) / np.ptp(vertices, axis=0).max())
    solid = mass_properties.polyhedron(*topology.close_boundaries(vertices, faces))
    return Mesh(vertices - solid.center_of_mass, faces, sdf_resolution)
