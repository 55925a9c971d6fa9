"""Meshes with an image as the page takes them: binary glTF."""

import numpy as np
import trimesh

from warp_rigid.render.film import DrawnMesh
from warp_rigid.render.textures import image_filter, read_image

LARGEST_SIDE = 1024
"""Width and height to which larger images are reduced for the page [pixel]."""


def textured_mesh(mesh: DrawnMesh, path: str, color: np.ndarray) -> bytes | None:
    """A mesh with an image; None, with a warning, if the image cannot be read.

    Args:
        mesh: with texture coordinates.
        path: of the image.
        color: (3,) uint8, of the triangles without texture coordinates.
    """
    image = read_image(path)
    if image is None or mesh.uv is None:
        return None
    image.thumbnail((LARGEST_SIDE, LARGEST_SIDE), image_filter())
    has_uv = np.isfinite(mesh.uv).all(axis=(1, 2))
    scene = trimesh.Scene()
    for chosen, look in ((has_uv, {"baseColorTexture": image}), (~has_uv, {"baseColorFactor": color})):
        if chosen.any():
            material = trimesh.visual.material.PBRMaterial(**look, metallicFactor=0.0, roughnessFactor=1.0)
            scene.add_geometry(_corners_merged(mesh, chosen, material))
    return scene.export(file_type="glb")


def _corners_merged(mesh: DrawnMesh, chosen: np.ndarray, material):
    """Some triangles, with a vertex for each distinct set of place, normal and texture coordinates."""
    corners = [mesh.vertices[mesh.faces[chosen]], np.round(mesh.normals[chosen], 3), np.nan_to_num(mesh.uv[chosen])]
    rows, index = np.unique(np.concatenate(corners, axis=2).reshape(-1, 8), axis=0, return_inverse=True)
    visual = trimesh.visual.TextureVisuals(uv=rows[:, 6:], material=material)
    return trimesh.Trimesh(rows[:, :3], index.reshape(-1, 3), visual=visual, process=False)
