"""Film: what is to be drawn, frame by frame, read from a recording or from a USD file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warp_rigid.appearance import (
    body_colors,
    corner_normals,
    drawn_surface,
    environment_offsets,
    environment_spacing,
)
from warp_rigid.recording import Recording

__all__ = ["DrawnMesh", "Film", "film_from_recording", "film_from_usd"]


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """Triangles with normals, in the shape's frame.

    Attributes:
        vertices: (n, 3) float32 [m].
        faces: (m, 3) int32.
        normals: (m, 3, 3) float32, one for each corner of each triangle.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray

    @property
    def flat(self) -> bool:
        """All in one plane: a ground, which is drawn with a grid and does not guide the camera."""
        return bool(np.ptp(self.normals.reshape(-1, 3), axis=0).max() < 1e-6)


@dataclass(frozen=True, eq=False)
class Film:
    """Instances of meshes, moving in one world.

    Attributes:
        meshes: the different meshes.
        mesh: (instances,) index into meshes.
        color: (instances, 3) float32, linear light.
        position: (frames, instances, 3) float32 [m].
        orientation: (frames, instances, 4) float32, unit quaternions (x, y, z, w).
        fps: frames per simulated second.
        labels: texts that tell environments apart, and (3,) where each of those stands [m].
    """

    meshes: tuple[DrawnMesh, ...]
    mesh: np.ndarray
    color: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    fps: float
    labels: tuple[tuple[str, np.ndarray], ...] = ()

    @property
    def num_frames(self) -> int:
        """Number of frames, the first included."""
        return len(self.position)

    @property
    def moving(self) -> np.ndarray:
        """(instances,) True where a pose changes in the course of the film."""
        moves = (self.position != self.position[0]).any(axis=(0, 2))
        return moves | (self.orientation != self.orientation[0]).any(axis=(0, 2))


def film_from_recording(recording: Recording, envs=None) -> Film:
    """The environments of a recording side by side, as export_usd lays them out.

    Raises:
        ValueError: One of the environments was not recorded.
    """
    rows = recording.rows(envs)
    spacing = environment_spacing(recording)
    surfaces = recording.surfaces
    if len(rows) > 1:
        surfaces = [drawn_surface(surface, spacing) for surface in surfaces]
    offsets = environment_offsets(len(rows), spacing).astype(np.float32)
    frames, count = len(recording.time), len(rows) * len(recording.surface)
    return Film(
        meshes=tuple(
            DrawnMesh(s.vertices, s.faces, corner_normals(s.vertices, s.faces)) for s in surfaces
        ),
        mesh=np.tile(recording.surface, len(rows)),
        color=np.tile(body_colors(recording.motion), (len(rows), 1)),
        position=(recording.position[:, rows] + offsets[:, None]).reshape(frames, count, 3),
        orientation=recording.orientation[:, rows].reshape(frames, count, 4),
        fps=recording.fps,
        labels=tuple(
            (recording.labels[row], offset)
            for row, offset in zip(rows, offsets, strict=True)
            if recording.labels[row]
        ),
    )


def film_from_usd(path) -> Film:
    """Read the instances and meshes of a file that export_usd wrote, from the file alone.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no USD file, or one without instances.
    """
    from pxr import Tf, Usd, UsdGeom

    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise ValueError(f"{path}: not a readable USD file") from error
    instancers = [
        UsdGeom.PointInstancer(prim)
        for prim in stage.Traverse()
        if prim.IsA(UsdGeom.PointInstancer)
    ]
    if not instancers:
        raise ValueError(f"{path}: holds no PointInstancer; only films of export_usd can be drawn")

    frames = np.arange(stage.GetStartTimeCode(), stage.GetEndTimeCode() + 1)
    cache = UsdGeom.XformCache()
    meshes, mesh_index, mesh, color, position, orientation = [], {}, [], [], [], []
    for instancer in instancers:
        drawn, key = _read_prototype(stage, instancer)
        if key not in mesh_index:
            mesh_index[key] = len(meshes)
            meshes.append(drawn)
        offset = cache.GetLocalToWorldTransform(instancer.GetPrim()).ExtractTranslation()
        poses = _read(instancer.GetPositionsAttr(), frames)
        position.append(poses + np.array(offset, dtype=np.float32))
        orientation.append(_read(instancer.GetOrientationsfAttr(), frames))
        color.append(np.array(UsdGeom.PrimvarsAPI(instancer).GetPrimvar("displayColor").Get()))
        mesh.append(np.full(poses.shape[1], mesh_index[key]))
    return Film(
        meshes=tuple(meshes),
        mesh=np.concatenate(mesh),
        color=np.concatenate(color),
        position=np.concatenate(position, axis=1),
        orientation=np.concatenate(orientation, axis=1),
        fps=stage.GetFramesPerSecond(),
        labels=_read_labels(stage),
    )


def _read_prototype(stage, instancer) -> tuple[DrawnMesh, bytes]:
    """An instancer's only mesh, and a key that is equal for equal meshes."""
    from pxr import UsdGeom

    path = instancer.GetPrototypesRel().GetTargets()[0]
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    vertices = np.array(mesh.GetPointsAttr().Get(), dtype=np.float32)
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get(), dtype=np.int32).reshape(-1, 3)
    normals = np.array(mesh.GetNormalsAttr().Get(), dtype=np.float32).reshape(-1, 3, 3)
    return DrawnMesh(vertices, faces, normals), vertices.tobytes() + faces.tobytes()


def _read_labels(stage) -> tuple[tuple[str, np.ndarray], ...]:
    """Display names of the environments, and where they stand."""
    from pxr import UsdGeom

    cache = UsdGeom.XformCache()
    return tuple(
        (prim.GetDisplayName(), np.array(cache.GetLocalToWorldTransform(prim).ExtractTranslation()))
        for prim in stage.GetDefaultPrim().GetChildren()
        if prim.GetDisplayName()
    )


def _read(attribute, frames) -> np.ndarray:
    """An attribute's arrays at some time codes; one that never changes is read once."""
    if attribute.GetNumTimeSamples() == 0:
        value = np.array(attribute.Get())
        return np.broadcast_to(value, (len(frames), *value.shape))
    return np.stack([np.array(attribute.Get(frame)) for frame in frames])
