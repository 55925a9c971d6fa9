"""USD export: a recording as an animation that any USD viewer plays.

Bodies of one shape and environment are the instances of one PointInstancer, which keeps large
batches small and quick to load. Poses are in the environment's own coordinates; only the
environment's prim is moved, so that float32 stays exact and one environment can be taken out.
"""

import tempfile
from pathlib import Path

import numpy as np

from warp_rigid.appearance import (
    body_colors,
    bound_corners,
    continuous_signs,
    corner_normals,
    drawn_surfaces,
    environment_offsets,
    environment_spacing,
    rotation_matrices,
)
from warp_rigid.recording import Recording, Surface, is_moving

__all__ = ["export_usd"]

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
SHAPES = "/World/Shapes"


def export_usd(recording: Recording, path, envs=None) -> None:
    """Write a recording as USD: z up, metres, one time code a frame.

    Args:
        recording: what to write.
        path: ends in .usdc (compact), .usda (text), .usdz (one file to pass on) or .usd; folders
            are made.
        envs: numbers of the environments to write; None writes all that were recorded.

    Raises:
        ValueError: The path has another ending, or an environment was not recorded.
        OSError: The file cannot be written.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise ValueError(f"path: must end in one of {', '.join(SUFFIXES)}, got {path}")
    rows = recording.rows(envs)
    path.parent.mkdir(parents=True, exist_ok=True)
    stage = _animation(recording, rows)
    if path.suffix == ".usdz":
        _save_package(stage, path)
    else:
        _save(stage, path)


def _animation(recording: Recording, rows: np.ndarray):
    """The stage in memory."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory(".usdc")
    _set_metadata(stage, recording)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    # A class is not drawn by itself, so that only the instances are seen.
    stage.CreateClassPrim(SHAPES).SetTypeName("Scope")

    spacing = environment_spacing(recording)
    surfaces = drawn_surfaces(recording, len(rows), spacing)
    for index, surface in enumerate(surfaces):
        _define_mesh(stage, f"{SHAPES}/shape_{index}", surface, recording.time)

    orientation = continuous_signs(recording.orientation)
    colors = body_colors(recording.motion)
    groups = _groups(recording)
    for row, offset in zip(rows, environment_offsets(len(rows), spacing), strict=True):
        root = f"/World/env_{recording.envs[row]:04d}"
        env = UsdGeom.Xform.Define(stage, root)
        env.AddTranslateOp().Set(tuple(float(x) for x in offset))
        if recording.labels[row]:
            env.GetPrim().SetDisplayName(recording.labels[row])
        for name, bodies in groups.items():
            instancer = _define_instancer(stage, f"{root}/{name}", recording, bodies, colors)
            poses = recording.position[:, row, bodies], orientation[:, row, bodies]
            _set_poses(instancer, *poses, surfaces[recording.surface[bodies[0]]])
    return stage


def _set_metadata(stage, recording: Recording) -> None:
    from pxr import UsdGeom, UsdPhysics

    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    # Readers disagree on which of the two rates they play by.
    stage.SetFramesPerSecond(recording.fps)
    stage.SetTimeCodesPerSecond(recording.fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(recording.num_frames)


def _groups(recording: Recording) -> dict[str, np.ndarray]:
    """Bodies that share a surface, static ones apart from moving ones, by a prim's name."""
    from pxr import Tf

    groups = {}
    moving = is_moving(recording.motion)
    for index in range(len(recording.surfaces)):
        for moves in (False, True):
            bodies = np.flatnonzero((recording.surface == index) & (moving == moves))
            if len(bodies):
                name = Tf.MakeValidIdentifier(recording.names[bodies[0]])
                groups[name if name not in groups else f"{name}_{bodies[0]}"] = bodies
    return groups


def _define_mesh(stage, path: str, surface: Surface, times: np.ndarray) -> None:
    from pxr import UsdGeom, Vt

    mesh = UsdGeom.Mesh.Define(stage, path)
    vertices = surface.vertices_at(times[0])
    corners = bound_corners(
        np.concatenate([surface.vertices_at(time) for time in times]) if surface.moves else vertices
    )
    normals = corner_normals(vertices, surface.faces).reshape(-1, 3)
    counts = np.full(len(surface.faces), 3, dtype=np.int32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(surface.faces.reshape(-1)))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
    for frame, time in enumerate(times if surface.moves else ()):
        moved = surface.vertices_at(time)
        mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(moved), frame)
        turned = corner_normals(moved, surface.faces).reshape(-1, 3)
        mesh.GetNormalsAttr().Set(Vt.Vec3fArray.FromNumpy(turned), frame)
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners[[0, -1]].astype(np.float32)))
    # Open surfaces are seen from inside too.
    mesh.CreateDoubleSidedAttr(True)


def _define_instancer(stage, path: str, recording: Recording, bodies: np.ndarray, colors):
    """A PointInstancer with everything but poses; its ids are the bodies' indices."""
    from pxr import Sdf, UsdGeom, Vt

    instancer = UsdGeom.PointInstancer.Define(stage, path)
    UsdGeom.Scope.Define(stage, f"{path}/Prototypes")
    prototype = UsdGeom.Mesh.Define(stage, f"{path}/Prototypes/shape").GetPrim()
    shape = f"{SHAPES}/shape_{recording.surface[bodies[0]]}"
    prototype.GetReferences().AddInternalReference(shape)
    instancer.CreatePrototypesRel().AddTarget(prototype.GetPath())
    instancer.CreateProtoIndicesAttr(Vt.IntArray.FromNumpy(np.zeros(len(bodies), dtype=np.int32)))
    instancer.CreateIdsAttr(Vt.Int64Array.FromNumpy(bodies.astype(np.int64)))
    color = UsdGeom.PrimvarsAPI(instancer).CreatePrimvar(
        "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex
    )
    color.Set(Vt.Vec3fArray.FromNumpy(colors[bodies]))
    return instancer


def _set_poses(instancer, position, orientation, surface: Surface) -> None:
    """Poses (frames, bodies, 3) and (frames, bodies, 4) as default values and time samples.

    Readers that look at the stage without a time, physics parsers among them, see only default
    values; without them all bodies would lie at the origin.
    """
    from pxr import Vt

    attributes = (
        instancer.CreatePositionsAttr(),
        instancer.CreateOrientationsfAttr(),
        instancer.CreateExtentAttr(),
    )
    still = (position == position[0]).all() and (orientation == orientation[0]).all()
    corners = bound_corners(surface.vertices)
    for frame in range(1 if still else len(position)):
        reach = _reach(position[frame], orientation[frame], corners)
        values = (
            Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(position[frame])),
            Vt.QuatfArray.FromNumpy(np.ascontiguousarray(orientation[frame])),
            Vt.Vec3fArray.FromNumpy(reach),
        )
        for attribute, value in zip(attributes, values, strict=True):
            if frame == 0:
                attribute.Set(value)
            if not still:
                attribute.Set(value, frame)


def _reach(position: np.ndarray, orientation: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Box around all instances of a shape whose own box has these corners, (2, 3) float32 [m]."""
    center, half = (corners[-1] + corners[0]) / 2.0, (corners[-1] - corners[0]) / 2.0
    rotation = rotation_matrices(orientation)
    middle, half = position + rotation @ center, np.abs(rotation) @ half
    return np.array([(middle - half).min(axis=0), (middle + half).max(axis=0)], dtype=np.float32)


def _save(stage, path: Path) -> None:
    from pxr import Tf

    try:
        written = stage.GetRootLayer().Export(str(path))
    except Tf.ErrorException:
        written = False
    if not written:
        raise OSError(f"{path}: cannot be written")


def _save_package(stage, path: Path) -> None:
    from pxr import UsdUtils

    with tempfile.TemporaryDirectory() as folder:
        inner = Path(folder) / f"{path.stem}.usdc"
        _save(stage, inner)
        if not UsdUtils.CreateNewUsdzPackage(str(inner), str(path)):
            raise OSError(f"{path}: cannot be written")
