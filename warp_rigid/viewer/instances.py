"""Bodies on the page: all that share a mesh are one batch, which takes poses, colours and opacities as arrays."""

import numpy as np

from warp_rigid.render.appearance import on_screen
from warp_rigid.render.film import DrawnMesh, Film
from warp_rigid.viewer.page import add_ground, opacity_of_walls

FIXED_GROUP, MOVING_GROUP = "/fixed", "/moving"


class Instances:
    """The instances of a film's meshes.

    Args:
        server: the viser server.
        film: whose meshes, colours and first poses are drawn.
        moving: (instances,) True where poses will change.

    Attributes:
        handles: the batches, and which instances each of them holds.
    """

    def __init__(self, server, film: Film, moving: np.ndarray):
        """Send the meshes."""
        self._server = server
        self.handles = []
        self._moving = []
        colors = bytes_of_light(film.color_at(0))
        self._grounds = add_ground(server, film)
        for index, mesh in enumerate(film.meshes):
            for moves in (False, True):
                chosen = np.flatnonzero((film.mesh == index) & (moving == moves) & ~film.level)
                if len(chosen):
                    self.handles.append((self._add(mesh, index, moves, chosen, film, colors), chosen))
                    self._moving.append(moves)
        self.fade(np.where(moving, 1.0, opacity_of_walls(film)))

    def show(self, film: Film, frame: int) -> None:
        """Show a frame of the film, or of another one of the same instances."""
        self.pose(film.position[frame], film.orientation[frame])
        if film.color.ndim == 3:
            self.color(bytes_of_light(film.color[frame]))

    def pose(self, position: np.ndarray, orientation: np.ndarray) -> None:
        """Move the moving instances: (instances, 3) and (instances, 4), quaternions (x, y, z, w)."""
        wxyz = orientation[:, [3, 0, 1, 2]]
        for (handle, chosen), moves in zip(self.handles, self._moving, strict=True):
            if moves:
                handle.batched_positions = position[chosen]
                handle.batched_wxyzs = wxyz[chosen]

    def color(self, colors: np.ndarray) -> None:
        """Colour all instances, (instances, 3) uint8; batches whose colours are unchanged are not sent."""
        for handle, chosen in self.handles:
            if not np.array_equal(handle.batched_colors, colors[chosen]):
                handle.batched_colors = colors[chosen]

    def fade(self, opacity: np.ndarray) -> None:
        """Opacity of all instances, (instances,); batches that are opaque all through get none."""
        for handle, chosen in self.handles:
            wanted = opacity[chosen].astype(np.float32)
            if (wanted == 1.0).all() and handle.batched_opacities is None:
                continue
            if handle.batched_opacities is None or not np.array_equal(handle.batched_opacities, wanted):
                handle.batched_opacities = wanted

    def wire(self, on: bool) -> None:
        """Draw the edges of triangles instead of faces."""
        for handle, _ in self.handles:
            handle.wireframe = on

    def remove(self) -> None:
        """Remove all batches from the page."""
        for handle in (*self._grounds, *(handle for handle, _ in self.handles)):
            handle.remove()
        self._grounds, self.handles = [], []

    def _add(self, mesh: DrawnMesh, index: int, moves: bool, chosen: np.ndarray, film: Film, colors: np.ndarray):
        vertices, faces = creased(mesh)
        return self._server.scene.add_batched_meshes_simple(
            f"{MOVING_GROUP if moves else FIXED_GROUP}/mesh_{index}",
            vertices,
            faces,
            batched_wxyzs=film.orientation[0][chosen][:, [3, 0, 1, 2]],
            batched_positions=film.position[0][chosen],
            batched_colors=colors[chosen],
            lod="off",
            side="double" if mesh.flat else "front",
            cast_shadow=not mesh.flat,
        )


def creased(mesh: DrawnMesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and faces (m, 3) with a vertex for each of its normals, so that creases stay sharp."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    rows = np.concatenate([corners, np.round(mesh.normals.reshape(-1, 3), 3)], axis=1)
    unique, index = np.unique(rows, axis=0, return_inverse=True)
    return unique[:, :3].astype(np.float32), index.reshape(-1, 3).astype(np.uint32)


def bytes_of_light(color: np.ndarray) -> np.ndarray:
    """Linear light as screen bytes, uint8 of the same shape."""
    return np.round(255.0 * on_screen(color)).astype(np.uint8)
