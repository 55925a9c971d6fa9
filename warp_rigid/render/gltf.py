"""glTF export of an animation as one .glb file, which web viewers and desktop previews can play."""

from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.files.atomic import atomic_file
from warp_rigid.render.appearance import (
    body_colors,
    corner_normals,
    drawn_looks,
    drawn_surfaces,
    environment_offsets,
    spread_of,
)
from warp_rigid.render.textures import embedded_image
from warp_rigid.rotations import continuous_signs
from warp_rigid.runs.drawn_surface import DrawnSurface
from warp_rigid.runs.recording import Recording
from warp_rigid.scene.look import Look

Z_UP_TO_Y_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
"""Rotation of the root node, since glTF has y up."""
MATT = Look(roughness=0.7)
"""Look of bodies without one."""
FLOAT, UINT = 5126, 5125
VERTICES, INDICES = 34962, 34963


def export_gltf(recording: Recording, path: str | PathLike[str], envs: Iterable[int] | None = None) -> None:
    """Write a recording as binary glTF 2.0, with one animated node per body and the images of their looks.

    Ground that moves is a mesh with two shapes, whose weights are animated.

    Args:
        recording: the recording.
        path: output file, .glb; missing folders are created.
        envs: indices of the environments to write; None writes all recorded ones.

    Raises:
        ValueError: The path has another suffix, or an environment was not recorded.
        OSError: The file cannot be written.
        ModuleNotFoundError: pygltflib is not installed.
    """
    path = Path(path)
    if path.suffix != ".glb":
        raise ValueError(f"path: must end in .glb, got {path}")
    rows = recording.rows(envs)
    import pygltflib

    file = _Assembly(pygltflib)
    spread = spread_of(recording)
    surfaces = drawn_surfaces(recording, len(rows), spread)
    colors = body_colors(recording.motion, recording.looks)
    looks = drawn_looks(recording)
    world = file.node(name="World", rotation=Z_UP_TO_Y_UP)
    orientation = continuous_signs(recording.orientation)
    time = file.numbers((recording.time - recording.time[0]).astype(np.float32), "SCALAR", bounds=True)
    for row, offset in zip(rows.tolist(), environment_offsets(len(rows), spread.spacing()).tolist(), strict=True):
        env = file.node(world, name=recording.labels[row] or f"env_{recording.envs[row]:04d}", translation=offset)
        for body, name in enumerate(recording.names):
            places, turns = recording.position[:, row, body], orientation[:, row, body]
            index = int(recording.surface[body])
            weights = surfaces[index].weights_at(recording.times[:, row]).astype(np.float32)
            mesh = file.mesh(index, surfaces[index], colors[body], looks.get(body, MATT), weights[0])
            scales = np.repeat(recording.active[:, row, body, None], 3, axis=1).astype(np.float32)
            hides = bool((scales == 0.0).any())
            pose = {"translation": places[0].tolist(), "rotation": turns[0].tolist()}
            node = file.node(env, name=name, mesh=mesh, scale=scales[0].tolist() if hides else None, **pose)
            if (places != places[0]).any():
                file.animate(node, "translation", time, file.numbers(places, "VEC3"))
            if (turns != turns[0]).any():
                file.animate(node, "rotation", time, file.numbers(turns, "VEC4"))
            if surfaces[index].moves:
                file.animate(node, "weights", time, file.numbers(weights.reshape(-1), "SCALAR"))
            if hides:
                file.animate(node, "scale", time, file.numbers(scales, "VEC3"), "STEP")
    with atomic_file(path) as temporary:
        file.save(temporary)


class _Assembly:
    """Nodes, meshes and arrays of one file, which the library pygltflib writes."""

    def __init__(self, library: Any):
        self._library = library
        self._gltf = library.GLTF2(
            asset=library.Asset(version="2.0", generator="warp_rigid"),
            scene=0,
            scenes=[library.Scene(nodes=[0])],
            buffers=[library.Buffer(byteLength=0)],
        )
        self._blob = bytearray()
        self._meshes: dict[tuple, int] = {}
        self._geometry: dict[tuple[int, bool], list[tuple[Any, int, list]]] = {}
        self._textures: dict[str, int | None] = {}
        self._animation = library.Animation(name="simulation")

    def node(self, parent: int | None = None, **values) -> int:
        """Add a node; returns its index."""
        index = _added(self._gltf.nodes, self._library.Node(**values))
        if parent is not None:
            self._gltf.nodes[parent].children.append(index)
        return index

    def numbers(self, values: np.ndarray, kind: str, bounds: bool = False, target: int | None = None) -> int:
        """Add an array; returns the index of its accessor."""
        accessor = self._library.Accessor(
            bufferView=self._view(np.ascontiguousarray(values).tobytes(), target),
            componentType=UINT if values.dtype == np.uint32 else FLOAT,
            count=len(values),
            type=kind,
        )
        if bounds:
            accessor.min, accessor.max = (np.atleast_1d(pick(values, axis=0)).tolist() for pick in (np.min, np.max))
        return _added(self._gltf.accessors, accessor)

    def _view(self, content: bytes, target: int | None = None) -> int:
        """Add bytes, from a multiple of four on; returns the index of their view."""
        self._blob += bytes(-len(self._blob) % 4)
        view = self._library.BufferView(buffer=0, byteOffset=len(self._blob), byteLength=len(content), target=target)
        self._blob += content
        return _added(self._gltf.bufferViews, view)

    def mesh(self, index: int, surface: DrawnSurface, color: np.ndarray, look: Look, weights: np.ndarray) -> int:
        """Add surface number `index` with a colour, a look and the weights of its shapes at the start if it moves.

        Meshes of the same surface share its arrays.
        """
        key = index, color.tobytes(), look, weights.tobytes() if surface.moves else b""
        if key not in self._meshes:
            texture = self._texture(look.image) if look.image else None
            part = index, texture is not None
            if part not in self._geometry:
                self._geometry[part] = self._parts(surface, texture is not None)
            primitives = [
                self._library.Primitive(
                    attributes=attributes,
                    indices=corners,
                    targets=targets,
                    material=self._material(color, look, texture if attributes.TEXCOORD_0 is not None else None),
                )
                for attributes, corners, targets in self._geometry[part]
            ]
            made = self._library.Mesh(primitives=primitives, weights=weights.tolist() if surface.moves else [])
            self._meshes[key] = _added(self._gltf.meshes, made)
        return self._meshes[key]

    def _parts(self, surface: DrawnSurface, textured: bool) -> list[tuple[Any, int, list]]:
        """Add the arrays of a surface; with texture coordinates, apart for the triangles that have some."""
        normals = corner_normals(surface.vertices, surface.faces)
        corners = np.concatenate([surface.vertices[surface.faces], normals], axis=2)
        if surface.moves:
            return [self._arrays(corners, surface.swing.T[surface.faces])]
        if not textured or surface.uv is None:
            return [self._arrays(corners)]
        # In glTF, v runs downward from the upper edge of the image.
        corners = np.concatenate([corners, surface.uv * (1, -1) + (0, 1)], axis=2)
        has_uv = np.isfinite(surface.uv).all(axis=(1, 2))
        parts = corners[has_uv], corners[~has_uv, :, :6]
        return [self._arrays(part) for part in parts if len(part)]

    def _arrays(self, corners: np.ndarray, swing: np.ndarray | None = None) -> tuple[Any, int, list]:
        """Add the distinct corners (m, 3, 6 or 8) of points, normals and texture coordinates, and triangle indices.

        The displacements of a surface that moves are (m, 3, 2) along z, one for each of its shapes.
        """
        number = corners.shape[2]
        everything = corners if swing is None else np.concatenate([corners, swing], axis=2)
        rows, index = np.unique(everything.reshape(-1, everything.shape[2]), axis=0, return_inverse=True)
        rows = rows.astype(np.float32)
        attributes = self._library.Attributes(
            POSITION=self.numbers(rows[:, :3], "VEC3", bounds=True, target=VERTICES),
            NORMAL=self.numbers(rows[:, 3:6], "VEC3", target=VERTICES),
        )
        if number > 6:
            attributes.TEXCOORD_0 = self.numbers(rows[:, 6:number], "VEC2", target=VERTICES)
        rises = [column[:, None] * np.eye(3, dtype=np.float32)[2] for column in rows[:, number:].T]
        targets = [
            self._library.Attributes(POSITION=self.numbers(rise, "VEC3", bounds=True, target=VERTICES))
            for rise in rises
        ]
        indices = self.numbers(index.reshape(-1).astype(np.uint32), "SCALAR", target=INDICES)
        return attributes, indices, targets

    def _texture(self, path: str) -> int | None:
        """Add an image; returns the index of its texture, None if it cannot be read."""
        if path not in self._textures:
            self._textures[path] = None
            if (found := embedded_image(path)) is not None:
                content, media_type = found
                image = self._library.Image(bufferView=self._view(content), mimeType=media_type)
                texture = self._library.Texture(source=_added(self._gltf.images, image))
                self._textures[path] = _added(self._gltf.textures, texture)
        return self._textures[path]

    def _material(self, color: np.ndarray, look: Look, texture: int | None) -> int:
        """Add a double-sided material of a colour, or with a texture instead; returns its index."""
        shading = self._library.PbrMetallicRoughness(
            baseColorFactor=[*(color.tolist() if texture is None else (1.0, 1.0, 1.0)), 1.0],
            metallicFactor=look.metallic,
            roughnessFactor=look.roughness,
        )
        if texture is not None:
            shading.baseColorTexture = self._library.TextureInfo(index=texture)
        options = {"doubleSided": True, "alphaCutoff": None, "alphaMode": "OPAQUE"}
        return _added(self._gltf.materials, self._library.Material(pbrMetallicRoughness=shading, **options))

    def animate(self, node: int, path: str, time: int, values: int, interpolation: str = "LINEAR") -> None:
        """Animate the translation, rotation, scale or weights of a node."""
        library = self._library
        sampler = library.AnimationSampler(input=time, output=values, interpolation=interpolation)
        index = _added(self._animation.samplers, sampler)
        target = library.AnimationChannelTarget(node=node, path=path)
        self._animation.channels.append(library.AnimationChannel(sampler=index, target=target))

    def save(self, path: Path) -> None:
        """Write the file."""
        if self._animation.channels:
            self._gltf.animations.append(self._animation)
        self._gltf.buffers[0].byteLength = len(self._blob)
        self._gltf.set_binary_blob(bytes(self._blob))
        self._gltf.save_binary(str(path))


def _added(items: list, item: Any) -> int:
    """Add an item to a list of the file; returns its index."""
    items.append(item)
    return len(items) - 1
