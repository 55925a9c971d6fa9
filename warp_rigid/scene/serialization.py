"""A Scene as plain data and arrays, and back, to the same bits."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from warp_rigid.checks import unit_quaternion, whole_in
from warp_rigid.files.archive import shaped
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.fields import FIELDS
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import (
    Box,
    Capsule,
    Compound,
    Cylinder,
    HarmonicMotion,
    Heightfield,
    Mesh,
    Plane,
    Shape,
    Sphere,
)

NUMBERS: dict[str, tuple[type[Shape], tuple[str, ...]]] = {
    "sphere": (Sphere, ("radius",)),
    "box": (Box, ("half_extents",)),
    "capsule": (Capsule, ("radius", "half_height")),
    "cylinder": (Cylinder, ("radius", "half_height")),
    "plane": (Plane, ("normal", "offset")),
}
"""Shapes that are given by a few numbers, and the attributes that hold them."""

VELOCITIES = ("linear_velocity", "angular_velocity")


def scene_to_data(scene: Scene) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return plain data for JSON, and arrays by name.

    Raises:
        ValueError: A shape has an unknown kind.
    """
    arrays: dict[str, np.ndarray] = {}
    shapes: list[dict[str, Any]] = []
    places: dict[str, int] = {}
    bodies = []
    for body in scene.bodies:
        numbers = {
            name: getattr(body, name)
            for name in ("position", "orientation", *VELOCITIES, "mass", "active", *COEFFICIENTS)
        }
        shape = _place_shape(body.shape, shapes, arrays, places)
        bodies.append({"shape": shape, "motion": body.motion.name, "name": body.name, **numbers})
    data = {
        "gravity": scene.gravity,
        "friction_combine": scene.friction_combine,
        "restitution_combine": scene.restitution_combine,
        "bounds": scene.bounds,
        "out_of_bounds": scene.out_of_bounds,
        "fields": [{"kind": type(field).__name__, **field.values()} for field in scene.force_fields],
        "shapes": shapes,
        "bodies": bodies,
        "filtered_pairs": [list(pair) for pair in sorted(scene.filtered_pairs)],
    }
    return data, arrays


def scene_from_data(data: dict[str, Any], arrays: dict[str, np.ndarray]) -> Scene:
    """Return the scene that `scene_to_data` was called with.

    Raises:
        ValueError, TypeError, KeyError: Data or arrays do not have that form.
    """
    rules = {name: data[name] for name in ("friction_combine", "restitution_combine", "bounds", "out_of_bounds")}
    scene = Scene(data["gravity"], **rules)
    for field in data["fields"]:
        scene.add_force_field(FIELDS[field["kind"]](**{name: field[name] for name in field if name != "kind"}))
    shapes: list[Shape] = []
    for index, entry in enumerate(data["shapes"]):
        shape = _shape_from_data(index, entry, arrays, shapes)
        if shape.key != entry["key"]:
            raise ValueError(f"shape {index} is not the one that was saved")
        shapes.append(shape)
    for index, entry in enumerate(data["bodies"]):
        _add_body(scene, entry, shapes[whole_in(f"body {index} shape", entry["shape"], 0, len(shapes) - 1)])
    for a, b in data["filtered_pairs"]:
        scene.filter_pair(a, b)
    return scene


def _add_body(scene: Scene, entry: dict[str, Any], shape: Shape) -> None:
    """Add a body with all checks, and keep its orientation to the last bit, unscaled."""
    add: Callable[..., int] = {
        Motion.DYNAMIC: scene.add_body, Motion.KINEMATIC: scene.add_kinematic, Motion.STATIC: scene.add_static,
    }[Motion[entry["motion"]]]  # fmt: skip
    given = {name: entry[name] for name in ("position", "orientation", "name", "active")}
    given |= {name: entry[name] for name in COEFFICIENTS if name in entry}  # older files have fewer
    if entry["motion"] != Motion.STATIC.name:
        given |= {name: entry[name] for name in VELOCITIES}
    if entry["motion"] == Motion.DYNAMIC.name:
        given["mass"] = entry["mass"]
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
    entry: dict[str, Any] = {"key": shape.key}
    if isinstance(shape, Compound):
        entry["kind"] = "compound"
        entry["children"] = [
            [_place_shape(child, shapes, arrays, places), position.tolist(), orientation]
            for child, position, orientation in shape.children
        ]
    elif isinstance(shape, Mesh):
        entry |= {"kind": "mesh", "sdf_resolution": shape.sdf_resolution, "repairs": shape.repairs}
        for name, array in (("vertices", shape.vertices), ("faces", shape.faces), ("distances", shape.grid.values)):
            arrays[f"shape_{len(shapes)}_{name}"] = array
    elif isinstance(shape, Heightfield):
        entry |= {"kind": "heightfield", "size": shape.extent.tolist()}
        arrays[f"shape_{len(shapes)}_heights"] = shape.heights
        if shape.moving:
            entry["angular_frequency"] = shape.angular_frequency
            arrays[f"shape_{len(shapes)}_amplitude"] = shape.amplitude
            arrays[f"shape_{len(shapes)}_phase"] = shape.phase
    else:
        entry |= _numbers_of(shape)
    places[shape.key] = len(shapes)
    shapes.append(entry)
    return places[shape.key]


def _numbers_of(shape: Shape) -> dict[str, Any]:
    for kind, (cls, names) in NUMBERS.items():
        if type(shape) is cls:
            return {"kind": kind} | {name: np.asarray(getattr(shape, name)).tolist() for name in names}
    raise ValueError(f"shape: a {type(shape).__name__} cannot be saved")


def _shape_from_data(index: int, entry: dict[str, Any], arrays: dict[str, np.ndarray], earlier: list[Shape]) -> Shape:
    kind, name = entry["kind"], f"shape_{index}"
    if kind == "compound":
        last = len(earlier) - 1
        children = [
            (earlier[whole_in(f"{name} child", child, 0, last)], position, orientation)
            for child, position, orientation in entry["children"]
        ]
        return Compound(children)
    if kind == "mesh":
        vertices = shaped(arrays, f"{name}_vertices", np.float64, (None, 3))
        faces = shaped(arrays, f"{name}_faces", np.int32, (None, 3))
        distances = shaped(arrays, f"{name}_distances", np.float32, (None, None, None))
        return Mesh.restored(vertices, faces, entry["sdf_resolution"], entry["repairs"], distances)
    if kind == "heightfield":
        heights = shaped(arrays, f"{name}_heights", np.float64, (None, None))
        motion = None
        if "angular_frequency" in entry:
            parts = (shaped(arrays, f"{name}_{part}", np.float64, heights.shape) for part in ("amplitude", "phase"))
            amplitude, phase = parts
            motion = HarmonicMotion(amplitude, entry["angular_frequency"], phase)
        return Heightfield(heights, entry["size"], motion)
    cls, names = NUMBERS[kind]
    return cls(**{part: entry[part] for part in names})
