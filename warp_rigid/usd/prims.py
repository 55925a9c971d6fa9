"""Conversion of geometric prims to shapes."""

from typing import Any

import numpy as np
from pxr import Usd, UsdGeom

from warp_rigid.checks import one_of, whole_in
from warp_rigid.files.mesh_files import usd_corners
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
from warp_rigid.usd.conventions import MARK, custom_data, quaternion_of_matrix
from warp_rigid.usd.preview_surface import read_uv

SCALE_TOLERANCE = 1e-5
"""Relative tolerance within which scales count as uniform."""
CONE_SECTIONS = 64


def value_of(prim: Usd.Prim, name: str, otherwise: Any) -> Any:
    """The value of an attribute; a default where the file has none and the schema is not installed."""
    attribute = prim.GetAttribute(name)
    value = attribute.Get() if attribute else None
    return otherwise if value is None else value


def authored(prim: Usd.Prim, name: str) -> Any:
    """The value of an attribute that a file sets; None where it does not."""
    attribute = prim.GetAttribute(name)
    return attribute.Get() if attribute and attribute.HasAuthoredValue() else None


def applies(prim: Usd.Prim, schema: str) -> bool:
    """Whether a schema is applied to a prim, also where the schema is not installed."""
    return schema in prim.GetPrimTypeInfo().GetAppliedAPISchemas()


def custom_array(custom: dict, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """An array of the custom data; one length of the shape may be -1.

    Raises:
        ValueError: The value is missing, not numeric, or of another shape.
    """
    try:
        return np.array(custom[name], dtype=np.float64).reshape(shape)
    except (KeyError, TypeError, ValueError):
        lengths = " x ".join("n" if length < 0 else str(length) for length in shape)
        raise ValueError(f"{name}: must be {lengths} numbers in the custom data of {MARK}") from None


def matrix_of(transform) -> np.ndarray:
    """Convert a USD matrix to the convention `matrix @ column`, (4, 4).

    Raises:
        ValueError: The matrix is not finite.
    """
    matrix = np.array(transform).T
    if not np.isfinite(matrix).all():
        raise ValueError("transform: must be finite numbers")
    return matrix


def matrix_between(places: UsdGeom.XformCache, prim: Usd.Prim, other: Usd.Prim) -> np.ndarray:
    """Transform (4, 4) from the frame of a prim to that of another, which need not be above it.

    Raises:
        ValueError: It is not finite.
    """
    found, resets = places.ComputeRelativeTransform(prim, other)  # exact, if there is no reset between them
    if resets or not prim.GetPath().HasPrefix(other.GetPath()):
        found = places.GetLocalToWorldTransform(prim) * places.GetLocalToWorldTransform(other).GetInverse()
    return matrix_of(found)


def convert_prim(prim: Usd.Prim, matrix: np.ndarray, sdf_resolution: int, notes: list[str]):
    """Convert a prim to a shape and its pose.

    Args:
        prim: a sphere, cube, capsule, cylinder, cone, plane or mesh.
        matrix: transform from the prim's frame to the target frame, (4, 4), including scale [m].
        sdf_resolution: resolution of meshes without their own.
        notes: receives descriptions of changes.

    Returns:
        Shape, position (3,) [m], orientation (4,).

    Raises:
        ValueError: The prim is of another type or is not solid.
    """
    identity = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    if prim.IsA(UsdGeom.Mesh):
        return _mesh(prim, matrix, sdf_resolution, notes), *identity
    axes = matrix[:3, :3] @ _rotation_to_z(prim)
    if prim.IsA(UsdGeom.Plane):
        normal = np.cross(axes[:, 0], axes[:, 1]) * np.sign(np.linalg.det(axes))
        normal /= np.linalg.norm(normal)
        return Plane(normal, float(normal @ matrix[:3, 3])), *identity
    lengths = np.linalg.norm(axes, axis=0)
    if not (lengths > 0.0).all():
        raise ValueError("scale: must not be zero")
    units = axes / lengths
    straight = np.abs(units.T @ units - np.eye(3)).max() < SCALE_TOLERANCE
    shape = _scaled(prim, lengths) if straight else None
    if shape is not None:
        if np.linalg.det(units) < 0.0:
            units = units * [-1.0, 1.0, 1.0]
        return shape, matrix[:3, 3].copy(), quaternion_of_matrix(units)
    vertices, faces = triangles_of(prim)
    cause = "" if prim.IsA(UsdGeom.Cone) else " with this scale"
    notes.append(f"a {prim.GetTypeName()}{cause} is converted to a mesh")
    return _mesh_in_frame(vertices, faces, matrix, sdf_resolution, notes), *identity


def triangles_of(prim: Usd.Prim) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a geometric prim in its own frame and units: vertices (n, 3), faces (m, 3).

    Raises:
        ValueError: The prim is of an unsupported type.
    """
    if prim.IsA(UsdGeom.Mesh):
        points, corners, triangles = usd_corners(UsdGeom.Mesh(prim))
        return points, corners[triangles]
    rotation = _rotation_to_z(prim)
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
        shape = _scaled(prim, np.ones(3))
        assert shape is not None
        vertices, faces = shape.surface()
    return vertices @ rotation.T, faces


def _rotation_to_z(prim: Usd.Prim) -> np.ndarray:
    """Rotation from a frame with the prim's axis as z to the prim's frame."""
    axis = prim.GetAttribute("axis").Get() if prim.HasAttribute("axis") else "Z"
    # A cyclic permutation of the axes is a rotation; the columns are the new axes.
    return np.roll(np.eye(3), "ZXY".index(one_of("axis", axis, ("X", "Y", "Z"))), axis=0)


def _scaled(prim: Usd.Prim, scale: np.ndarray) -> Shape | None:
    """A scaled primitive in a frame with its axis as z; None if it is no longer a primitive of that type."""
    round_, uniform = _is_uniform(scale[:2]), _is_uniform(scale)
    if prim.IsA(UsdGeom.Cube):
        return Box(0.5 * UsdGeom.Cube(prim).GetSizeAttr().Get() * scale)
    radius, half_height = value_of(prim, "radius", 0.0) * scale[0], 0.5 * value_of(prim, "height", 0.0) * scale[2]
    if prim.IsA(UsdGeom.Sphere) or (prim.IsA(UsdGeom.Capsule) and not half_height > 0.0):
        return Sphere(radius) if uniform else None
    if prim.IsA(UsdGeom.Capsule):
        return Capsule(radius, half_height) if uniform else None
    if prim.IsA(UsdGeom.Cylinder):
        return Cylinder(radius, half_height) if round_ else None
    if prim.IsA(UsdGeom.Cone):
        return None
    raise ValueError(f"a {prim.GetTypeName() or 'prim without type'} is not a supported shape")


def _is_uniform(scale: np.ndarray) -> bool:
    return bool(np.ptp(scale) <= SCALE_TOLERANCE * scale.max())


def _mesh(prim: Usd.Prim, matrix: np.ndarray, sdf_resolution: int, notes: list[str]) -> Shape:
    """A mesh collider or a height field."""
    vertices, corners, triangles = usd_corners(UsdGeom.Mesh(prim))
    faces = corners[triangles]
    custom = custom_data(prim)
    if "heightfieldRows" in custom and np.array_equal(matrix, np.eye(4)):
        rows, columns = (
            whole_in(name, custom.get(name), 2, 2**31) for name in ("heightfieldRows", "heightfieldColumns")
        )
        if rows * columns != len(vertices):
            raise ValueError(
                f"heightfieldRows: times heightfieldColumns must be {len(vertices)}, the number of mesh points"
            )
        return Heightfield(
            *_heightfield_arguments(custom, vertices[:, 2].reshape(rows, columns), np.ptp(vertices[:, :2], axis=0))
        )
    if not len(faces):
        raise ValueError("the mesh has no triangles")
    approximation = str(authored(prim, "physics:approximation") or "none")
    if approximation not in ("none", "sdf"):
        notes.append(f"approximation {approximation} is ignored: the mesh itself collides")
    uv = read_uv(prim, corners, triangles, notes)
    if "sdfResolution" in custom:
        return _mesh_in_frame(vertices, faces, matrix, custom["sdfResolution"], [], uv)
    resolution = _resolution(prim, vertices, matrix, sdf_resolution, notes)
    return _mesh_in_frame(vertices, faces, matrix, resolution, notes, uv)


def _heightfield_arguments(custom: dict, heights: np.ndarray, size: np.ndarray) -> tuple:
    """Heights, size and motion of a height field. The mean heights of a moving one are in the custom data."""
    if "heightfieldFrequency" not in custom:
        return heights, size, None
    mean, amplitude, phase = (
        custom_array(custom, f"heightfield{name}", heights.shape) for name in ("Heights", "Amplitude", "Phase")
    )
    motion = HarmonicMotion(amplitude, custom["heightfieldFrequency"], phase)
    return mean, custom_array(custom, "heightfieldSize", (2,)), motion


def _resolution(prim: Usd.Prim, vertices, matrix, default: int, notes: list[str]) -> int:
    """Resolution of the signed distance grid."""
    for name in ("sdfNarrowBandInner", "sdfNarrowBandOuter", "sdfPadding", "sdfTextureFormat"):
        if authored(prim, f"newton:{name}") is not None:
            notes.append(f"newton:{name} is ignored: the grid covers the whole mesh with a margin of 3 cells")
    voxel, resolution = (authored(prim, f"newton:sdf{name}") for name in ("TargetVoxelSize", "MaxResolution"))
    if voxel is not None and voxel > 0.0:
        scale = np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
        longest = float(np.ptp(vertices @ matrix[:3, :3].T, axis=0).max())
        return int(np.clip(np.ceil(longest / (voxel * scale)), 8, 512))
    return default if resolution is None else whole_in("newton:sdfMaxResolution", resolution, 8, 512)


def _mesh_in_frame(vertices, faces, matrix: np.ndarray, sdf_resolution: int, notes: list[str], uv=None) -> Mesh:
    """A transformed mesh; a reflection reverses the winding of its triangles."""
    if not np.array_equal(matrix, np.eye(4)):
        vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        faces = faces[:, ::-1]
        uv = None if uv is None else uv[:, ::-1]
    mesh = Mesh(vertices, faces, sdf_resolution, uv=uv)
    if not mesh.watertight:
        notes.append("the mesh is open: it collides as a solid with its holes capped")
    return mesh
