"""Film: what is to be drawn, frame by frame, read from a recording or from a USD file."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warp_rigid.appearance import (
    COLORINGS,
    body_colors,
    corner_normals,
    drawn_surfaces,
    environment_offsets,
    environment_spacing,
    level_colors,
    speed_colors,
)
from warp_rigid.checks import one_of
from warp_rigid.recording import Recording, Surface
from warp_rigid.scene import Motion

__all__ = ["DrawnMesh", "Film", "colored", "film_from_recording", "film_from_usd"]


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """Triangles with normals, in the shape's frame.

    Attributes:
        vertices: (n, 3) float32 [m].
        faces: (m, 3) int32.
        normals: (m, 3, 3) float32, one for each corner of each triangle.
        frames: the vertices in each frame of the film, where they change; else nothing.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    frames: tuple[np.ndarray, ...] = ()

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
        color: (instances, 3) float32, linear light; or (frames, instances, 3) where colours change.
        position: (frames, instances, 3) float32 [m].
        orientation: (frames, instances, 4) float32, unit quaternions (x, y, z, w).
        fps: frames per simulated second.
        env: (instances,) index of the environment.
        offset: (envs, 3) where the environments stand [m].
        labels: a text for each environment; empty where nothing tells it apart.
    """

    meshes: tuple[DrawnMesh, ...]
    mesh: np.ndarray
    color: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    fps: float
    env: np.ndarray
    offset: np.ndarray
    labels: tuple[str, ...]

    @property
    def num_frames(self) -> int:
        """Number of frames, the first included."""
        return len(self.position)

    @property
    def moving(self) -> np.ndarray:
        """(instances,) True where a pose changes in the course of the film."""
        moves = (self.position != self.position[0]).any(axis=(0, 2))
        return moves | (self.orientation != self.orientation[0]).any(axis=(0, 2))

    def color_at(self, frame: int) -> np.ndarray:
        """Colours in one frame, (instances, 3)."""
        return self.color if self.color.ndim == 2 else self.color[frame]

    def alone(self, env: int) -> "Film":
        """One environment by its index, brought back to the origin."""
        kept = self.env == env
        return replace(
            self,
            mesh=self.mesh[kept],
            color=self.color[..., kept, :],
            position=self.position[:, kept] - self.offset[env].astype(np.float32),
            orientation=self.orientation[:, kept],
            env=np.zeros(np.count_nonzero(kept), dtype=np.int64),
            offset=np.zeros((1, 3)),
            labels=(self.labels[env],),
        )


def film_from_recording(recording: Recording, envs=None) -> Film:
    """The environments of a recording side by side, as export_usd lays them out.

    Raises:
        ValueError: One of the environments was not recorded.
    """
    rows = recording.rows(envs)
    spacing = environment_spacing(recording)
    surfaces = drawn_surfaces(recording, len(rows), spacing)
    offsets = environment_offsets(len(rows), spacing).astype(np.float32)
    frames, count = len(recording.time), len(rows) * len(recording.surface)
    return Film(
        meshes=tuple(_drawn(surface, recording.time) for surface in surfaces),
        mesh=np.tile(recording.surface, len(rows)),
        color=np.tile(body_colors(recording.motion), (len(rows), 1)),
        position=(recording.position[:, rows] + offsets[:, None]).reshape(frames, count, 3),
        orientation=recording.orientation[:, rows].reshape(frames, count, 4),
        fps=recording.fps,
        env=np.repeat(np.arange(len(rows)), len(recording.surface)),
        offset=offsets,
        labels=tuple(recording.labels[row] for row in rows),
    )


def colored(film: Film, recording: Recording, by: str) -> Film:
    """A film in which the colours of the dynamic bodies tell something.

    Args:
        film: of all environments of the recording, made by film_from_recording.
        recording: what it was made from.
        by: "level" in the contact graph, "speed", or "body", which changes nothing.
    """
    one_of("by", by, COLORINGS)
    if by == "body":
        return film
    if by == "level":
        told = level_colors(recording.level.reshape(film.num_frames, -1))
    else:
        path = film.position.astype(np.float64)
        velocity = np.gradient(path, 1.0 / film.fps, axis=0) if film.num_frames > 1 else np.zeros_like(path)
        told = speed_colors(np.linalg.norm(velocity, axis=-1))
    dynamic = np.tile(recording.motion == Motion.DYNAMIC, len(recording.envs))
    return replace(film, color=np.where(dynamic[:, None], told, film.color))


def _drawn(surface: Surface, times: np.ndarray) -> DrawnMesh:
    """A surface as it is drawn, frame by frame if it changes its shape."""
    vertices = surface.vertices_at(times[0])
    frames = tuple(surface.vertices_at(time) for time in times) if surface.moves else ()
    return DrawnMesh(vertices, surface.faces, corner_normals(vertices, surface.faces), frames)


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
    root = stage.GetDefaultPrim()
    envs = [prim for prim in root.GetChildren() if prim.IsA(UsdGeom.Xform)] if root else []
    instancers = [
        (index, UsdGeom.PointInstancer(prim))
        for index, env in enumerate(envs)
        for prim in env.GetChildren()
        if prim.IsA(UsdGeom.PointInstancer)
    ]
    if not instancers:
        raise ValueError(f"{path}: holds no environment with instances, as export_usd writes them")

    frames = np.arange(stage.GetStartTimeCode(), stage.GetEndTimeCode() + 1)
    offset = np.array([_translation(prim) for prim in envs])
    meshes, mesh_index, mesh, color, position, orientation, env = [], {}, [], [], [], [], []
    for index, instancer in instancers:
        drawn, key = _read_prototype(stage, instancer, frames)
        if key not in mesh_index:
            mesh_index[key] = len(meshes)
            meshes.append(drawn)
        poses = _read(instancer.GetPositionsAttr(), frames)
        position.append(poses + offset[index].astype(np.float32))
        orientation.append(_read(instancer.GetOrientationsfAttr(), frames))
        color.append(np.array(UsdGeom.PrimvarsAPI(instancer).GetPrimvar("displayColor").Get()))
        mesh.append(np.full(poses.shape[1], mesh_index[key]))
        env.append(np.full(poses.shape[1], index))
    return Film(
        meshes=tuple(meshes),
        mesh=np.concatenate(mesh),
        color=np.concatenate(color),
        position=np.concatenate(position, axis=1),
        orientation=np.concatenate(orientation, axis=1),
        fps=stage.GetFramesPerSecond(),
        env=np.concatenate(env),
        offset=offset,
        labels=tuple(prim.GetDisplayName() for prim in envs),
    )


def _read_prototype(stage, instancer, frames) -> tuple[DrawnMesh, bytes]:
    """An instancer's only mesh, and a key that is equal for equal meshes."""
    from pxr import UsdGeom

    path = instancer.GetPrototypesRel().GetTargets()[0]
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    points = mesh.GetPointsAttr()
    vertices = np.array(points.Get(), dtype=np.float32)
    moving = tuple(_read(points, frames)) if points.GetNumTimeSamples() else ()
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get(), dtype=np.int32).reshape(-1, 3)
    normals = np.array(mesh.GetNormalsAttr().Get(), dtype=np.float32).reshape(-1, 3, 3)
    return DrawnMesh(vertices, faces, normals, moving), vertices.tobytes() + faces.tobytes()


def _translation(prim) -> np.ndarray:
    from pxr import UsdGeom

    matrix = UsdGeom.XformCache().GetLocalToWorldTransform(prim)
    return np.array(matrix.ExtractTranslation())


def _read(attribute, frames) -> np.ndarray:
    """An attribute's arrays at some time codes; one that never changes is read once."""
    if attribute.GetNumTimeSamples() == 0:
        value = np.array(attribute.Get())
        return np.broadcast_to(value, (len(frames), *value.shape))
    return np.stack([np.array(attribute.Get(frame)) for frame in frames])
