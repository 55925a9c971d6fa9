"""A scene of bodies with an image, whose texture coordinates are a linear map of the places on a box."""

import numpy as np
import trimesh
from PIL import Image

import warp_rigid as wr
from warp_rigid.scene.look import Look

MAP = np.array([[0.25, 0.5, -1.0], [0.75, -0.125, 0.5]])


def textured_scene(folder, size=(8, 4)):
    """Three bodies of one mesh, two of them with an image, and a compound of it and a box; and the pixels."""
    pixels = np.random.default_rng(5).integers(0, 256, (*size[::-1], 3)).astype(np.uint8)
    Image.fromarray(pixels).save(folder / "image.png")
    box = trimesh.creation.box((1, 1, 1))
    mesh = wr.Mesh(box.vertices, box.faces, 16, uv=box.vertices @ MAP.T)
    pair = wr.Compound([(wr.Box((0.2, 0.2, 0.2)), (0, 0, 2), (0, 0, 0, 1)), (mesh, (0, 0, 0), (0, 0, 0, 1))])
    scene = wr.Scene()
    for place, shape in enumerate((mesh, mesh, mesh, pair)):
        scene.add_body(shape, position=(2.0 * place, 0, 0), name=f"body_{place}")
    scene.looks = {k: Look((0.1, 0.2, 0.3), 0.25, 0.5, folder / "image.png") for k in (0, 1, 3)}
    return scene, pixels
