"""Film: drawable data of all frames, created from a recording or a USD file."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.checks import one_of
from warp_rigid.files.mesh_files import joined
from warp_rigid.files.polygons import Triangles
from warp_rigid.render.appearance import (
    COLORINGS,
    body_colors,
    body_gloss,
    corner_normals,
    drawn_looks,
    drawn_surfaces,
    environment_offsets,
    frame_colors,
    spread_of,
)
from warp_rigid.rotations import rotate
from warp_rigid.runs.drawn_surface import DrawnSurface
from warp_rigid.runs.recording import Recording
from warp_rigid.scene.camera import Camera, camera_of_text
from warp_rigid.scene.scene import Motion

INSTANCE_AXES = {
    "mesh": 0, "color": -2, "position": 1, "orientation": 1, "present": 1,
    "env": 0, "body": 0, "motion": 0, "gloss": 0, "image": 0,
}  # fmt: skip
"""The arrays of a Film with an entry for each instance, and their axis of instances."""


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """Triangles with normals, in the shape's frame.

    Attributes:
        vertices: (n, 3) float32 [m].
        faces: (m, 3) int32.
        normals: (m, 3, 3) float32, one per corner of each triangle.
        frames: vertices of each frame if they change, else empty.
        uv: (m, 3, 2) float32, texture coordinates of the corners, NaN where a part has none; None without.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    frames: tuple[np.ndarray, ...] = ()
    uv: np.ndarray | None = None

    @property
    def flat(self) -> bool:
        """Whether all triangles are parallel: a ground, drawn with a grid and ignored by the camera fit."""
        return bool(np.ptp(self.normals.reshape(-1, 3), axis=0).max() < 1e-6)


@dataclass(frozen=True, eq=False)
class Film:
    """Moving instances of meshes in a common world frame.

    Attributes:
        meshes: the distinct meshes.
        mesh: (instances,) index into meshes.
        color: (instances, 3) float32, linear RGB; or (frames, instances, 3) if colours change.
        position: (frames, instances, 3) float32 [m].
        orientation: (frames, instances, 4) float32, unit quaternions (x, y, z, w).
        present: (frames, instances) bool; others are not drawn.
        fps: frames per simulated second.
        env: (instances,) index of the environment.
        offset: (envs, 3) translation of the environments [m].
        labels: one label per environment; may be empty.
        body: (instances,) index of the body in its environment; -1 for what is no body.
        motion: (instances,) value of Motion.
        gloss: (instances, 2) float32, roughness and metallic as in Look; (1, 0) is matt.
        image: (instances,) index into images; -1 for instances of one colour.
        camera: where pictures are taken from; a body that it follows is given by its index.
        images: paths of the images of textures.
    """

    meshes: tuple[DrawnMesh, ...]
    mesh: np.ndarray
    color: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    present: np.ndarray
    fps: float
    env: np.ndarray
    offset: np.ndarray
    labels: tuple[str, ...]
    body: np.ndarray
    motion: np.ndarray
    gloss: np.ndarray
    image: np.ndarray
    camera: Camera = field(default_factory=Camera)
    images: tuple[str, ...] = ()

    @property
    def num_frames(self) -> int:
        """Number of frames, including the initial one."""
        return len(self.position)

    @property
    def dynamic(self) -> np.ndarray:
        """(instances,) True for dynamic bodies."""
        return self.motion == Motion.DYNAMIC

    @property
    def moving(self) -> np.ndarray:
        """(instances,) True if the pose changes over time."""
        moves = (self.position != self.position[0]).any(axis=(0, 2))
        return moves | (self.orientation != self.orientation[0]).any(axis=(0, 2))

    @property
    def flat(self) -> np.ndarray:
        """(instances,) True for those whose triangles are all parallel."""
        return np.array([mesh.flat for mesh in self.meshes])[self.mesh]

    @property
    def level(self) -> np.ndarray:
        """(instances,) True for planes that lie level and fixed all the time, which are drawn as one endless ground."""
        normals = np.array([mesh.normals[0, 0] for mesh in self.meshes])[self.mesh]
        still = self.present.all(axis=0) & ~self.moving
        return self.flat & still & (rotate(self.orientation[0], normals)[:, 2] > 1.0 - 1.0e-6)

    def color_at(self, frame: int) -> np.ndarray:
        """Colours of one frame, (instances, 3)."""
        return self.color if self.color.ndim == 2 else self.color[frame]

    def alone(self, env: int) -> "Film":
        """A film of one environment, translated back to the origin."""
        kept = np.flatnonzero(self.env == env)
        own = {name: getattr(self, name).take(kept, axis) for name, axis in INSTANCE_AXES.items()}
        own["position"] = own["position"] - self.offset[env].astype(np.float32)
        own["env"] = np.zeros_like(kept)
        return replace(self, **own, offset=np.zeros((1, 3)), labels=(self.labels[env],))


def concatenated(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """The arrays of instances that the last part of a film has, by the names of INSTANCE_AXES, of all parts as one."""
    return {name: np.concatenate([part[name] for part in parts], INSTANCE_AXES[name]) for name in parts[-1]}


def film_from_recording(recording: Recording) -> Film:
    """Create a film of the environments of a recording, arranged as by export_usd."""
    envs, bodies, frames = len(recording.envs), len(recording.surface), len(recording.time)
    spread = spread_of(recording)
    surfaces = drawn_surfaces(recording, envs, spread)
    offsets = environment_offsets(envs, spread.spacing()).astype(np.float32)
    meshes, mesh = _meshes(recording, surfaces)
    looks = drawn_looks(recording)
    images, image = _numbered([looks[body].image if body in looks else None for body in range(bodies)])
    return Film(
        meshes=meshes,
        mesh=mesh.reshape(-1),
        color=np.tile(body_colors(recording.motion, recording.looks), (envs, 1)),
        position=(recording.position + offsets[:, None]).reshape(frames, envs * bodies, 3),
        orientation=recording.orientation.reshape(frames, envs * bodies, 4),
        present=recording.active.reshape(frames, envs * bodies),
        fps=recording.fps,
        env=np.repeat(np.arange(envs), bodies),
        offset=offsets,
        labels=recording.labels,
        body=np.tile(np.arange(bodies), envs),
        motion=np.tile(recording.motion, envs),
        gloss=np.tile(body_gloss(bodies, recording.looks), (envs, 1)),
        image=np.tile(image, envs),
        camera=recording.camera or Camera(),
        images=images,
    )


def _numbered(paths: list[str | None]) -> tuple[tuple[str, ...], np.ndarray]:
    """The distinct paths of images, and the index of each; -1 for None."""
    images = tuple(dict.fromkeys(path for path in paths if path is not None))
    return images, np.array([-1 if path is None else images.index(path) for path in paths], dtype=np.int64)


def colored(film: Film, recording: Recording, by: str) -> Film:
    """Colour the dynamic bodies of a film by a quantity, instead of their images.

    Args:
        film: film of all environments of the recording, from film_from_recording.
        recording: the recording.
        by: one of COLORINGS; "body" changes nothing.

    Raises:
        ValueError: The colouring is unknown, or its quantity was not recorded.
    """
    one_of("by", by, COLORINGS)
    if by == "body":
        return film
    rows = range(len(recording.envs))
    colors = [np.concatenate([frame_colors(by, recording, row, f) for row in rows]) for f in recording.frames()]
    return replace(film, color=np.stack(colors), image=np.where(film.dynamic, -1, film.image))


def _meshes(recording: Recording, surfaces: Sequence[DrawnSurface]) -> tuple[tuple[DrawnMesh, ...], np.ndarray]:
    """The meshes of a film, and the index (envs, bodies) of that of each body.

    A surface that moves has a mesh for each course of time that environments have.
    """
    meshes: list[DrawnMesh] = []
    mesh = np.tile(recording.surface, (len(recording.envs), 1))
    for index, surface in enumerate(surfaces):
        made: dict[bytes, int] = {}
        for row in range(len(recording.envs)) if surface.moves else (0,):
            times = recording.times[:, row]
            if times.tobytes() not in made:
                made[times.tobytes()] = len(meshes)
                vertices = surface.vertices_at(times[0])
                frames = tuple(surface.vertices_at(time) for time in times) if surface.moves else ()
                normals = corner_normals(vertices, surface.faces)
                meshes.append(DrawnMesh(vertices, surface.faces, normals, frames, surface.uv))
            mesh[row if surface.moves else slice(None), recording.surface == index] = made[times.tobytes()]
    return tuple(meshes), mesh


def film_from_usd(path) -> Film:
    """Read a film from a file written by export_usd.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It is not a USD file, or has no bodies.
    """
    from warp_rigid.usd.opening import convert_errors, open_stage

    stage = open_stage(Path(path))
    with convert_errors(path):
        return _film_of_stage(stage)


def _film_of_stage(stage) -> Film:
    from pxr import UsdGeom

    from warp_rigid.usd.conventions import custom_data, time_codes

    root = stage.GetDefaultPrim()
    envs = [prim for prim in root.GetChildren() if prim.IsA(UsdGeom.Xform)] if root else []
    groups = [
        (index, prim)
        for index, env in enumerate(envs)
        for prim in env.GetChildren()
        if prim.IsA(UsdGeom.PointInstancer) or prim.HasAttribute("xformOp:orient")
    ]
    if not groups:
        raise ValueError("must be an animation written by export_usd; warp-rigid run simulates other USD files")

    count = [0] * len(envs)
    first, last, _ = time_codes(stage)
    frames = np.arange(first, last + 1)
    places = UsdGeom.XformCache()
    offset = np.array([places.GetLocalToWorldTransform(prim).ExtractTranslation() for prim in envs])
    parts, paths = [], []
    meshes: dict[bytes, DrawnMesh] = {}
    motions = {motion.name.lower(): motion for motion in Motion}
    for index, group in groups:
        several = group.IsA(UsdGeom.PointInstancer)
        shown = group
        if several:
            targets = UsdGeom.PointInstancer(group).GetPrototypesRel().GetTargets()
            shown = stage.GetPrimAtPath(targets[0]) if targets else None
            if not shown or not shown.IsA(UsdGeom.Mesh):
                raise ValueError(f"{group.GetPath()}: must have a mesh as its prototype")
        drawn, image = _read_mesh(shown, frames)
        names = ("positions", "orientationsf") if several else ("xformOp:translate", "xformOp:orient")
        positions, turns = (_read(group.GetAttribute(name), frames) for name in names)
        colors = _read(UsdGeom.PrimvarsAPI(group).GetPrimvar("displayColor").GetAttr(), frames)
        key = drawn.vertices.tobytes() + drawn.faces.tobytes() + (b"" if drawn.uv is None else drawn.uv.tobytes())
        meshes.setdefault(key, drawn)
        body = np.array(group.GetAttribute("ids").Get() if several else [count[index]], np.int64)
        shape = len(frames), len(body)
        parts.append(
            {
                "mesh": np.full(len(body), list(meshes).index(key)),
                "color": colors,
                "position": positions.astype(np.float32).reshape(*shape, 3) + offset[index].astype(np.float32),
                "orientation": turns.reshape(*shape, 4),
                "present": _read_presence(group, body, frames),
                "env": np.full(len(body), index),
                "body": body,
                "motion": np.full(len(body), motions.get(str(custom_data(group).get("motion")), Motion.STATIC)),
                "gloss": _read_gloss(group, len(body)),
            }
        )
        paths += [image] * len(body)
        count[index] += 1
    found = concatenated(parts)
    if not (found["color"] != found["color"][0]).any():
        found["color"] = found["color"][0]
    images, image_index = _numbered(paths)
    return Film(
        **found,
        image=image_index,
        images=images,
        meshes=tuple(meshes.values()),
        fps=stage.GetFramesPerSecond(),
        offset=offset,
        labels=tuple(prim.GetDisplayName() for prim in envs),
        camera=_camera_of_stage(stage),
    )


def _camera_of_stage(stage) -> Camera:
    """The camera that was written with the film."""
    from warp_rigid.usd.conventions import custom_data

    for prim in stage.GetDefaultPrim().GetChildren():
        custom = custom_data(prim)
        if "camera" in custom:
            camera = camera_of_text(str(custom["camera"]))
            return camera if camera.body is None else replace(camera, body=custom.get("cameraBody"))
    return Camera()


def _read_mesh(prim, frames) -> tuple[DrawnMesh, str | None]:
    """Read the parts of a body that are drawn, joined to one mesh, and its image."""
    from pxr import Usd, UsdGeom

    from warp_rigid.usd.preview_surface import uv_and_image
    from warp_rigid.usd.prims import matrix_between, triangles_of

    parts, moving, image = [], {}, None
    for part in Usd.PrimRange(prim, Usd.TraverseInstanceProxies()):
        if part.IsA(UsdGeom.Gprim) and UsdGeom.Imageable(part).ComputePurpose() != UsdGeom.Tokens.guide:
            matrix = matrix_between(UsdGeom.XformCache(), part, prim)
            points, triangles = triangles_of(part)
            attribute = part.GetAttribute("points")
            if attribute and attribute.ValueMightBeTimeVarying():
                moving[len(parts)] = _read(attribute, frames) @ matrix[:3, :3].T + matrix[:3, 3]
            uv, found = uv_and_image(part)
            parts.append(Triangles(points @ matrix[:3, :3].T + matrix[:3, 3], triangles, uv))
            image = image or found
    if not parts:
        raise ValueError(f"{prim.GetPath()} has no geometry")
    vertices, faces, uv, _ = joined(parts)
    vertices, faces = vertices.astype(np.float32), faces.astype(np.int32)
    shown = [
        np.concatenate([moving[k][f] if k in moving else part.vertices for k, part in enumerate(parts)], dtype="f4")
        for f in range(len(frames) if moving else 0)
    ]
    uv = None if uv is None else uv.astype(np.float32)
    return DrawnMesh(vertices, faces, corner_normals(vertices, faces), tuple(shown), uv), image


def _read_gloss(prim, count: int) -> np.ndarray:
    """Roughness and metallic of the instances of a prim, (count, 2) float32."""
    from pxr import UsdGeom

    gloss = body_gloss(count, {})
    for column, name in enumerate(("roughness", "metallic")):
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(name)
        if primvar.HasValue():
            gloss[:, column] = np.array(primvar.Get(), np.float32)
    return gloss


def _read_presence(group, body: np.ndarray, frames) -> np.ndarray:
    """Which bodies of a group are present at some time codes, (frames, bodies).

    Of several level grounds, all but one are always invisible; they are present.
    """
    from warp_rigid.usd.conventions import custom_data

    hidden, visibility = group.GetAttribute("invisibleIds"), group.GetAttribute("visibility")
    if group.HasAttribute("protoIndices"):
        absent = [np.isin(body, hidden.Get(frame) if hidden.HasAuthoredValue() else ()) for frame in frames]
    elif visibility.ValueMightBeTimeVarying():
        absent = [np.full(1, visibility.Get(frame) == "invisible") for frame in frames]
    else:
        absent = [np.full(1, not custom_data(group).get("active", True))] * len(frames)
    return ~np.stack(absent)


def _read(attribute, frames) -> np.ndarray:
    """Values of an attribute at some time codes; a constant value is read once.

    Quaternions are returned as (x, y, z, w).
    """
    if not attribute.ValueMightBeTimeVarying():
        value = _numbers(attribute.Get())
        return np.broadcast_to(value, (len(frames), *value.shape))
    return np.stack([_numbers(attribute.Get(frame)) for frame in frames])


def _numbers(value) -> np.ndarray:
    """Convert a USD value to an array; a quaternion becomes (x, y, z, w)."""
    if hasattr(value, "GetImaginary"):
        return np.array([*value.GetImaginary(), value.GetReal()], dtype=np.float32)
    return np.array(value)
