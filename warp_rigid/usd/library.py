"""Library of the shapes of a file, each defined once and referenced by its bodies."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Vt

from warp_rigid import rotations
from warp_rigid.render.appearance import bound_corners, corner_normals
from warp_rigid.runs.drawn_surface import DrawnSurface, drawn_surface
from warp_rigid.runs.recording import Frame
from warp_rigid.scene.look import Look
from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Heightfield, Mesh, Plane, Shape, Sphere
from warp_rigid.scene.shapes.base import IDENTITY_ROTATION
from warp_rigid.scene.shapes.heightfield import moves
from warp_rigid.usd.conventions import MARK, precise_quaternions, xyzw
from warp_rigid.usd.image_paths import ImagePaths
from warp_rigid.usd.materials import write_material
from warp_rigid.usd.specs import SampleWriter, Track, define, set_attribute, set_operations, set_relationship, vec3f
from warp_rigid.usd.stage_look import define_surface

PLANE_WIDTH = 20.0
"""Drawn width of an infinite plane [m]."""
RENDERED = "render"
"""Name of the mesh that is rendered instead of colliders."""
SDF_BLOCK = 8
"""The schema of signed distance grids requires resolutions that are multiples of this."""


class Library:
    """Prototypes below one class prim, which is not rendered itself.

    Args:
        layer: layer of the definitions.
        root: path of the class prim.
        frame: the first frame.
        alike: for each row the first row of an environment with the same times, for surfaces that move.
        images: names the images of looks.
    """

    def __init__(self, layer: Sdf.Layer, root: str, frame: Frame, alike: Mapping[int, int], images: ImagePaths):
        """Define the class prim."""
        self.layer, self.root, self._frame, self._alike, self.images = layer, root, frame, alike, images
        self._samples = SampleWriter(layer)
        self._moving: dict[str, tuple[DrawnSurface, int, list[Track]]] = {}
        self._colliders: dict[tuple[str, int, tuple[float, ...]], str] = {}
        self._painted: dict[tuple[str, tuple[float, ...], Look | None], str] = {}
        define(layer, root, "Scope", specifier=Sdf.SpecifierClass)

    def mesh_path(self, index: int, surface: DrawnSurface, row: int) -> str:
        """Path of surface number `index` for an environment."""
        first, place = next(iter(self._alike)), self._row_of(surface.moves, row)
        return f"{self.root}/mesh_{index}" + ("" if place == first else f"_{place}")

    def _row_of(self, moving: bool, row: int) -> int:
        """The row by whose time a surface is drawn for an environment; all have those that do not move in common."""
        return self._alike[row if moving else next(iter(self._alike))]

    def mesh(self, index: int, surface: DrawnSurface) -> None:
        """Define or replace surface number `index`."""
        for row in {self._row_of(surface.moves, row) for row in self._alike}:
            self._write(define(self.layer, self.mesh_path(index, surface, row), "Mesh"), surface, row)

    def sample(self, time: float, frame: Frame) -> None:
        """Write the moving surfaces of a frame."""
        if self._moving and any(frame.times[row] != frame.times[first] for row, first in self._alike.items()):
            raise ValueError("sim: an environment was reset apart from others, which have its moving ground in common")
        for surface, row, tracks in self._moving.values():
            points = surface.vertices_at(frame.times[row])
            normals = corner_normals(points, surface.faces).reshape(-1, 3)
            values = [vec3f(points), vec3f(normals), _extent(points)]
            self._samples.put(tracks, time, values)

    def _write(self, prim: Sdf.PrimSpec, surface: DrawnSurface, row: int) -> None:
        """Write the triangles of the first frame, and track those of a moving surface."""
        write_mesh(prim, surface.vertices_at(self._frame.times[row]), surface.faces, surface.uv)
        if surface.moves:
            tracks = [self._samples.track(prim.attributes[name]) for name in ("points", "normals", "extent")]
            self._moving[str(prim.path)] = surface, row, tracks

    def fit_plane(self, shape: Shape, surface: DrawnSurface) -> None:
        """Replace the drawn surface of a plane, and the width of its collider, which stays infinite."""
        width = float(np.linalg.norm(surface.vertices[1] - surface.vertices[0]))
        for (key, _, _), path in self._colliders.items():
            if key == shape.key:
                write_mesh(self.layer.GetPrimAtPath(f"{path}/{RENDERED}"), surface.vertices, surface.faces)
                for side in ("width", "length"):
                    self.layer.GetAttributeAtPath(f"{path}/collider_0.{side}").default = width

    def add_reference(self, prim: Sdf.PrimSpec, path: str) -> None:
        """Reference a prim of the library from another prim, in the same or in another file."""
        file = "" if prim.layer == self.layer else f"./{Path(self.layer.realPath).name}"
        prim.referenceList.prependedItems = [Sdf.Reference(file, path)]

    def collider(self, shape: Shape, row: int, coefficients: Mapping[str, float]) -> str:
        """Path of an Xform with the colliders of a shape in an environment and their material.

        Colliders that are no meshes are guides, which are not rendered, beside a mesh, which is: some readers, such as
        Blender, give no material to the others.
        """
        row = self._row_of(any(moves(part) for part, _, _ in simple_shapes(shape)), row)
        key = (shape.key, row, tuple(coefficients.values()))
        if key not in self._colliders:
            path = f"{self.root}/shape_{len(self._colliders)}"
            self._colliders[key] = path
            define(self.layer, path, "Xform")
            separate = not isinstance(shape, (Mesh, Heightfield))
            write_material(self.layer, f"{path}/material", coefficients)
            for index, (part, position, orientation) in enumerate(simple_shapes(shape)):
                time = self._frame.times[row]
                prim = _write_shape(self.layer, f"{path}/collider_{index}", part, position, orientation, time)
                if moves(part):
                    self._write(prim, drawn_surface(part), row)
                set_relationship(prim, "material:binding:physics", f"{path}/material")
                if separate:
                    set_attribute(prim, "purpose", Sdf.ValueTypeNames.Token, "guide", uniform=True)
            if separate and simple_shapes(shape):
                surface = drawn_surface(shape)
                mesh = define(self.layer, f"{path}/{RENDERED}", "Mesh", ["MaterialBindingAPI"])
                write_mesh(mesh, surface.vertices, surface.faces, surface.uv)
        return self._colliders[key]

    def painted(self, colliders: str, color: np.ndarray, look: Look | None = None) -> str:
        """Path of an Xform that references colliders and gives them a material of a colour (3,) and a look.

        The material is bound within the Xform: readers that keep instances, such as Blender, find none outside.
        """
        key = (colliders, tuple(np.asarray(color).tolist()), look)
        if key not in self._painted:
            path = f"{self.root}/painted_{len(self._painted)}"
            self._painted[key] = path
            self.add_reference(define(self.layer, path, "Xform"), colliders)
            define_surface(self.layer, f"{path}/paint", color, look, self.images)
            for child in self.layer.GetPrimAtPath(colliders).nameChildren:
                if child.typeName == "Mesh" and child.attributes.get("purpose") is None:
                    over = define(self.layer, f"{path}/{child.name}", specifier=Sdf.SpecifierOver)
                    set_relationship(over, "material:binding", f"{path}/paint")
        return self._painted[key]


def write_mesh(prim: Sdf.PrimSpec, vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray | None = None) -> None:
    """Write triangles with normals and texture coordinates, which are projected where they are not given."""
    names = Sdf.ValueTypeNames
    points = np.ascontiguousarray(vertices, dtype=np.float32)
    corners = np.ascontiguousarray(faces, dtype=np.int32)
    normals = corner_normals(points, corners).reshape(-1, 3)
    set_attribute(prim, "points", names.Point3fArray, vec3f(points))
    counts = np.full(len(corners), 3, dtype=np.int32)
    set_attribute(prim, "faceVertexCounts", names.IntArray, Vt.IntArray.FromNumpy(counts))
    set_attribute(prim, "faceVertexIndices", names.IntArray, Vt.IntArray.FromNumpy(corners.reshape(-1)))
    set_attribute(prim, "normals", names.Normal3fArray, vec3f(normals), interpolation="faceVarying")
    st = _texture_coordinates(points, corners, normals)
    if uv is not None:
        st = np.where(np.isnan(uv), st, uv)
    coordinates = Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(st.reshape(-1, 2), dtype=np.float32))
    set_attribute(prim, "primvars:st", names.TexCoord2fArray, coordinates, interpolation="faceVarying")
    set_attribute(prim, "subdivisionScheme", names.Token, "none", uniform=True)
    set_attribute(prim, "extent", names.Float3Array, _extent(points))
    # Open surfaces are visible from inside.
    set_attribute(prim, "doubleSided", names.Bool, True, uniform=True)


def _texture_coordinates(points: np.ndarray, corners: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Coordinates of an image at the corners (m, 3, 2), from 0 to 1 along the longest side of the shape.

    Each triangle is projected along the axis closest to its normal, so that an image lies on the sides of a box.
    """
    if not len(corners):
        return np.zeros((0, 3, 2))
    lower = points.min(axis=0)
    scaled = ((points - lower) / max(float(np.ptp(points, axis=0).max()), 1e-30))[corners]
    axis = np.abs(normals.reshape(-1, 3, 3).mean(axis=1)).argmax(axis=1)
    first, second = np.array([1, 0, 0])[axis], np.array([2, 2, 1])[axis]
    rows = np.arange(len(corners))[:, None], np.arange(3)[None]
    return np.stack([scaled[*rows, first[:, None]], scaled[*rows, second[:, None]]], axis=-1)


def _extent(points: np.ndarray) -> Vt.Vec3fArray:
    return vec3f(bound_corners(points)[[0, -1]])


def simple_shapes(shape: Shape) -> list[tuple[Shape, np.ndarray, tuple]]:
    """Decompose a shape into non-compound shapes with their poses."""
    if not isinstance(shape, Compound):
        return [(shape, np.zeros(3), IDENTITY_ROTATION)]
    return [
        (
            part,
            position + rotations.rotate(orientation, inner_position),
            tuple(rotations.multiply(orientation, inner_orientation).tolist()),
        )
        for child, position, orientation in shape.children
        for part, inner_position, inner_orientation in simple_shapes(child)
    ]


def _write_shape(layer: Sdf.Layer, path: str, shape: Shape, position, orientation, time: float) -> Sdf.PrimSpec:
    """Write one collider at a time [s]; a shape for which USD has no schema is written as its triangles."""
    if isinstance(shape, Plane):
        # A USD plane is z = 0 in the frame of its prim.
        turn = Gf.Rotation(Gf.Vec3d(0.0, 0.0, 1.0), Gf.Vec3d(*shape.normal.tolist())).GetQuat()
        position, orientation = shape.offset * shape.normal, xyzw(turn)
    names = Sdf.ValueTypeNames
    prim = define(layer, path, "Mesh", ["PhysicsCollisionAPI", "MaterialBindingAPI"])
    primitive = _primitive(shape)
    if primitive is not None:
        prim.typeName, upper, values = primitive
        set_attribute(prim, "extent", names.Float3Array, vec3f([-upper, upper]))
        for name, value in values.items():
            type_name = names.Token if name == "axis" else names.Double
            set_attribute(prim, name, type_name, value, uniform=name == "axis")
    elif isinstance(shape, Mesh):
        # With the resolution of its signed distance grid.
        _write_triangles(prim, shape, "NewtonSDFCollisionAPI")
        rounded = -(-shape.sdf_resolution // SDF_BLOCK) * SDF_BLOCK
        set_attribute(prim, "newton:sdfMaxResolution", names.Int, rounded, uniform=True)
        uv = {} if shape.uv is None else {"uv": True}
        prim.SetInfo("customData", {MARK: {"sdfResolution": shape.sdf_resolution, **uv}})
    else:
        _write_triangles(prim, shape)
        if isinstance(shape, Heightfield):
            prim.SetInfo("customData", {MARK: _heightfield_data(shape, time)})
    write_pose(prim, position, orientation, shape.half_extents if isinstance(shape, Box) else None)
    return prim


def _primitive(shape: Shape) -> tuple[str, np.ndarray, dict[str, Any]] | None:
    """The type of a prim for a shape, the upper corner of its bounds before its scale, and its attributes, if any."""
    if isinstance(shape, Box):
        return "Cube", np.ones(3), {"size": 2.0}
    if isinstance(shape, Sphere):
        return "Sphere", shape.bounds[1], {"radius": shape.radius}
    if isinstance(shape, Capsule | Cylinder):
        sizes = {"axis": "Z", "radius": shape.radius, "height": 2.0 * shape.half_height}
        return type(shape).__name__, shape.bounds[1], sizes
    if isinstance(shape, Plane):
        upper = np.array([0.5 * PLANE_WIDTH, 0.5 * PLANE_WIDTH, 0.0])
        return "Plane", upper, {"axis": "Z", "width": PLANE_WIDTH, "length": PLANE_WIDTH}
    return None


def _heightfield_data(shape: Heightfield, time: float) -> dict[str, Any]:
    """What tells a height field from a mesh, and its motion from a time on [s]."""
    rows, columns = shape.heights.shape
    data: dict[str, Any] = {"heightfieldRows": rows, "heightfieldColumns": columns}
    if shape.moving:
        data |= {
            "heightfieldHeights": Vt.DoubleArray(shape.heights.reshape(-1).tolist()),
            "heightfieldAmplitude": Vt.DoubleArray(shape.amplitude.reshape(-1).tolist()),
            "heightfieldPhase": Vt.DoubleArray((shape.phase + shape.angular_frequency * time).reshape(-1).tolist()),
            "heightfieldSize": Vt.DoubleArray(shape.extent.tolist()),
            "heightfieldFrequency": shape.angular_frequency,
        }
    return data


def _write_triangles(prim: Sdf.PrimSpec, shape: Shape, *apis: str) -> None:
    """Exact triangles that collide as a mesh."""
    schemas = [*prim.GetInfo("apiSchemas").prependedItems, "PhysicsMeshCollisionAPI", *apis]
    prim.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=schemas))
    write_mesh(prim, *shape.surface(), shape.surface_uv())
    set_attribute(prim, "physics:approximation", Sdf.ValueTypeNames.Token, "none", uniform=True)


def write_pose(prim: Sdf.PrimSpec, position, orientation, scale=None) -> list[Sdf.AttributeSpec]:
    """Write translation, rotation and scale of a prim; returns their attributes."""
    names = Sdf.ValueTypeNames
    operations = {
        "translate": (names.Double3, Gf.Vec3d(*np.asarray(position, dtype=np.float64).tolist())),
        "orient": (names.Quatd, Vt.QuatdArray.FromNumpy(precise_quaternions([orientation]))[0]),
    }
    if scale is not None:
        operations["scale"] = names.Double3, Gf.Vec3d(*np.asarray(scale, dtype=np.float64).tolist())
    return set_operations(prim, operations)
