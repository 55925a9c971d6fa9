"""Colour of an image at a point of a textured triangle."""

from pathlib import Path

import numpy as np
import warp as wp

from warp_rigid.render.appearance import linear_light
from warp_rigid.render.film import DrawnMesh, Film
from warp_rigid.render.textures import image_levels
from warp_rigid.scene.look import file_of_image

wp.set_module_options({"enable_backward": False})

UNSTRETCHED = 1e9
"""Length of a unit of the coordinates of a triangle that is a point on the image [m]."""


@wp.struct
class Textures:
    """Images of the instances, each with its reductions to half of the width and height before, one after another."""

    level: wp.array[int]  # of each instance: its image, full size; -1 without
    levels: wp.array[int]  # of each instance: number of sizes of its image
    uv: wp.array2d[wp.vec2]  # of the corners of all meshes, NaN without
    length: wp.array[float]  # of each triangle: mean length of a unit of uv [m]
    first: wp.array[int]  # of each size: its first texel
    size: wp.array[wp.vec2i]  # width and height
    texels: wp.array[wp.vec3ub]  # sRGB, in rows from the top
    light: wp.array[float]  # linear light of a screen value


@wp.func
def texel(textures: Textures, level: int, x: int, y: int) -> wp.vec3:
    """Linear light of a texel; the image repeats once beyond its border."""
    size = textures.size[level]
    row, column = (y + size[1]) % size[1], (x + size[0]) % size[0]
    screen = textures.texels[textures.first[level] + row * size[0] + column]
    return wp.vec3(textures.light[int(screen[0])], textures.light[int(screen[1])], textures.light[int(screen[2])])


@wp.func
def bilinear(textures: Textures, level: int, at: wp.vec2) -> wp.vec3:
    """Linear light of an image that repeats, at texture coordinates."""
    size = textures.size[level]
    x = (at[0] - wp.floor(at[0])) * float(size[0]) - 0.5
    y = (1.0 - (at[1] - wp.floor(at[1]))) * float(size[1]) - 0.5
    column, row = int(wp.floor(x)), int(wp.floor(y))
    right, down = x - wp.floor(x), y - wp.floor(y)
    upper = wp.lerp(texel(textures, level, column, row), texel(textures, level, column + 1, row), right)
    lower = wp.lerp(texel(textures, level, column, row + 1), texel(textures, level, column + 1, row + 1), right)
    return wp.lerp(upper, lower, down)


@wp.func
def texture_color(
    textures: Textures, i: int, row: int, u: float, v: float, footprint: float, plain: wp.vec3
) -> wp.vec3:
    """Colour of instance i at a point of triangle `row`, or its plain colour where it has no image.

    The image is taken in the size whose texels are closest to the width of a pixel on the surface, `footprint` [m].
    """
    level = textures.level[i]
    if level < 0:
        return plain
    at = u * textures.uv[row, 0] + v * textures.uv[row, 1] + (1.0 - u - v) * textures.uv[row, 2]
    if not (wp.isfinite(at[0]) and wp.isfinite(at[1])):
        return plain
    size = textures.size[level]
    texels = footprint / textures.length[row] * wp.sqrt(float(size[0]) * float(size[1]))
    smaller = wp.clamp(wp.round(wp.log2(wp.max(texels, 1.0))), 0.0, float(textures.levels[i] - 1))
    return bilinear(textures, level + int(smaller), at)


def textures_of(film: Film) -> Textures:
    """The images of a film; instances whose image cannot be read have none."""
    made = Textures()
    files = [Path(file_of_image(path)) for path in film.images]
    changes = [file.stat().st_mtime_ns if file.is_file() else 0 for file in files]
    levels = [image_levels(*image) for image in zip(film.images, changes, strict=True)]
    count = np.array([len(sizes) for sizes in levels], dtype=int)
    start = np.where(count > 0, np.cumsum(count) - count, -1)
    flat = [size for sizes in levels for size in sizes]
    texels = np.array([size.shape[0] * size.shape[1] for size in flat], dtype=int)
    made.level = wp.array(np.append(start, -1)[film.image], dtype=int)
    made.levels = wp.array(np.append(count, 0)[film.image], dtype=int)
    made.first = wp.array(np.cumsum(texels) - texels, dtype=int)
    made.size = wp.array(np.array([size.shape[1::-1] for size in flat]).reshape(-1, 2), dtype=wp.vec2i)
    colors = [size.reshape(-1, 3) for size in flat]
    made.texels = wp.array(np.concatenate([np.zeros((0, 3), np.uint8), *colors]), dtype=wp.vec3ub)
    made.light = wp.array(linear_light(np.arange(256.0)), dtype=float)
    uv = np.concatenate([_uv_of(mesh) for mesh in film.meshes]) if flat else np.zeros((0, 3, 2))
    length = np.concatenate([_lengths(mesh) for mesh in film.meshes]) if flat else np.zeros(0)
    made.uv, made.length = wp.array(uv, dtype=wp.vec2), wp.array(length, dtype=float)
    return made


def _uv_of(mesh: DrawnMesh) -> np.ndarray:
    return np.full((len(mesh.faces), 3, 2), np.nan) if mesh.uv is None else mesh.uv


def _lengths(mesh: DrawnMesh) -> np.ndarray:
    """Mean length of a unit of the texture coordinates of each triangle (m,) [m]."""
    (a, b, c), (p, q, r) = (np.moveaxis(corners, 1, 0) for corners in (mesh.vertices[mesh.faces], _uv_of(mesh)))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    on_image = np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
    return np.where(on_image > 0.0, np.sqrt(area / np.where(on_image > 0.0, on_image, 1.0)), UNSTRETCHED)
