"""From a geometric prim to a shape."""

import numpy as np
from pxr import Usd, UsdGeom

from warp_rigid.checks import one_of, whole_in
from warp_rigid.files.mesh_files import usd_triangles
from warp_rigid.scene.shapes import (
    Box,
    Capsule,
    Cylinder,
    HarmonicMotion,
    Heightfield,
    Mesh,
    Plane,
    Shape,
    Sphere,
    tessellation,
)
from warp_rigid.usd.geometry import MARK, quaternion_of_matrix

__all__ = ["Unreadable", "marked", "matrix_of", "place", "told_array", "triangles_of"]

EVEN = 1e-5
"""Scales that differ by less count as equal, relative."""
CONE_SECTIONS = 64


class Unreadable(ValueError):
    """A prim that cannot become a shape; the message says why."""


def marked(prim: Usd.Prim) -> dict:
    """What this package's own files say beyond USD's words."""
    found = prim.GetCustomDataByKey(MARK)
    return found if isinstance(found, dict) else {}


def told_array(told: dict, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers of what `marked` found.

    Raises:
        Unreadable: They are none, or not of this shape; one length may be -1.
    """
    try:
        return np.array(told[name], dtype=np.float64).reshape(shape)
    except (KeyError, TypeError, ValueError):
        lengths = " x ".join("n" if length < 0 else str(length) for length in shape)
        raise Unreadable(f"{name}: must be {lengths} numbers in the custom data of {MARK}") from None


def matrix_of(transform) -> np.ndarray:
    """A USD matrix as `matrix @ column`, (4, 4).

    Raises:
        Unreadable: It holds what is not finite.
    """
    matrix = np.array(transform).T
    if not np.isfinite(matrix).all():
        raise Unreadable("transform: must be finite numbers")
    return matrix


def place(prim: Usd.Prim, matrix: np.ndarray, sdf_resolution: int, notes: list[str]):
    """A prim as a shape and its pose.

    Args:
        prim: a sphere, cube, capsule, cylinder, cone, plane or mesh.
        matrix: from the prim's frame to the one wanted, (4, 4), scale included [m].
        sdf_resolution: for meshes that do not say it themselves.
        notes: takes what had to be changed, in words.

    Returns:
        Shape, position (3,) [m], orientation (4,).

    Raises:
        Unreadable: The prim is of another kind or has no solid.
    """
    still = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    if prim.IsA(UsdGeom.Mesh):
        return _mesh(prim, matrix, sdf_resolution, notes), *still
    axes = matrix[:3, :3] @ _turn_to_z(prim)
    if prim.IsA(UsdGeom.Plane):
        normal = np.cross(axes[:, 0], axes[:, 1]) * np.sign(np.linalg.det(axes))
        normal /= np.linalg.norm(normal)
        return Plane(normal, float(normal @ matrix[:3, 3])), *still
    lengths = np.linalg.norm(axes, axis=0)
    if not (lengths > 0.0).all():
        raise Unreadable("its scale is zero")
    units = axes / lengths
    straight = np.abs(units.T @ units - np.eye(3)).max() < EVEN
    shape = _scaled(prim, lengths) if straight else None
    if shape is not None:
        if np.linalg.det(units) < 0.0:
            units = units * [-1.0, 1.0, 1.0]
        return shape, matrix[:3, 3].copy(), quaternion_of_matrix(units)
    vertices, faces = triangles_of(prim)
    notes.append(f"a {prim.GetTypeName()} with this scale becomes a mesh")
    return _solid(vertices, faces, matrix, sdf_resolution, notes), *still


def triangles_of(prim: Usd.Prim) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a geometric prim in its own frame, (n, 3) in its units, (m, 3).

    Raises:
        Unreadable: The prim is of another kind.
    """
    if prim.IsA(UsdGeom.Mesh):
        return usd_triangles(UsdGeom.Mesh(prim))
    turn = _turn_to_z(prim)
    if prim.IsA(UsdGeom.Cone):
        cone = UsdGeom.Cone(prim)
        half = 0.5 * cone.GetHeightAttr().Get()
        vertices, faces = tessellation.revolve([cone.GetRadiusAttr().Get()], [-half, -half, half], CONE_SECTIONS)
    elif prim.IsA(UsdGeom.Plane):
        plane = UsdGeom.Plane(prim)
        half = 0.5 * np.array([plane.GetWidthAttr().Get(), plane.GetLengthAttr().Get()])
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half
        vertices = np.concatenate([corners, np.zeros((4, 1))], axis=1)
        faces = tessellation.triangulate_quads(np.array([[0, 1, 2, 3]]))
    else:
        vertices, faces = _scaled_or_refused(prim).surface()
    return vertices @ turn.T, faces


def _scaled_or_refused(prim: Usd.Prim) -> Shape:
    shape = _scaled(prim, np.ones(3))
    if shape is None:
        raise Unreadable(f"a {prim.GetTypeName() or 'prim without type'} is no shape that is known here")
    return shape


def _turn_to_z(prim: Usd.Prim) -> np.ndarray:
    """Rotation from a frame whose z is the prim's axis into the prim's frame."""
    axis = prim.GetAttribute("axis").Get() if prim.HasAttribute("axis") else "Z"
    # Cyclic, so that a cylinder's x and y need no mirror: columns are the new axes.
    return np.roll(np.eye(3), "ZXY".index(one_of("axis", axis, ("X", "Y", "Z"))), axis=0)


def _scaled(prim: Usd.Prim, scale: np.ndarray) -> Shape | None:
    """A primitive in a frame whose z is its axis; None where this scale makes it something else."""
    round_, uniform = _even(scale[:2]), _even(scale)
    if prim.IsA(UsdGeom.Sphere):
        return Sphere(UsdGeom.Sphere(prim).GetRadiusAttr().Get() * scale[0]) if uniform else None
    if prim.IsA(UsdGeom.Cube):
        return Box(0.5 * UsdGeom.Cube(prim).GetSizeAttr().Get() * scale)
    if prim.IsA(UsdGeom.Capsule):
        capsule = UsdGeom.Capsule(prim)
        size = capsule.GetRadiusAttr().Get() * scale[0], 0.5 * capsule.GetHeightAttr().Get() * scale[2]
        return (Capsule(*size) if size[1] > 0.0 else Sphere(size[0])) if uniform else None
    if prim.IsA(UsdGeom.Cylinder):
        cylinder = UsdGeom.Cylinder(prim)
        size = cylinder.GetRadiusAttr().Get() * scale[0], 0.5 * cylinder.GetHeightAttr().Get() * scale[2]
        return Cylinder(*size) if round_ else None
    if prim.IsA(UsdGeom.Cone):
        return None
    raise Unreadable(f"a {prim.GetTypeName() or 'prim without type'} is no shape that is known here")


def _even(scale: np.ndarray) -> bool:
    return bool(np.ptp(scale) <= EVEN * scale.max())


def _mesh(prim: Usd.Prim, matrix: np.ndarray, sdf_resolution: int, notes: list[str]) -> Shape:
    """A mesh collider, or what its approximation asks for where that is a simple shape."""
    vertices, faces = usd_triangles(UsdGeom.Mesh(prim))
    told = marked(prim)
    if "heightfieldRows" in told and np.array_equal(matrix, np.eye(4)):
        rows, columns = (whole_in(name, told.get(name), 2, 2**31) for name in ("heightfieldRows", "heightfieldColumns"))
        if rows * columns != len(vertices):
            raise Unreadable(
                f"heightfieldRows: times heightfieldColumns must be the {len(vertices)} points of the mesh"
            )
        return Heightfield(*_field(told, vertices[:, 2].reshape(rows, columns), np.ptp(vertices[:, :2], axis=0)))
    if not len(faces):
        raise Unreadable("the mesh has no triangles")
    attribute = prim.GetAttribute("physics:approximation")
    approximation = str(attribute.Get()) if attribute and attribute.HasAuthoredValue() else "none"
    if approximation not in ("none", "sdf"):
        notes.append(f"approximation {approximation} is not needed: the mesh itself collides")
    if "sdfResolution" in told:
        return _solid(vertices, faces, matrix, told["sdfResolution"], [])
    return _solid(vertices, faces, matrix, _resolution(prim, vertices, matrix, sdf_resolution, notes), notes)


def _field(told: dict, heights: np.ndarray, size: np.ndarray) -> tuple:
    """Heights, size and motion of a height field; a field that moves has its mean heights beside the drawn ones."""
    if "heightfieldFrequency" not in told:
        return heights, size, None
    mean, amplitude, phase = (
        told_array(told, f"heightfield{name}", heights.shape) for name in ("Heights", "Amplitude", "Phase")
    )
    motion = HarmonicMotion(amplitude, told["heightfieldFrequency"], phase)
    return mean, told_array(told, "heightfieldSize", (2,)), motion


def _resolution(prim: Usd.Prim, vertices, matrix, otherwise: int, notes: list[str]) -> int:
    """How fine the grid of signed distances shall be."""
    for name in ("sdfNarrowBandInner", "sdfNarrowBandOuter", "sdfPadding", "sdfTextureFormat"):
        attribute = prim.GetAttribute(f"newton:{name}")
        if attribute and attribute.HasAuthoredValue():
            notes.append(f"newton:{name} has no meaning here: the grid holds all distances, with 3 cells around")
    voxel = prim.GetAttribute("newton:sdfTargetVoxelSize")
    resolution = prim.GetAttribute("newton:sdfMaxResolution")
    if voxel and voxel.HasAuthoredValue() and voxel.Get() > 0.0:
        scale = np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
        longest = float(np.ptp(vertices @ matrix[:3, :3].T, axis=0).max())
        return int(np.clip(np.ceil(longest / (voxel.Get() * scale)), 8, 512))
    if resolution and resolution.HasAuthoredValue():
        return whole_in("newton:sdfMaxResolution", resolution.Get(), 8, 512)
    return otherwise


def _solid(vertices, faces, matrix: np.ndarray, sdf_resolution: int, notes: list[str]) -> Mesh:
    """A mesh, placed; a mirror turns its triangles over."""
    if not np.array_equal(matrix, np.eye(4)):
        vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        faces = faces[:, ::-1]
    try:
        mesh = Mesh(vertices, faces, sdf_resolution)
    except ValueError as error:
        raise Unreadable(str(error)) from None
    if not mesh.watertight:
        notes.append("the mesh is open: it collides as the solid whose holes are lidded")
    return mesh
