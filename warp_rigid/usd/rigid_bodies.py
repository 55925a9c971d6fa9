"""The scene profile: one Xform per body, with UsdPhysics."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from pxr import Sdf, Tf, Vt

from warp_rigid.render.appearance import drawn_looks, frame_colors
from warp_rigid.rotations import inverse, rotate
from warp_rigid.runs.recording import Frame
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.fields import ForceField
from warp_rigid.scene.scene import SURFACE_VELOCITIES, Body, Motion, Scene, unique_name
from warp_rigid.scene.shapes import Shape
from warp_rigid.usd.animation import CONSTANT_COLORINGS, VISIBILITY, may_hide
from warp_rigid.usd.conventions import FOLLOWS_PATH, MARK, gf_quaternion, precise_quaternions, quaternion_of_matrix
from warp_rigid.usd.field_data import fields_to_data
from warp_rigid.usd.joint_prims import write_joint
from warp_rigid.usd.library import Library, simple_shapes, write_pose
from warp_rigid.usd.options import UsdOptions
from warp_rigid.usd.specs import Track, WrittenEnv, define, set_attribute, set_relationship, vec3f
from warp_rigid.usd.start_values import fields_at_start, joints_at_start
from warp_rigid.usd.surface_motion import SURFACE_SCHEMA, write_surface_motion

NAMES = Sdf.ValueTypeNames
PHYSICS_SCENE = "PhysicsScene"
ENV_WORLD = "world"
"""Name of the prim to which joints with the world refer: without a prim, USD takes the origin of the stage."""


class Bodies:
    """Writer of the bodies of one environment.

    Args:
        env: the environment, of a recording with the scene.
        library: receives the colliders.
        options: export options.
        several: whether the stage has several environments.
    """

    def __init__(self, env: WrittenEnv, library: Library, options: UsdOptions, several: bool):
        """Define the prims."""
        samples, root, film, row, frame = env
        assert film.scene is not None
        self._samples, self._film, self._row, self._color, self._several = samples, film, row, options.color, several
        self._tracks: dict[str, list[Track]] = {"place": [], "orientation": [], "color": [], "visibility": []}
        self._paths: list[str] = []
        scene, start = film.scene, film.start
        fields = fields_at_start(scene, start, row)
        _write_scene(samples.layer, f"{root}/{PHYSICS_SCENE}", scene, start["gravity"][row], fields)
        self._position = frame.position[self._row].copy()
        self._orientation = frame.orientation[self._row].copy()
        self._active, self._hides = frame.active[self._row], may_hide(film, row)
        self._colors = frame_colors(self._color, self._film, self._row, frame)
        looks = drawn_looks(self._film, self._color)
        # USD velocities are in the body frame, angular ones in degrees.
        back = inverse(self._orientation)
        self._velocity = vec3f(rotate(back, start["linear_velocity"][self._row]))
        self._spin = vec3f(np.degrees(rotate(back, start["angular_velocity"][self._row])))
        taken = dict.fromkeys((PHYSICS_SCENE, ENV_WORLD, "contacts", "impulses"), 1)
        for index, body in enumerate(scene.bodies):
            name = unique_name(Tf.MakeValidIdentifier(body.name), taken)
            prim = self._define_body(f"{root}/{name}", index, body)
            if name != body.name:
                prim.SetInfo("displayName", body.name)
            geometry = define(samples.layer, f"{root}/{name}/geometry", "Xform")
            coefficients = {name: float(start[name][self._row, index]) for name in COEFFICIENTS}
            path = library.collider(body.shape, row, coefficients)
            look = looks.get(index)
            if self._color in CONSTANT_COLORINGS or (look and look.image):
                path = library.painted(path, self._colors[index], look)
            library.add_reference(geometry, path)
            self._assign(prim, geometry, body, f"{root}/{PHYSICS_SCENE}")
            self._paths.append(f"{root}/{name}")
        self._write_filtered_pairs(scene)
        if any(entry.body_b is None for entry in scene.joints):
            define(samples.layer, f"{root}/{ENV_WORLD}", "Xform")
        ends = [*self._paths, f"{root}/{ENV_WORLD}"]
        for k, (entry, numbers) in enumerate(zip(scene.joints, joints_at_start(scene, start, row), strict=True)):
            name = unique_name(Tf.MakeValidIdentifier(entry.name), taken)
            write_joint(samples.layer, f"{root}/{name}", entry, numbers, bool(start["joint_broken"][row, k]), ends)
            if name != entry.name:
                samples.layer.GetPrimAtPath(f"{root}/{name}").SetInfo("displayName", entry.name)

    def path_of(self, body: int) -> str:
        """Path of a body's prim."""
        return self._paths[body]

    def _write_filtered_pairs(self, scene: Scene) -> None:
        """Write the filtered pairs; static bodies, which USD does not have, are replaced by their colliders."""
        paths = self._paths
        partners: dict[int, list[str]] = {}
        for pair in sorted(scene.filtered_pairs):
            body, other = sorted(pair, key=lambda index: -scene.bodies[index].motion)
            targets = [paths[other]]
            if scene.bodies[other].motion == Motion.STATIC:
                count = len(simple_shapes(scene.bodies[other].shape))
                targets = [f"{paths[other]}/geometry/collider_{index}" for index in range(count)]
            partners.setdefault(body, []).extend(targets)
        for body, targets in partners.items():
            prim = self._samples.layer.GetPrimAtPath(paths[body])
            applied = prim.GetInfo("apiSchemas")
            applied.prependedItems = [*applied.prependedItems, "PhysicsFilteredPairsAPI"]
            prim.SetInfo("apiSchemas", applied)
            set_relationship(prim, "physics:filteredPairs", *targets)

    def _define_body(self, path: str, index: int, body: Body) -> Sdf.PrimSpec:
        """Define a body without its geometry."""
        start, row = self._film.start, self._row
        apis = [[], ["PhysicsRigidBodyAPI"], ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]][body.motion]
        surface = [start[name][row, index] for name in SURFACE_VELOCITIES]
        prim = define(self._samples.layer, path, "Xform", [*apis, *([SURFACE_SCHEMA] if np.any(surface) else [])])
        if np.any(surface):
            write_surface_motion(prim, *surface)
        follows = {} if body.path is None else {FOLLOWS_PATH: True}
        off = {} if self._active[index] else {"active": False}
        prim.SetInfo("customData", {MARK: {"motion": body.motion.name.lower(), **follows, **off}})
        place, orientation = write_pose(prim, self._position[index], self._orientation[index])
        hue = set_attribute(
            prim, "primvars:displayColor", NAMES.Color3fArray, vec3f([self._colors[index]]), interpolation="constant"
        )
        tracked = {"place": place, "orientation": orientation, "color": hue}
        if self._hides:
            tracked["visibility"] = set_attribute(prim, "visibility", NAMES.Token, VISIBILITY[int(self._active[index])])
        for name, attribute in tracked.items():
            self._tracks[name].append(self._samples.track(attribute))
        if index in self._film.looks:
            for name in ("roughness", "metallic"):
                value = [getattr(self._film.looks[index], name)]
                primvar = f"primvars:{name}"
                set_attribute(prim, primvar, NAMES.FloatArray, Vt.FloatArray(value), interpolation="constant")
        if body.motion == Motion.STATIC:
            return prim
        set_attribute(prim, "physics:velocity", NAMES.Vector3f, self._velocity[index])
        set_attribute(prim, "physics:angularVelocity", NAMES.Vector3f, self._spin[index])
        if body.motion == Motion.KINEMATIC:
            set_attribute(prim, "physics:kinematicEnabled", NAMES.Bool, True)
        else:
            mass, (center, moments, axes) = float(start["mass"][row, index]), _principal(body.shape)
            set_attribute(prim, "physics:mass", NAMES.Float, mass)
            set_attribute(prim, "physics:centerOfMass", NAMES.Point3f, center)
            set_attribute(prim, "physics:diagonalInertia", NAMES.Float3, vec3f([mass * moments])[0])
            set_attribute(prim, "physics:principalAxes", NAMES.Quatf, axes)
        return prim

    def _assign(self, prim: Sdf.PrimSpec, geometry: Sdf.PrimSpec, body: Body, owner: str) -> None:
        """Assign a body to its physics scene if there are several."""
        geometry.instanceable = not (self._several and body.motion == Motion.STATIC)
        if geometry.instanceable:
            if self._several:
                set_relationship(prim, "physics:simulationOwner", owner)
            return
        # The scene of a static body is set on its colliders, which is not possible within an instance.
        for index in range(len(simple_shapes(body.shape))):
            over = define(prim.layer, f"{geometry.path}/collider_{index}", specifier=Sdf.SpecifierOver)
            set_relationship(over, "physics:simulationOwner", owner)

    def sample(self, time: float, frame: Frame) -> None:
        """Write a frame."""
        orientation = frame.orientation[self._row].copy()
        orientation[np.einsum("ij,ij->i", orientation, self._orientation) < 0.0] *= -1.0
        self._orientation = orientation
        values: dict[str, Any] = {
            "place": Vt.Vec3dArray.FromNumpy(frame.position[self._row].astype(np.float64)),
            "orientation": Vt.QuatdArray.FromNumpy(precise_quaternions(orientation)),
        }
        if self._hides:
            values["visibility"] = [VISIBILITY[int(active)] for active in frame.active[self._row]]
        if self._color not in CONSTANT_COLORINGS:
            values["color"] = [vec3f([color]) for color in frame_colors(self._color, self._film, self._row, frame)]
        for name, of_bodies in values.items():
            self._samples.put(self._tracks[name], time, of_bodies)


def _write_scene(layer: Sdf.Layer, path: str, scene: Scene, gravity: np.ndarray, fields: Sequence[ForceField]) -> None:
    """Write gravity, and as custom data what UsdPhysics does not define: combine modes, bounds and force fields."""
    prim = define(layer, path, "PhysicsScene")
    strength = math.hypot(*(float(x) for x in gravity))
    direction = np.asarray(gravity, dtype=np.float64) / strength if strength > 0.0 else np.array([0.0, 0.0, -1.0])
    set_attribute(prim, "physics:gravityDirection", NAMES.Vector3f, vec3f([direction])[0])
    set_attribute(prim, "physics:gravityMagnitude", NAMES.Float, strength)
    rules: dict[str, Any] = {"frictionCombine": scene.friction_combine, "restitutionCombine": scene.restitution_combine}
    if scene.bounds is not None:
        rules |= {"bounds": Vt.DoubleArray(np.ravel(scene.bounds).tolist()), "outOfBounds": scene.out_of_bounds}
    prim.SetInfo("customData", {MARK: rules | fields_to_data(fields)})


@lru_cache(maxsize=256)
def _principal(shape: Shape) -> tuple[Any, np.ndarray, Any]:
    """Centre of mass, principal moments per mass [m^2], and the rotation to the principal axes."""
    moments, axes = np.linalg.eigh(np.asarray(shape.inertia) / shape.volume)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] *= -1.0
    return vec3f([shape.center_of_mass])[0], moments, gf_quaternion(quaternion_of_matrix(axes))
