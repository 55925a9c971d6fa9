"""The shapes of a file, each defined once and referred to by all bodies that have it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Vt

from warp_rigid.render.appearance import bound_corners, corner_normals
from warp_rigid.runs.recording import Surface, drawn_surface
from warp_rigid.scene.shapes import Box, Capsule, Compound, Cylinder, Heightfield, Mesh, Plane, Shape, Sphere
from warp_rigid.scene.shapes.base import IDENTITY_ROTATION, quaternion_matrix, quaternion_product
from warp_rigid.scene.shapes.heightfield import moves
from warp_rigid.usd.geometry import MARK, frame_of_plane, precise_quaternions
from warp_rigid.usd.materials import write_material
from warp_rigid.usd.specs import Samples, Track, define, relate, set_attribute

__all__ = ["Library", "simple_shapes", "write_pose"]

PLANE_WIDTH = 20.0
"""A plane is endless; this much of it is drawn [m]."""
SDF_BLOCK = 8
"""The schema of signed distance grids wants resolutions that are multiples of this."""


class Library:
    """Prototypes below one class prim, which is not drawn by itself.

    Args:
        layer: where they are defined.
        root: path of the class prim.
        time: of the first frame [s].
    """

    def __init__(self, layer: Sdf.Layer, root: str, time: float):
        """Define the class prim."""
        self.layer, self.root, self._time = layer, root, time
        self._samples = Samples(layer)
        self._moving: dict[str, tuple[Surface, list[Track]]] = {}
        self._colliders: dict[tuple[str, tuple[float, ...]], str] = {}
        define(layer, root, "Scope", specifier=Sdf.SpecifierClass)

    def mesh_path(self, index: int) -> str:
        """Where surface number `index` is."""
        return f"{self.root}/mesh_{index}"

    def mesh(self, index: int, surface: Surface) -> None:
        """Define surface number `index`, anew where it is there."""
        self._write(define(self.layer, self.mesh_path(index), "Mesh"), surface)

    def sample(self, frame: float, time: float) -> None:
        """Write the ground that moves as it is at a time [s]."""
        for surface, tracks in self._moving.values():
            points = surface.vertices_at(time)
            normals = corner_normals(points, surface.faces).reshape(-1, 3)
            values = [Vt.Vec3fArray.FromNumpy(points), Vt.Vec3fArray.FromNumpy(normals), _extent(points)]
            self._samples.put(tracks, frame, values)

    def _write(self, prim: Sdf.PrimSpec, surface: Surface) -> None:
        """Triangles as they are in the first frame; those that move are followed."""
        write_mesh(prim, surface.vertices_at(self._time), surface.faces)
        if surface.moves:
            tracks = [self._samples.track(prim.attributes[name]) for name in ("points", "normals", "extent")]
            self._moving[str(prim.path)] = surface, tracks

    def fit_plane(self, shape: Shape, width: float) -> None:
        """Draw less of a plane [m]; it collides as endless all the same."""
        for (key, _), path in self._colliders.items():
            if key == shape.key:
                for side in ("width", "length"):
                    self.layer.GetAttributeAtPath(f"{path}/collider_0.{side}").default = width

    def refer(self, prim: Sdf.PrimSpec, path: str) -> None:
        """Make a prim refer to one of the library's, in the same file or in one beside it."""
        file = "" if prim.layer == self.layer else f"./{Path(self.layer.realPath).name}"
        prim.referenceList.prependedItems = [Sdf.Reference(file, path)]

    def collider(self, shape: Shape, coefficients: Mapping[str, float]) -> str:
        """Return the path of an Xform with a shape's colliders and their material, whose coefficients are given."""
        key = (shape.key, tuple(coefficients.values()))
        if key not in self._colliders:
            path = f"{self.root}/shape_{len(self._colliders)}"
            self._colliders[key] = path
            define(self.layer, path, "Xform")
            write_material(self.layer, f"{path}/material", coefficients)
            for index, (part, position, orientation) in enumerate(simple_shapes(shape)):
                prim = _write_shape(self.layer, f"{path}/collider_{index}", part, position, orientation, self._time)
                if moves(part):
                    self._write(prim, drawn_surface(part))
                relate(prim, "material:binding:physics", f"{path}/material")
        return self._colliders[key]


def write_mesh(prim: Sdf.PrimSpec, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Triangles with normals, drawn as they are."""
    names = Sdf.ValueTypeNames
    points = np.ascontiguousarray(vertices, dtype=np.float32)
    corners = np.ascontiguousarray(faces, dtype=np.int32)
    normals = corner_normals(points, corners).reshape(-1, 3)
    set_attribute(prim, "points", names.Point3fArray, Vt.Vec3fArray.FromNumpy(points))
    counts = np.full(len(corners), 3, dtype=np.int32)
    set_attribute(prim, "faceVertexCounts", names.IntArray, Vt.IntArray.FromNumpy(counts))
    set_attribute(prim, "faceVertexIndices", names.IntArray, Vt.IntArray.FromNumpy(corners.reshape(-1)))
    set_attribute(prim, "normals", names.Normal3fArray, Vt.Vec3fArray.FromNumpy(normals), interpolation="faceVarying")
    set_attribute(prim, "subdivisionScheme", names.Token, "none", uniform=True)
    set_attribute(prim, "extent", names.Float3Array, _extent(points))
    # Open surfaces are seen from inside too.
    set_attribute(prim, "doubleSided", names.Bool, True, uniform=True)


def _extent(points: np.ndarray) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(bound_corners(points)[[0, -1]], dtype=np.float32))


def simple_shapes(shape: Shape) -> list[tuple[Shape, np.ndarray, tuple]]:
    """A shape as simple shapes, each with its pose."""
    if not isinstance(shape, Compound):
        return [(shape, np.zeros(3), IDENTITY_ROTATION)]
    return [
        (part, position + quaternion_matrix(orientation) @ inner, quaternion_product(orientation, turn))
        for child, position, orientation in shape.children
        for part, inner, turn in simple_shapes(child)
    ]


def _write_shape(layer: Sdf.Layer, path: str, shape: Shape, position, orientation, time: float) -> Sdf.PrimSpec:
    """One collider as it is at a time [s]."""
    names = Sdf.ValueTypeNames
    if isinstance(shape, Plane):
        position, orientation = frame_of_plane(shape)
    scale = None
    apis = ["PhysicsCollisionAPI", "MaterialBindingAPI"]
    if isinstance(shape, Mesh | Heightfield):
        apis += ["PhysicsMeshCollisionAPI"] + ["NewtonSDFCollisionAPI"] * isinstance(shape, Mesh)
    prim = define(layer, path, _TYPES[type(shape)], apis)
    if isinstance(shape, Sphere):
        set_attribute(prim, "radius", names.Double, shape.radius)
    elif isinstance(shape, Box):
        set_attribute(prim, "size", names.Double, 2.0)
        scale = shape.half_extents
    elif isinstance(shape, Capsule | Cylinder):
        set_attribute(prim, "axis", names.Token, "Z", uniform=True)
        set_attribute(prim, "radius", names.Double, shape.radius)
        set_attribute(prim, "height", names.Double, 2.0 * shape.half_height)
    elif isinstance(shape, Plane):
        set_attribute(prim, "axis", names.Token, "Z", uniform=True)
        set_attribute(prim, "width", names.Double, PLANE_WIDTH)
        set_attribute(prim, "length", names.Double, PLANE_WIDTH)
    elif isinstance(shape, Mesh | Heightfield):
        _write_triangles(prim, shape, time)
    if not isinstance(shape, Mesh | Heightfield):
        set_attribute(prim, "extent", names.Float3Array, _gprim_extent(shape))
    write_pose(prim, position, orientation, scale)
    return prim


_TYPES = {
    Sphere: "Sphere", Box: "Cube", Capsule: "Capsule", Cylinder: "Cylinder", Plane: "Plane", Mesh: "Mesh",
    Heightfield: "Mesh",
}  # fmt: skip


def _write_triangles(prim: Sdf.PrimSpec, shape: Mesh | Heightfield, time: float) -> None:
    """Exact triangles, with the resolution of the grid of signed distances that stands for them."""
    names = Sdf.ValueTypeNames
    write_mesh(prim, *shape.surface())
    set_attribute(prim, "physics:approximation", names.Token, "none", uniform=True)
    if isinstance(shape, Heightfield):
        rows, columns = shape.heights.shape
        told: dict[str, Any] = {"heightfieldRows": rows, "heightfieldColumns": columns}
        if shape.moving:
            told |= {
                "heightfieldHeights": Vt.DoubleArray(shape.heights.reshape(-1).tolist()),
                "heightfieldAmplitude": Vt.DoubleArray(shape.amplitude.reshape(-1).tolist()),
                "heightfieldPhase": Vt.DoubleArray((shape.phase + shape.angular_frequency * time).reshape(-1).tolist()),
                "heightfieldSize": Vt.DoubleArray(shape.extent.tolist()),
                "heightfieldFrequency": shape.angular_frequency,
            }
        prim.SetInfo("customData", {MARK: told})
        return
    rounded = -(-shape.sdf_resolution // SDF_BLOCK) * SDF_BLOCK
    set_attribute(prim, "newton:sdfMaxResolution", names.Int, rounded, uniform=True)
    prim.SetInfo("customData", {MARK: {"sdfResolution": shape.sdf_resolution}})


def _gprim_extent(shape: Shape) -> Vt.Vec3fArray:
    """Bounds of a primitive in its own frame, before its scale."""
    if isinstance(shape, Box):
        upper = np.ones(3)
    elif isinstance(shape, Plane):
        upper = np.array([0.5 * PLANE_WIDTH, 0.5 * PLANE_WIDTH, 0.0])
    else:
        upper = shape.bounds[1]
    return Vt.Vec3fArray.FromNumpy(np.stack([-upper, upper]).astype(np.float32))


def write_pose(prim: Sdf.PrimSpec, position, orientation, scale=None) -> tuple[Sdf.AttributeSpec, Sdf.AttributeSpec]:
    """Translation, rotation and scale of a prim; the attributes of the first two."""
    names = Sdf.ValueTypeNames
    place = Vt.Vec3dArray.FromNumpy(np.asarray(position, dtype=np.float64).reshape(1, 3))[0]
    operations = ["xformOp:translate", "xformOp:orient"]
    made = (
        set_attribute(prim, operations[0], names.Double3, place),
        set_attribute(prim, operations[1], names.Quatd, Vt.QuatdArray.FromNumpy(precise_quaternions([orientation]))[0]),
    )
    if scale is not None:
        factors = Vt.Vec3dArray.FromNumpy(np.asarray(scale, dtype=np.float64).reshape(1, 3))[0]
        set_attribute(prim, "xformOp:scale", names.Double3, factors)
        operations.append("xformOp:scale")
    set_attribute(prim, "xformOpOrder", names.TokenArray, Vt.TokenArray(operations), uniform=True)
    return made
