"""The animation profile: bodies with the same shape are instances of one PointInstancer.

It contains no physics. Writing 10 000 bodies takes 2 ms per frame.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pxr import Sdf, Tf, Vt

from warp_rigid.render.appearance import body_gloss, bound_corners, drawn_looks, frame_colors
from warp_rigid.rotations import matrix_rows, rotate
from warp_rigid.runs.drawn_surface import DrawnSurface
from warp_rigid.runs.recording import Frame, Recording
from warp_rigid.scene.look import Look
from warp_rigid.scene.scene import Motion
from warp_rigid.usd.conventions import MARK
from warp_rigid.usd.library import Library
from warp_rigid.usd.options import UsdOptions
from warp_rigid.usd.specs import Track, WrittenEnv, define, set_attribute, set_relationship, vec3f
from warp_rigid.usd.stage_look import define_surface

NAMES = Sdf.ValueTypeNames


@dataclass(eq=False)
class _Group:
    """One instancer: its bodies, the corners of the bounds of their shape, and their latest poses."""

    bodies: np.ndarray
    corners: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    tracks: dict[str, Track] = field(default_factory=dict)


class Instancers:
    """Writer of the bodies of one environment.

    Readers that evaluate a stage at the default time, such as physics parsers, see default values only; without those
    of the first frame all bodies would be at the origin.

    Args:
        env: the environment.
        library: holds the surfaces.
        options: export options.
    """

    def __init__(self, env: WrittenEnv, library: Library, options: UsdOptions):
        """Define the prims."""
        self._samples, root, self._film, self._row, frame = env
        self._color, self._velocities = options.color, options.velocities
        self._hides = may_hide(self._film, self._row)
        self._groups: list[_Group] = []
        self._paths: dict[int, str] = {}
        self._colors = frame_colors(self._color, self._film, self._row, frame)
        # Of mass, in the frames of the bodies; the origins in a recording from a file, which lacks the scene.
        self._centers = np.zeros((len(self._film.motion), 3))
        for index, body in enumerate(self._film.scene.bodies if self._film.scene else ()):
            if body.motion != Motion.STATIC:
                self._centers[index] = body.shape.center_of_mass
        looks, layer = drawn_looks(self._film, self._color), self._samples.layer
        for name, bodies in _groups(self._film, looks).items():
            surface = self._film.surface[bodies[0]]
            group = _Group(
                bodies,
                bound_corners(self._film.surfaces[surface].vertices_at(frame.times[self._row])),
                frame.position[self._row, bodies],
                frame.orientation[self._row, bodies],
            )
            self._define_group(f"{root}/{name}", group, library, frame)
            look = looks.get(int(bodies[0]))
            if look and look.image:
                prototypes = f"{root}/{name}/Prototypes"
                define_surface(layer, f"{prototypes}/paint", self._colors[bodies[0]], look, library.images)
                prototype = define(layer, f"{prototypes}/shape", "Mesh", ["MaterialBindingAPI"])
                set_relationship(prototype, "material:binding", f"{prototypes}/paint")
            self._paths |= dict.fromkeys(bodies.tolist(), f"{root}/{name}")
            self._groups.append(group)

    def path_of(self, body: int) -> str:
        """Path of the instancer that has a body."""
        return self._paths[body]

    def resize(self, index: int, surface: DrawnSurface) -> None:
        """Write the bounding box of the still instances of a surface that was replaced."""
        for group in self._groups:
            if self._film.surface[group.bodies[0]] == index:
                group.corners = bound_corners(surface.vertices)
                extent = group.tracks["extent"]
                extent.value = self._samples.layer.GetAttributeAtPath(extent.path).default = _extent(group)

    def _define_group(self, path: str, group: _Group, library: Library, frame: Frame) -> None:
        layer = self._samples.layer
        prim = define(layer, path, "PointInstancer")
        motion = Motion(int(self._film.motion[group.bodies[0]]))
        prim.SetInfo("customData", {MARK: {"motion": motion.name.lower()}})
        define(layer, f"{path}/Prototypes", "Scope")
        prototype = define(layer, f"{path}/Prototypes/shape", "Mesh")
        index = int(self._film.surface[group.bodies[0]])
        library.add_reference(prototype, library.mesh_path(index, self._film.surfaces[index], self._row))
        set_relationship(prim, "prototypes", f"{path}/Prototypes/shape")
        indices = np.zeros(len(group.bodies), dtype=np.int32)
        set_attribute(prim, "protoIndices", NAMES.IntArray, Vt.IntArray.FromNumpy(indices))
        set_attribute(prim, "ids", NAMES.Int64Array, Vt.Int64Array.FromNumpy(group.bodies.astype(np.int64)))
        gloss = body_gloss(len(self._film.motion), self._film.looks)[group.bodies]
        for column, name in enumerate(("roughness", "metallic") if self._film.looks else ()):
            value = Vt.FloatArray.FromNumpy(np.ascontiguousarray(gloss[:, column]))
            set_attribute(prim, f"primvars:{name}", NAMES.FloatArray, value, interpolation="vertex")
        for name, value in self._values(group, frame).items():
            vertex = "vertex" if name.startswith("primvars:") else ""
            attribute = set_attribute(prim, name, _TYPES[name], value, interpolation=vertex)
            group.tracks[name] = self._samples.track(attribute)

    def sample(self, time: float, frame: Frame) -> None:
        """Write a frame."""
        if self._color not in CONSTANT_COLORINGS:
            self._colors = frame_colors(self._color, self._film, self._row, frame)
        for group in self._groups:
            surface = self._film.surfaces[self._film.surface[group.bodies[0]]]
            if surface.moves:
                group.corners = bound_corners(surface.vertices_at(frame.times[self._row]))
            orientation = frame.orientation[self._row, group.bodies]
            # q and -q are the same rotation; equal signs let readers interpolate along the short arc.
            orientation[np.einsum("ij,ij->i", orientation, group.orientation) < 0.0] *= -1.0
            group.position, group.orientation = frame.position[self._row, group.bodies], orientation
            self._samples.put(group.tracks.values(), time, self._values(group, frame).values())

    def _values(self, group: _Group, frame: Frame) -> dict[str, Any]:
        """The values of the attributes of a group, which has the poses of the frame."""
        values = {
            "positions": vec3f(group.position),
            "orientationsf": Vt.QuatfArray.FromNumpy(np.ascontiguousarray(group.orientation)),
            "extent": _extent(group),
            "primvars:displayColor": vec3f(self._colors[group.bodies]),
        }
        if self._velocities:  # of the origins of the instances [m/s], and angular ones [degree/s]
            assert frame.angular_velocity is not None and frame.linear_velocity is not None
            spin = frame.angular_velocity[self._row, group.bodies]
            arm = rotate(group.orientation, self._centers[group.bodies])
            values["velocities"] = vec3f(frame.linear_velocity[self._row, group.bodies] - np.cross(spin, arm))
            values["angularVelocities"] = vec3f(spin * np.float32(math.degrees(1.0)))
        if self._hides:
            hidden = group.bodies[~frame.active[self._row, group.bodies]]
            values["invisibleIds"] = Vt.Int64Array.FromNumpy(hidden.astype(np.int64))
        return values


CONSTANT_COLORINGS = ("body", "environment")
"""Colourings that are constant over time."""

_TYPES = {
    "positions": NAMES.Point3fArray,
    "orientationsf": NAMES.QuatfArray,
    "extent": NAMES.Float3Array,
    "primvars:displayColor": NAMES.Color3fArray,
    "velocities": NAMES.Vector3fArray,
    "angularVelocities": NAMES.Vector3fArray,
    "invisibleIds": NAMES.Int64Array,
}

VISIBILITY = "invisible", "inherited"
"""Visibility of a body that is switched off, and of one that is not."""


def may_hide(film: Recording, row: int) -> bool:
    """Whether bodies of an environment may be off: in the recorded frames, or beyond the bounds of the scene."""
    removes = film.scene is not None and film.scene.bounds is not None and film.scene.out_of_bounds == "remove"
    return removes or not film.active[:, row].all()


def _groups(film: Recording, looks: dict[int, Look]) -> dict[str, np.ndarray]:
    """Bodies grouped by surface, motion and look with an image, by prim name."""
    images = {look: number for number, look in enumerate(dict.fromkeys(looks.values()), 1) if look.image}
    image = np.array([images.get(looks[body], 0) if body in looks else 0 for body in range(len(film.motion))])
    keys = np.stack([film.surface, film.motion, image], axis=1)
    groups = {}
    for key in np.unique(keys, axis=0):
        bodies = np.flatnonzero((keys == key).all(axis=1))
        name = Tf.MakeValidIdentifier(film.names[bodies[0]])
        groups[name if name not in groups else f"{name}_{bodies[0]}"] = bodies
    return groups


def _extent(group: _Group) -> Vt.Vec3fArray:
    """Bounding box of all instances.

    Vectorised over the instances, since it runs in every frame.
    """
    lower, upper = group.corners[0], group.corners[-1]
    center, half = (upper + lower) / 2.0, (upper - lower) / 2.0
    rows = matrix_rows(np.ascontiguousarray(group.orientation.T).T)
    box = np.empty((2, 3), dtype=np.float32)
    for axis, row in enumerate(rows):
        middle = group.position[:, axis] + sum(factor * c for factor, c in zip(row, center, strict=True) if c != 0.0)
        reach = sum(np.abs(factor) * h for factor, h in zip(row, half, strict=True))
        box[:, axis] = (middle - reach).min(), (middle + reach).max()
    return vec3f(box)
