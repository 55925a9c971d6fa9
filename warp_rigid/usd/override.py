"""Animation of an imported stage as a layer over it: prims keep their names, places, materials and children."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom

from warp_rigid import rotations
from warp_rigid.runs.recording import Recording
from warp_rigid.usd.animation import VISIBILITY
from warp_rigid.usd.conventions import FROM_Y_UP, first_time, is_y_up, meters_per_unit, precise_quaternions, transform
from warp_rigid.usd.opening import open_stage
from warp_rigid.usd.prims import matrix_of
from warp_rigid.usd.specs import define, export_layer, set_attribute, set_operations


def write_override(recording: Recording, path: Path, row: int) -> None:
    """Write a layer that has the imported stage as its sublayer and animates the prims of its bodies.

    The samples are in the units, the up axis and the time codes of the stage, from its first time code on.

    Args:
        recording: of a scene from `import_usd`.
        path: output file, .usda, .usdc or .usd.
        row: row of the environment in the recording.

    Raises:
        ValueError: The scene was not imported, or the stage has no prim that can be animated.
        OSError: The file cannot be written.
    """
    scene = recording.scene
    report = scene.import_report if scene is not None else None
    if scene is None or report is None:
        raise ValueError("layout: override requires a scene that was imported from a USD file")
    source = Path(report.file).resolve()
    if source == path.resolve():
        raise ValueError(f"path: must not be the imported file itself, got {path}")
    stage = open_stage(source)
    paths = {at: body for at, body in report.prims.items() if stage.GetPrimAtPath(at)}
    if not paths:
        raise ValueError(f"layout: override requires bodies with prims of their own, {source} has only instances")
    start, rate = stage.GetStartTimeCode(), stage.GetTimeCodesPerSecond()
    times = start + np.arange(len(recording.position)) * (rate / recording.fps)
    cache = UsdGeom.XformCache(first_time(stage))
    root = stage.GetPrimAtPath(report.root or "/")
    to_scene = transform(meters_per_unit(stage) * (FROM_Y_UP if is_y_up(stage) else np.eye(3)))
    to_scene = to_scene @ np.linalg.inv(matrix_of(cache.GetLocalToWorldTransform(root)))
    layer = Sdf.Layer.CreateAnonymous(path.suffix)
    with Sdf.ChangeBlock():
        _copy_metadata(layer, stage, os.path.relpath(source, path.resolve().parent))
        layer.startTimeCode, layer.endTimeCode = float(times[0]), float(times[-1])
        for prim_path, body in paths.items():
            then = scene.bodies[body]
            first = _pose(then.position, then.orientation)
            poses = _pose(recording.position[:, row, body], recording.orientation[:, row, body])
            world = matrix_of(cache.GetLocalToWorldTransform(stage.GetPrimAtPath(prim_path)))
            before = np.linalg.inv(first) @ to_scene @ world
            _animate(layer, prim_path, times, np.linalg.inv(to_scene) @ poses @ before)
            active = recording.active[:, row, body]
            if not active.all():  # otherwise its visibility stays as it is
                shown = [VISIBILITY[int(now)] for now in active]
                prim = layer.GetPrimAtPath(prim_path)
                attribute = set_attribute(prim, "visibility", Sdf.ValueTypeNames.Token, shown[0])
                _write_samples(attribute, times, shown)
    export_layer(layer, path)


def _copy_metadata(layer: Sdf.Layer, stage: Usd.Stage, source: str) -> None:
    """Units, axis, rates and default prim of the stage, and the stage itself as the only sublayer."""
    layer.subLayerPaths.append(source if source.startswith(".") else f"./{source}")
    layer.pseudoRoot.SetInfo("upAxis", "Y" if is_y_up(stage) else "Z")
    layer.pseudoRoot.SetInfo("metersPerUnit", meters_per_unit(stage))
    layer.timeCodesPerSecond, layer.framesPerSecond = stage.GetTimeCodesPerSecond(), stage.GetFramesPerSecond()
    layer.defaultPrim = stage.GetRootLayer().defaultPrim


def _pose(position, orientation) -> np.ndarray:
    """Transforms (..., 4, 4) of poses."""
    return transform(rotations.matrix(precise_quaternions(orientation)), np.asarray(position))


def _animate(layer: Sdf.Layer, path: str, times: np.ndarray, matrices: np.ndarray) -> None:
    """Override the transform of a prim by samples in the world of the stage, and by the first as the default."""
    prim = define(layer, path, specifier=Sdf.SpecifierOver)
    values = [Gf.Matrix4d(matrix.T.tolist()) for matrix in matrices]
    first = Sdf.ValueTypeNames.Matrix4d, values[0]
    (attribute,) = set_operations(prim, {"transform:warp_rigid": first}, reset=True)
    _write_samples(attribute, times, values)


def _write_samples(attribute: Sdf.AttributeSpec, times: np.ndarray, values: list[Any]) -> None:
    for time, value in zip(times.tolist(), values, strict=True):
        attribute.layer.SetTimeSample(attribute.path, time, value)
