"""Writing prims and attributes directly to a layer.

A stage recomposes after every change, which is about a hundred times slower.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pxr import Sdf, Tf, Vt

from warp_rigid.files.atomic import atomic_file
from warp_rigid.runs.recording import Frame, Recording


def open_layer(path: Path) -> Sdf.Layer:
    """Create an empty layer for a path; a layer already open for that path is cleared."""
    layer = Sdf.Layer.Find(str(path))
    if layer is not None:
        layer.Clear()
        return layer
    path.parent.mkdir(parents=True, exist_ok=True)
    return Sdf.Layer.CreateNew(str(path))


def export_layer(layer: Sdf.Layer, path: Path) -> None:
    """Write a copy of a layer, which replaces a file atomically.

    Raises:
        OSError: The file cannot be written.
    """
    with atomic_file(path) as temporary:
        try:
            written = layer.Export(str(temporary))
        except Tf.ErrorException:
            written = False
        if not written:
            raise OSError(f"{temporary}: cannot be written")
    reload_layer(path)


def reload_layer(path: Path) -> None:
    """Read a file that was replaced again, if it is open in this process."""
    layer = Sdf.Layer.Find(str(path))
    if layer is not None:
        layer.Reload(force=True)


def stage_metadata(layer: Sdf.Layer, default_prim: str, fps: float) -> None:
    """Write the stage metadata: z up, metres, kilograms, one time code per frame."""
    for name, value in (("upAxis", "Z"), ("metersPerUnit", 1.0), ("kilogramsPerUnit", 1.0)):
        layer.pseudoRoot.SetInfo(name, value)
    layer.defaultPrim = default_prim
    layer.framesPerSecond = layer.timeCodesPerSecond = fps  # readers differ in which of the two rates they use
    layer.startTimeCode = layer.endTimeCode = 0.0


def define(
    layer: Sdf.Layer,
    path: str,
    type_name: str = "",
    apis: Iterable[str] = (),
    specifier: Sdf.Specifier = Sdf.SpecifierDef,
) -> Sdf.PrimSpec:
    """Define a prim with its type and applied schemas."""
    prim = Sdf.CreatePrimInLayer(layer, path)
    prim.specifier = specifier
    prim.typeName = type_name
    applied = list(apis)
    if applied:
        prim.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=applied))
    return prim


def set_attribute(
    prim: Sdf.PrimSpec,
    name: str,
    type_name: Sdf.ValueTypeName,
    value: Any = None,
    *,
    uniform: bool = False,
    interpolation: str = "",
) -> Sdf.AttributeSpec:
    """Set the default value of an attribute; creates the attribute if needed."""
    attribute = prim.layer.GetAttributeAtPath(prim.path.AppendProperty(name))
    if attribute is None:
        variability = Sdf.VariabilityUniform if uniform else Sdf.VariabilityVarying
        attribute = Sdf.AttributeSpec(prim, name, type_name, variability)
    if value is not None:
        attribute.default = value
    if interpolation:
        attribute.SetInfo("interpolation", interpolation)
    return attribute


def set_operations(
    prim: Sdf.PrimSpec, operations: dict[str, tuple[Sdf.ValueTypeName, Any]], *, reset: bool = False
) -> list[Sdf.AttributeSpec]:
    """Set the operations of a prim's transform, types and values by their names; returns their attributes.

    With `reset` the prim ignores the transforms above it.
    """
    made = [set_attribute(prim, f"xformOp:{name}", *value) for name, value in operations.items()]
    order = ["!resetXformStack!"] if reset else []
    order += [attribute.name for attribute in made]
    set_attribute(prim, "xformOpOrder", Sdf.ValueTypeNames.TokenArray, Vt.TokenArray(order), uniform=True)
    return made


def vec3f(values: Any) -> Vt.Vec3fArray:
    """Vectors (n, 3) as an array of USD in single precision."""
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


def set_relationship(prim: Sdf.PrimSpec, name: str, *targets: Any) -> None:
    """Create a relationship with its targets."""
    relationship = Sdf.RelationshipSpec(prim, name, custom=False)
    relationship.targetPathList.explicitItems = [Sdf.Path(str(target)) for target in targets]


@dataclass(slots=True, eq=False)
class Track:
    """One attribute over time.

    Attributes:
        path: path of the attribute.
        type_name: type of its values.
        value: latest value.
        written: time code of the latest sample; None before the first.
    """

    path: Sdf.Path
    type_name: Sdf.ValueTypeName
    value: Any
    written: float | None = None


class SampleWriter:
    """Writes changing attribute values to a layer; constant values are not repeated.

    Readers interpolate between samples. Before a change after constant frames, the old value is therefore written
    once more, one frame earlier.

    Args:
        layer: layer of the samples.
    """

    def __init__(self, layer: Sdf.Layer):
        """Start without tracks."""
        self.layer = layer
        self.tracks: list[Track] = []

    def track(self, attribute: Sdf.AttributeSpec) -> Track:
        """Track an attribute whose default value is that of the first frame."""
        made = Track(attribute.path, attribute.typeName, attribute.default)
        self.tracks.append(made)
        return made

    def put(self, tracks: Iterable[Track], time: float, values: Iterable[Any]) -> None:
        """Write the values of some tracks in a frame, one per track, where they change; one frame is one time code."""
        write, before = self.layer.SetTimeSample, time - 1.0
        for track, value in zip(tracks, values, strict=True):
            if value == track.value:
                continue
            if track.written != before:
                write(track.path, before, track.value)
            write(track.path, time, value)
            track.value, track.written = value, time

    def switch_layer(self, layer: Sdf.Layer, time: float, first: bool) -> None:
        """Continue in another layer; both layers hold all values at the time of the switch."""
        for track in self.tracks:
            if not first and track.written != time:
                self.layer.SetTimeSample(track.path, time, track.value)
            Sdf.JustCreatePrimAttributeInLayer(layer, track.path, track.type_name)
            layer.SetTimeSample(track.path, time, track.value)
            track.written = time
        self.layer = layer


class WrittenEnv(NamedTuple):
    """An environment of a recording that is written.

    Attributes:
        samples: writer for the frames after the first one; the prims are defined in its layer.
        root: path of the environment's prim.
        film: recording with the constant data.
        row: row of the environment in the recording.
        frame: the first frame, whose values are the default values.
    """

    samples: SampleWriter
    root: str
    film: Recording
    row: int
    frame: Frame
