"""Bodies on the page: all of one mesh and image are one batch, which takes poses, colours and opacities as arrays."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh

from warp_rigid.render.film import DrawnMesh, Film
from warp_rigid.render.textures import read_image
from warp_rigid.viewer.page import add_ground, add_labels, opacity_of_walls

FIXED_GROUP, MOVING_GROUP = "/fixed", "/moving"
LARGEST_SIDE = 1024
"""Width and height to which larger images are reduced for the page [pixel]."""


@dataclass
class DrawnBatch:
    """Instances of one mesh with one image, or without.

    Attributes:
        chosen: which instances of the film these are.
        moves: whether their poses change.
        plain: draws them in their colours.
        pictured: draws those with their image that have their own colour and are opaque; None without an image.
    """

    chosen: np.ndarray
    moves: bool
    plain: Any
    pictured: Any = None

    @property
    def handles(self) -> list:
        """What draws the instances."""
        return [handle for handle in (self.plain, self.pictured) if handle is not None]

    def picture(self, shown: np.ndarray) -> None:
        """Draw some of the instances with their image, (instances of the batch,) bool."""
        for handle, other, drawn in ((self.plain, self.pictured, ~shown), (self.pictured, self.plain, shown)):
            if drawn.any():
                if not handle.visible:
                    self._place(handle, other.batched_positions, other.batched_wxyzs)
                handle.batched_scales = None if drawn.all() else drawn.astype(np.float32)
            handle.visible = bool(drawn.any())

    def pose(self, positions: np.ndarray, wxyzs: np.ndarray) -> None:
        """Move the instances: (instances of the batch, 3) and (instances of the batch, 4). What is hidden stays."""
        for handle in self.handles:
            if handle.visible:
                self._place(handle, positions, wxyzs)

    @staticmethod
    def _place(handle: Any, positions: np.ndarray, wxyzs: np.ndarray) -> None:
        handle.batched_positions, handle.batched_wxyzs = positions, wxyzs


class Instances:
    """The instances of a film's meshes, its endless grounds and the labels of its environments.

    Values that a batch already has are not sent again: viser compares them.

    Args:
        server: the viser server.
        film: whose meshes, images, colours and first poses are drawn.
        moving: (instances,) True where poses will change.

    Attributes:
        handles: what draws them, and which instances each of these holds.
    """

    def __init__(self, server, film: Film, moving: np.ndarray):
        """Send the meshes and the images."""
        self._server = server
        self._batches = []
        self._own = self._colors = bytes_of_light(film.color_at(0))
        self._wire = False
        self._beside = [*add_ground(server, film), *add_labels(server, film)]
        shown = ~film.level
        for index, moves, image in np.unique(np.stack([film.mesh, moving, film.image])[:, shown], axis=1).T.tolist():
            chosen = (film.mesh == index) & (moving == moves) & (film.image == image) & shown
            self._batches.append(self._add(index, bool(moves), image, np.flatnonzero(chosen), film))
        self._opacity = self._solid = np.where(moving, 1.0, opacity_of_walls(film))
        self.fade(np.where(film.present[0], self._solid, 0.0))

    @property
    def handles(self) -> list[tuple[Any, np.ndarray]]:
        """What draws the instances, and which of them."""
        return [(handle, batch.chosen) for batch in self._batches for handle in batch.handles]

    def show(self, film: Film, frame: int) -> None:
        """Show a frame of the film, or of another one of the same instances."""
        self.pose(film.position[frame], film.orientation[frame])
        if not film.present.all():
            self.fade(np.where(film.present[frame], self._solid, 0.0))
        if film.color.ndim == 3:
            self.color(bytes_of_light(film.color[frame]))

    def pose(self, position: np.ndarray, orientation: np.ndarray) -> None:
        """Move the moving instances: (instances, 3) and (instances, 4), quaternions (x, y, z, w)."""
        wxyz = orientation[:, [3, 0, 1, 2]]
        for batch in self._batches:
            if batch.moves:
                batch.pose(position[batch.chosen], wxyz[batch.chosen])

    def color(self, colors: np.ndarray) -> None:
        """Colour all instances, (instances, 3) uint8."""
        self._colors = colors
        for batch in self._batches:
            batch.plain.batched_colors = colors[batch.chosen]
        self._picture()

    def fade(self, opacity: np.ndarray) -> None:
        """Opacity of all instances, (instances,); batches that are opaque all through get none."""
        self._opacity = opacity
        for batch in self._batches:
            wanted = opacity[batch.chosen].astype(np.float32)
            if (wanted < 1.0).any() or batch.plain.batched_opacities is not None:
                batch.plain.batched_opacities = wanted
        self._picture()

    def wire(self, on: bool) -> None:
        """Draw the edges of triangles instead of faces."""
        self._wire = on
        for batch in self._batches:
            batch.plain.wireframe = on
        self._picture()

    def remove(self) -> None:
        """Remove all of it from the page."""
        for handle in (*self._beside, *(handle for handle, _ in self.handles)):
            handle.remove()
        self._beside, self._batches = [], []

    def _picture(self) -> None:
        """Show images on opaque bodies of their own colours: the page can neither fade nor colour an image."""
        shown = (self._colors == self._own).all(axis=1) & (self._opacity == 1.0) & (not self._wire)
        for batch in self._batches:
            if batch.pictured is not None:
                batch.picture(shown[batch.chosen])

    def _add(self, index: int, moves: bool, image: int, chosen: np.ndarray, film: Film) -> DrawnBatch:
        mesh, scene = film.meshes[index], self._server.scene
        name = f"{MOVING_GROUP if moves else FIXED_GROUP}/mesh_{index}" + (f"_image_{image}" if image >= 0 else "")
        common = {
            "batched_wxyzs": film.orientation[0][chosen][:, [3, 0, 1, 2]],
            "batched_positions": film.position[0][chosen],
            "lod": "off",
            "cast_shadow": not mesh.flat,
        }
        content = textured_mesh(mesh, film.images[image], self._own[chosen[0]]) if image >= 0 else None
        plain = scene.add_batched_meshes_simple(
            name, *creased(mesh), batched_colors=self._own[chosen], side="double" if mesh.flat else "front", **common
        )
        if content is None:
            return DrawnBatch(chosen, moves, plain)
        return DrawnBatch(chosen, moves, plain, scene.add_batched_glb(f"{name}_shown", content, **common))


def creased(mesh: DrawnMesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and faces (m, 3) with a vertex for each of its normals, so that creases stay sharp."""
    rows, faces = _distinct(mesh.vertices[mesh.faces], mesh.normals)
    return rows[:, :3].astype(np.float32), faces.astype(np.uint32)


def textured_mesh(mesh: DrawnMesh, path: str, color: np.ndarray) -> bytes | None:
    """A mesh with an image as binary glTF; None, with a warning, if the image cannot be read.

    Args:
        mesh: with texture coordinates.
        path: of the image.
        color: (3,) uint8, of the triangles without texture coordinates.
    """
    image = read_image(path, LARGEST_SIDE)
    if image is None or mesh.uv is None:
        return None
    has_uv = np.isfinite(mesh.uv).all(axis=(1, 2))
    scene = trimesh.Scene()
    for chosen, look in ((has_uv, {"baseColorTexture": image}), (~has_uv, {"baseColorFactor": color})):
        if chosen.any():
            material = trimesh.visual.material.PBRMaterial(**look, metallicFactor=0.0, roughnessFactor=1.0)
            uv = np.nan_to_num(mesh.uv[chosen])
            rows, faces = _distinct(mesh.vertices[mesh.faces[chosen]], mesh.normals[chosen], uv)
            visual = trimesh.visual.TextureVisuals(uv=rows[:, 6:], material=material)
            scene.add_geometry(trimesh.Trimesh(rows[:, :3], faces, visual=visual, process=False))
    return scene.export(file_type="glb")


def _distinct(places: np.ndarray, normals: np.ndarray, *more: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct corners of triangles, of arrays (m, 3, ...), as rows, and the faces (m, 3) that consist of them."""
    corners = np.concatenate([places, np.round(normals, 3), *more], axis=2)
    rows, index = np.unique(corners.reshape(-1, corners.shape[2]), axis=0, return_inverse=True)
    return rows, index.reshape(-1, 3)


def bytes_of_light(color: np.ndarray) -> np.ndarray:
    """Linear light as bytes, uint8 of the same shape: the page takes the colours of batches as light."""
    return np.round(255.0 * np.clip(color, 0.0, 1.0)).astype(np.uint8)
