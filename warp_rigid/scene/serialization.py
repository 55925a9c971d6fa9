"""Conversion of a Scene to plain data and arrays, and back, bit for bit."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from warp_rigid.checks import unit_quaternion, whole_in
from warp_rigid.files.archive import shaped
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.fields import FIELDS
from warp_rigid.scene.joints import JOINTS, JointFrame
from warp_rigid.scene.look import looks_from_data, looks_to_data
from warp_rigid.scene.pose_path import PosePath
from warp_rigid.scene.scene import SURFACE_VELOCITIES, Motion, Scene
from warp_rigid.scene.shapes import Shape

VELOCITIES = ("linear_velocity", "angular_velocity")


def scenes_to_data(scenes: Sequence[Scene]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return plain data for JSON, "shapes" and "scenes", and arrays by name; equal shapes are stored once."""
    arrays: dict[str, np.ndarray] = {}
    shapes: list[dict[str, Any]] = []
    places: dict[str, int] = {}
    found = [_scene_to_data(scene, shapes, arrays, places) for scene in scenes]
    return {"shapes": shapes, "scenes": found}, arrays


def _scene_to_data(scene: Scene, shapes: list, arrays: dict, places: dict[str, int]) -> dict[str, Any]:
    bodies = []
    for body in scene.bodies:
        numbers = {
            name: getattr(body, name)
            for name in ("position", "orientation", *VELOCITIES, "mass", "active", *COEFFICIENTS, *SURFACE_VELOCITIES)
        }
        if body.path is not None:
            names = ("times", "positions", "orientations", "loop")
            numbers["path"] = {name: np.asarray(getattr(body.path, name)).tolist() for name in names}
        shape = _place_shape(body.shape, shapes, arrays, places)
        bodies.append({"shape": shape, "motion": body.motion.name, "name": body.name, **numbers})
    return {
        "gravity": scene.gravity,
        "friction_combine": scene.friction_combine,
        "restitution_combine": scene.restitution_combine,
        "bounds": scene.bounds,
        "out_of_bounds": scene.out_of_bounds,
        "camera": None if scene.camera is None else asdict(scene.camera),
        "looks": looks_to_data(scene.looks),
        "fields": [{"kind": type(field).__name__, **field.values()} for field in scene.force_fields],
        "bodies": bodies,
        "filtered_pairs": [list(pair) for pair in sorted(scene.filtered_pairs)],
        "pools": scene.pools,
        "joints": [{**asdict(entry), "kind": type(entry.joint).__name__} for entry in scene.joints],
    }


def scenes_from_data(data: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> list[Scene]:
    """Return the scenes that `scenes_to_data` was called with.

    Raises:
        ValueError, TypeError, KeyError: Data or arrays do not have that form.
    """
    shapes: list[Shape] = []
    for index, entry in enumerate(data["shapes"]):
        shape = _shape_from_data(index, entry, arrays, shapes)
        if shape.key != entry["key"]:
            raise ValueError(f"shape {index} is not the shape that was saved")
        shapes.append(shape)
    return [_scene_from_data(scene, shapes) for scene in data["scenes"]]


def _scene_from_data(data: dict[str, Any], shapes: list[Shape]) -> Scene:
    rules = {name: data[name] for name in ("friction_combine", "restitution_combine", "bounds", "out_of_bounds")}
    camera = data.get("camera")  # older files have none
    scene = Scene(data["gravity"], **rules, camera=None if camera is None else Camera(**camera))
    for field in data["fields"]:
        scene.add_force_field(FIELDS[field["kind"]](**{name: field[name] for name in field if name != "kind"}))
    for index, entry in enumerate(data["bodies"]):
        _add_body(scene, entry, shapes[whole_in(f"body {index} shape", entry["shape"], 0, len(shapes) - 1)])
    scene.looks = looks_from_data(data.get("looks", []), len(scene.bodies))
    for a, b in data["filtered_pairs"]:
        scene.filter_pair(a, b)
    for name, members in dict(data.get("pools", {})).items():  # older files have none
        scene.pools[name] = [whole_in(f"pool {name}", index, 0, len(scene.bodies) - 1) for index in members]
    for entry in data.get("joints", []):  # older files have none
        _add_joint(scene, entry)
    return scene


def _add_joint(scene: Scene, entry: dict[str, Any]) -> None:
    """Add a joint with all checks."""
    frames: dict[str, Any] = {name: JointFrame(**entry[name]) for name in ("frame_a", "frame_b")}
    rest = {
        name: entry[name] for name in ("name", "break_force", "break_torque", "collide", "armature") if name in entry
    }
    joint = JOINTS[entry["kind"]](**entry["joint"])
    index = scene.add_joint(joint, entry["body_a"], entry["body_b"], **frames, **rest)
    if entry["drive"] is not None:
        scene.add_drive(index, **entry["drive"])


def _add_body(scene: Scene, entry: dict[str, Any], shape: Shape) -> None:
    """Add a body with all checks, and keep its orientation unscaled, bit for bit."""
    motion = Motion[entry["motion"]]
    add = scene.add_body if motion == Motion.DYNAMIC else getattr(scene, f"add_{motion.name.lower()}")
    given = {name: entry[name] for name in ("position", "orientation", "name", "active")}
    # Older files have fewer coefficients, and no surfaces that run.
    given |= {name: entry[name] for name in COEFFICIENTS if name in entry}
    given |= {n: entry[n] for n in SURFACE_VELOCITIES if any(entry.get(n, ()))}
    if motion != Motion.STATIC:
        given |= {name: entry[name] for name in VELOCITIES}
    if motion == Motion.DYNAMIC:
        given["mass"] = entry["mass"]
    if "path" in entry:
        given = {name: given[name] for name in given if name not in ("position", "orientation", *VELOCITIES)}
        given["path"] = PosePath(**entry["path"])
    index = add(shape, **given)
    x, y, z, w = (float(number) for number in entry["orientation"])
    orientation = (x, y, z, w)
    if np.abs(np.subtract(orientation, unit_quaternion("orientation", orientation))).max() > 1e-12:
        raise ValueError(f"body {index}: orientation must have unit length, got {orientation}")
    scene.bodies[index] = replace(scene.bodies[index], orientation=orientation)


def _place_shape(shape: Shape, shapes: list, arrays: dict, places: dict[str, int]) -> int:
    """Index of a shape in the list, to which it is added if it is new; a compound comes after its children."""
    if shape.key in places:
        return places[shape.key]
    data, own = shape.to_data(lambda child: _place_shape(child, shapes, arrays, places))
    arrays |= {f"shape_{len(shapes)}_{name}": array for name, array in own.items()}
    places[shape.key] = len(shapes)
    shapes.append({"key": shape.key, "kind": shape.kind(), **data})
    return places[shape.key]


def _shape_from_data(
    index: int, entry: dict[str, Any], arrays: Mapping[str, np.ndarray], earlier: list[Shape]
) -> Shape:
    def array(name: str, dtype: Any, shape: tuple[int | None, ...]) -> np.ndarray:
        return shaped(arrays, f"shape_{index}_{name}", dtype, shape)

    return Shape.classes[entry["kind"]].from_data(entry, array, earlier)
