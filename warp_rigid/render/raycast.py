"""Ray caster on the CPU, for rendering mesh instances without a display.

Every mesh has its own bounding volume hierarchy, built once per film; each frame builds a hierarchy over the instances.
A pixel casts a primary ray, and from its surface RAYS rays toward a lamp of some width and as many for the ambient
occlusion. The directions differ between the pixels of a tile of TILE x TILE; their results are averaged over a window
of that size on the same surface, so that a flat region has no noise. Edges are drawn again with more rays.
"""

from typing import Any

import numpy as np
import warp as wp

from warp_rigid.engine.cores import spread, usable_cores
from warp_rigid.kernel_cache import load_module
from warp_rigid.kernels.common.tangents import tangent_of
from warp_rigid.render.appearance import bound_corners, corner_normals, on_screen
from warp_rigid.render.film import Film
from warp_rigid.render.shading import HORIZON_COLOR, CameraView, glossy_color, grid_shade, lit_color, sky_color
from warp_rigid.render.texture_sampling import Textures, texture_color, textures_of
from warp_rigid.rotations import inverse, rotate
from warp_rigid.scene.scene import Motion
from warp_rigid.scene.shapes.tessellation import geodesic
from warp_rigid.threads import exclusive

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e6)
SECTION_SHADE = wp.constant(0.8)  # brightness of the inside of a solid that is cut open
LAMP_RADIUS = 0.05
"""Radius of the lamp that casts shadows, at unit distance [rad]."""

TILE = 4
"""Side of the squares of pixels whose secondary rays complement each other [pixel]."""
RAYS, RAYS_AT_EDGES = 2, 6
"""Numbers of rays toward the lamp, and toward the sky, of each primary ray."""
GOLDEN_X = wp.constant(0.7548776662466927)  # the R2 sequence, a low-discrepancy sequence in the plane
GOLDEN_Y = wp.constant(0.5698402909980532)

WALL_THICKNESS = 0.3
"""Maximum ratio of the thickness of a wall to its height and width."""
HIDDEN_PART = 0.1
"""A static wall that hides more than this fraction of the moving bodies of an environment is left out."""
HIDDEN_INSIDE = 0.3
"""A hollow body that at some time hides more than this fraction of the moving bodies inside it is cut open."""
HIDDEN_TIMES = 24
"""Number of frames that are considered for that."""
WHOLE, REMOVED, CUT = 0, 1, 2
"""How a fixed body is drawn: whole, not at all, or without the half on the side of the camera."""
EDGE_CONTRAST = 0.08
"""Minimum sRGB difference between neighbouring pixels for antialiasing."""
EDGE_RAYS = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))
"""Offsets of the antialiasing rays from the pixel centre: a rotated square [pixel]."""


@wp.struct
class InstanceArrays:
    """The instances of one frame, and the concatenated corner normals of all meshes."""

    tree: wp.uint64
    mesh: wp.array[wp.uint64]
    first_face: wp.array[int]
    flat: wp.array[wp.bool]
    cut: wp.array[int]
    position: wp.array[wp.vec3]
    orientation: wp.array[wp.quat]
    color: wp.array[wp.vec3]
    gloss: wp.array[wp.vec2]  # roughness and metallic
    textures: Textures
    normals: wp.array2d[wp.vec3]
    section_point: wp.vec3  # of the plane that cuts bodies open
    section_normal: wp.vec3  # toward the camera
    plane: wp.array[int]  # instances that are infinite planes, drawn from their front
    plane_normal: wp.array[wp.vec3]
    plane_offset: wp.array[float]


@wp.struct
class Hit:
    """The nearest surface along a ray; `instance` is -1 without a hit, `face` on an infinite plane."""

    instance: int
    face: int
    u: float  # weights of the first two corners of the triangle
    v: float
    distance: float
    normal: wp.vec3


@wp.struct
class Surfaces:
    """What the rays through some image points have met."""

    instance: wp.array[int]
    point: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    color: wp.array[wp.vec3]
    haze: wp.array[float]
    sun: wp.array[float]  # visible part of the lamp
    sky: wp.array[float]  # visible part of the sky


@wp.func
def ray_range(instances: InstanceArrays, i: int, origin: wp.vec3, direction: wp.vec3) -> wp.vec2:
    """Distances between which a ray can meet an instance: all, or the part behind the section plane."""
    if instances.cut[i] != CUT:
        return wp.vec2(0.0, FAR)
    above = wp.dot(origin - instances.section_point, instances.section_normal)
    slope = wp.dot(direction, instances.section_normal)
    crossing = FAR
    if wp.abs(slope) > 1.0e-9:
        crossing = -above / slope
    if above > 0.0:  # before the plane: it begins where the ray goes behind it
        return wp.vec2(wp.where(crossing > 0.0, crossing, FAR), FAR)
    return wp.vec2(0.0, wp.where(crossing > 0.0, crossing, FAR))


@wp.func
def smooth_normal(instances: InstanceArrays, i: int, face: int, u: float, v: float) -> wp.vec3:
    """Normal at a point of a triangle, in the world."""
    row = instances.first_face[i] + face
    local = u * instances.normals[row, 0] + v * instances.normals[row, 1] + (1.0 - u - v) * instances.normals[row, 2]
    return wp.normalize(wp.quat_rotate(instances.orientation[i], local))


@wp.func
def nearest(instances: InstanceArrays, origin: wp.vec3, direction: wp.vec3) -> Hit:
    """Nearest hit of a ray with the instances and the infinite planes."""
    hit = Hit()
    hit.instance = -1
    hit.distance = FAR
    for k in range(instances.plane.shape[0]):
        slope = wp.dot(direction, instances.plane_normal[k])
        if slope < 0.0:
            t = (instances.plane_offset[k] - wp.dot(origin, instances.plane_normal[k])) / slope
            if t > 0.0 and t < hit.distance:
                hit.instance = instances.plane[k]
                hit.face = -1
                hit.distance = t
                hit.normal = instances.plane_normal[k]
    candidates = wp.bvh_query_ray(instances.tree, origin, direction)
    i = int(0)
    while wp.bvh_query_next(candidates, i, hit.distance):
        if instances.cut[i] == REMOVED:
            continue
        limits = ray_range(instances, i, origin, direction)
        inverse = wp.quat_inverse(instances.orientation[i])
        start = wp.quat_rotate(inverse, origin + limits[0] * direction - instances.position[i])
        local = wp.quat_rotate(inverse, direction)
        farthest = wp.min(hit.distance, limits[1]) - limits[0]
        if farthest <= 0.0:
            continue
        query = wp.mesh_query_ray(instances.mesh[i], start, local, farthest)
        if query.result:
            hit.instance = i
            hit.face = query.face
            hit.u = query.u
            hit.v = query.v
            hit.distance = limits[0] + query.t
            hit.normal = smooth_normal(instances, i, query.face, query.u, query.v)
    return hit


@wp.func
def blocked(instances: InstanceArrays, origin: wp.vec3, direction: wp.vec3, reach: float) -> float:
    """1 if anything is within `reach` along a ray, else 0. Planes bound half spaces, which cannot be in the way."""
    candidates = wp.bvh_query_ray(instances.tree, origin, direction)
    i = int(0)
    while wp.bvh_query_next(candidates, i, reach):
        if instances.cut[i] == REMOVED:
            continue
        limits = ray_range(instances, i, origin, direction)
        length = wp.min(reach, limits[1]) - limits[0]
        if length <= 0.0:
            continue
        inverse = wp.quat_inverse(instances.orientation[i])
        start = wp.quat_rotate(inverse, origin + limits[0] * direction - instances.position[i])
        if wp.mesh_query_ray_anyhit(instances.mesh[i], start, wp.quat_rotate(inverse, direction), length):
            return 1.0
    return 0.0


@wp.func
def disc_point(index: int) -> wp.vec2:
    """Point number `index` of evenly distributed points in the unit disc."""
    radius = wp.sqrt(wp.frac(0.5 + float(index) * GOLDEN_X))
    angle = 2.0 * wp.pi * wp.frac(0.5 + float(index) * GOLDEN_Y)
    return radius * wp.vec2(wp.cos(angle), wp.sin(angle))


@wp.func
def visible_lamp(instances: InstanceArrays, camera: CameraView, point: wp.vec3, first: int, rays: int) -> float:
    """Visible part of the lamp, from `rays` rays of the sequence."""
    right = tangent_of(camera.light)
    up = wp.cross(camera.light, right)
    dark = float(0.0)
    for k in range(rays):
        at = camera.lamp_radius * disc_point(first + k)
        dark += blocked(instances, point, wp.normalize(camera.light + at[0] * right + at[1] * up), FAR)
    return 1.0 - dark / float(rays)


@wp.func
def visible_sky(
    instances: InstanceArrays, camera: CameraView, point: wp.vec3, normal: wp.vec3, first: int, rays: int
) -> float:
    """Part of the sky that is not occluded nearby, weighted by the cosine, from `rays` rays of the sequence."""
    if camera.shade_reach <= 0.0:
        return 1.0
    right = tangent_of(normal)
    up = wp.cross(normal, right)
    dark = float(0.0)
    for k in range(rays):
        at = disc_point(first + k)
        height = wp.sqrt(wp.max(0.0, 1.0 - wp.dot(at, at)))
        dark += blocked(instances, point, at[0] * right + at[1] * up + height * normal, camera.shade_reach)
    return 1.0 - dark / float(rays)


@wp.kernel
def trace(
    first: int,
    camera: CameraView,
    instances: InstanceArrays,
    at: wp.array[wp.vec2],
    seed: wp.array[int],
    rays: int,
    seen: Surfaces,
):
    """One primary ray per thread, through the image point `at` (-1 to 1, right and up), with its shadow rays."""
    ray = first + wp.tid()
    direction = wp.normalize(camera.forward + at[ray][0] * camera.right + at[ray][1] * camera.up)
    hit = nearest(instances, camera.eye, direction)
    i = hit.instance
    seen.instance[ray] = i
    if i < 0:
        seen.color[ray] = sky_color(direction)
        return
    normal = hit.normal
    slope = wp.dot(normal, direction)
    color = instances.color[i]
    pixel = hit.distance * camera.pixel
    steepness = wp.max(wp.abs(slope), 0.02)
    if hit.face >= 0:
        row = instances.first_face[i] + hit.face
        color = texture_color(instances.textures, i, row, hit.u, hit.v, pixel / wp.sqrt(steepness), color)
    if slope > 0.0:
        normal = -normal
        if instances.cut[i] == CUT:
            color = SECTION_SHADE * color
    point = camera.eye + hit.distance * direction
    haze = float(0.0)
    if instances.flat[i]:
        if instances.textures.level[i] < 0:
            color = color * grid_shade(point, normal, camera.grid, pixel / steepness)
        haze = 1.0 - wp.exp(-wp.max(hit.distance / camera.haze - 1.0, 0.0))
    start = point + 2.0e-4 * hit.distance * normal
    sun = float(0.0)
    if wp.dot(normal, camera.light) > 0.0:
        sun = visible_lamp(instances, camera, start, rays * seed[ray], rays)
    seen.point[ray] = point
    seen.normal[ray] = normal
    seen.color[ray] = color
    seen.haze[ray] = haze
    seen.sun[ray] = sun
    seen.sky[ray] = visible_sky(instances, camera, start, normal, rays * seed[ray], rays)


@wp.kernel
def compose(
    first: int,
    width: int,
    radius: int,
    camera: CameraView,
    gloss: wp.array[wp.vec2],
    seen: Surfaces,
    color: wp.array[wp.vec3],
):
    """Colour of each ray; the visible parts of lamp and sky are averaged over neighbours on the same surface.

    The window is 2 radius wide, so that with radius TILE / 2 it holds every direction once; 0 averages nothing.
    """
    ray = first + wp.tid()
    i = seen.instance[ray]
    if i < 0:
        color[ray] = seen.color[ray]
        return
    sun, sky, count = float(0.0), float(0.0), float(0.0)
    x, y = ray % width, ray // width
    reach = 12.0 * camera.pixel * wp.length(seen.point[ray] - camera.eye)
    for v in range(wp.max(0, y - radius), wp.min(seen.instance.shape[0] // width, y + radius)):
        for u in range(wp.max(0, x - radius), wp.min(width, x + radius)):
            other = v * width + u
            if seen.instance[other] == i and wp.dot(seen.normal[other], seen.normal[ray]) > 0.95:
                if wp.abs(wp.dot(seen.point[other] - seen.point[ray], seen.normal[ray])) < reach:
                    sun += seen.sun[other]
                    sky += seen.sky[other]
                    count += 1.0
    if count == 0.0 or camera.lamp_radius <= 0.0:
        sun = 1.0 * seen.sun[ray]
        sky = 1.0 * seen.sky[ray]
        count = 1.0
    if gloss[i][0] >= 1.0 and gloss[i][1] <= 0.0:
        lit = lit_color(camera, seen.color[ray], seen.normal[ray], sun / count, sky / count)
    else:
        lit = glossy_color(
            camera, seen.color[ray], seen.normal[ray], seen.point[ray], gloss[i], sun / count, sky / count
        )
    color[ray] = wp.lerp(lit, HORIZON_COLOR, seen.haze[ray])


@wp.kernel
def find_hidden(
    eye: wp.vec3,
    instances: InstanceArrays,
    fixed: wp.array[int],
    target: wp.array[wp.vec3],
    hidden: wp.array2d[wp.bool],
):
    """Whether a fixed body lies between the eye and a target."""
    k, t = wp.tid()
    i = fixed[k]
    inverse = wp.quat_inverse(instances.orientation[i])
    start = wp.quat_rotate(inverse, eye - instances.position[i])
    way = wp.quat_rotate(inverse, target[t] - eye)
    hidden[k, t] = wp.mesh_query_ray_anyhit(instances.mesh[i], start, way, 1.0)


class RayCaster:
    """Renders frames of one film.

    Args:
        film: the film.
        camera: the camera. Fixed bodies that hide moving bodies from it are cut away: static walls are left out, hollow
            bodies are cut open.
    """

    @exclusive()  # it changes the default device of all threads
    def __init__(self, film: Film, camera: CameraView):
        """Build the data shared by all frames."""
        load_module(wp.get_device("cpu"), __name__, 1)
        self._film, self._camera = film, camera
        self._threads = min(usable_cores(), 16)
        corners = np.stack([bound_corners(np.concatenate([m.vertices, *m.frames])) for m in film.meshes])
        self._corners = corners[film.mesh]
        flat = film.flat
        waving = np.array([len(mesh.frames) > 0 for mesh in film.meshes])[film.mesh]
        faces = np.array([len(mesh.faces) for mesh in film.meshes])
        self._first_face = np.cumsum(faces) - faces
        with wp.ScopedDevice("cpu"):
            self._meshes = [
                wp.Mesh(wp.array(m.vertices, dtype=wp.vec3), wp.array(m.faces.reshape(-1))) for m in film.meshes
            ]
            ids = np.array([mesh.id for mesh in self._meshes], dtype=np.uint64)[film.mesh]
            self._instances = InstanceArrays()
            self._instances.mesh = wp.array(ids)
            self._instances.first_face = wp.array(self._first_face[film.mesh], dtype=int)
            self._instances.flat = wp.array(flat)
            self._instances.gloss = wp.array(film.gloss, dtype=wp.vec2)
            self._instances.textures = textures_of(film)
            normals = np.concatenate([mesh.normals for mesh in film.meshes])
            self._instances.normals = wp.array(normals, dtype=wp.vec3)
            self._add_planes(endless_planes(film))
            self._cut_away(~film.moving & ~flat & ~waving)

    @exclusive()
    def draw(self, frame: int, width: int, height: int, camera: Any = None) -> np.ndarray:
        """Render one frame, (height, width, 3) uint8 (sRGB), with the camera of the film or another one."""
        camera = camera or self._camera
        self._place_instances(frame)
        x = (2.0 * np.arange(width) + 1.0) / width - 1.0
        y = 1.0 - (2.0 * np.arange(height) + 1.0) / height
        centers = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1)
        rows, columns = np.indices((height, width))
        seeds = rows % TILE * TILE + columns % TILE
        picture = self._cast(camera, centers.reshape(-1, 2), seeds.reshape(-1), width, TILE // 2)
        picture = picture.reshape(height, width, 3)
        screen = on_screen(picture)
        edges = _edges(screen)
        turns = np.array(EDGE_RAYS) * (2.0 / width, 2.0 / height)
        finer = (centers[edges][:, None] + turns).reshape(-1, 2)
        own = (seeds[edges][:, None] + TILE * np.arange(len(EDGE_RAYS))).reshape(-1) % TILE**2
        colors = self._cast(camera, finer, own, len(EDGE_RAYS), 0)
        screen[edges] = on_screen(colors.reshape(-1, len(EDGE_RAYS), 3).mean(axis=1))
        return np.round(255.0 * screen).astype(np.uint8)

    def _add_planes(self, endless: np.ndarray) -> None:
        """Replace the squares of endless planes by infinite planes."""
        film, chosen = self._film, np.flatnonzero(endless)
        local = np.array([film.meshes[k].normals[0, 0] for k in film.mesh[chosen]]).reshape(-1, 3)
        normal = rotate(film.orientation[0][chosen], local)
        place = np.array([film.meshes[k].vertices.mean(axis=0) for k in film.mesh[chosen]]).reshape(-1, 3)
        place = rotate(film.orientation[0][chosen], place) + film.position[0][chosen]
        self._instances.plane = wp.array(chosen, dtype=int)
        self._instances.plane_normal = wp.array(normal, dtype=wp.vec3)
        self._instances.plane_offset = wp.array((normal * place).sum(axis=1), dtype=float)
        self._cut = np.where(endless, REMOVED, WHOLE)

    def _cut_away(self, fixed: np.ndarray) -> None:
        """Cut away fixed bodies that hide more than HIDDEN_PART of the moving bodies."""
        candidates = np.flatnonzero(fixed)
        spaced = slice(None, None, max(1, self._film.num_frames // HIDDEN_TIMES))
        times, present = (of[spaced, self._film.moving] for of in (self._film.position, self._film.present))
        places = times.reshape(-1, 3)
        if len(candidates) and present.any():
            self._place_instances(0)
            targets = wp.array(places, dtype=wp.vec3)
            hidden = wp.zeros((len(candidates), len(targets)), dtype=wp.bool)
            arguments = [self._camera.eye, self._instances, wp.array(candidates, dtype=int), targets]
            wp.launch(find_hidden, hidden.shape, arguments, outputs=[hidden])
            hiding = hidden.numpy().reshape(-1, *present.shape) & present
            count = present.sum(axis=1).clip(min=1)
            cut = self._cut.copy()
            for k, i in enumerate(candidates):
                size = np.sort(np.ptp(self._corners[i], axis=0))
                thin = size[0] < WALL_THICKNESS * size[1]
                if thin and hiding[k].sum() / present.sum() * len(self._film.labels) > HIDDEN_PART:
                    # A kinematic wall, such as a gate, is part of what happens, even if it does not move in this film.
                    cut[i] = REMOVED if self._film.motion[i] == Motion.STATIC else WHOLE
                elif not thin and (hiding[k].sum(axis=1) / count).max() > HIDDEN_INSIDE:
                    inside = self._mostly_inside(i, times).reshape(present.shape)
                    if ((hiding[k] & inside).sum(axis=1) / count).max() > HIDDEN_INSIDE:
                        cut[i] = CUT
            toward = np.array(self._camera.forward) * (-1.0, -1.0, 0.0)
            self._instances.section_normal = wp.vec3(*(toward / max(np.linalg.norm(toward), 1e-9)))
            self._instances.section_point = wp.vec3(*np.median(times[present], axis=0))
            self._cut = cut

    def _mostly_inside(self, fixed: int, times: np.ndarray) -> np.ndarray:
        """Whether moving bodies are in the hull of a fixed one: their middle, and half of the corners of their bounds.

        A body around the fixed one, such as a nut on a bolt, has its middle there, but not its corners.

        Args:
            fixed: index of the fixed body.
            times: (times, moving bodies, 3) positions [m].
        """
        film = self._film
        spacing = max(1, film.num_frames // HIDDEN_TIMES)
        orientation = film.orientation[::spacing, film.moving]
        corners = rotate(orientation[:, :, None], self._corners[film.moving][None]) + times[:, :, None]
        points = np.concatenate([times[:, :, None], corners], axis=2).reshape(-1, 3)
        local = rotate(inverse(film.orientation[0][fixed]), points - film.position[0][fixed])
        directions, _ = geodesic(4)  # 162, which stand for all
        reach = (film.meshes[film.mesh[fixed]].vertices @ directions.T).max(axis=0)
        inside = (local @ directions.T <= reach).all(axis=1).reshape(-1, 9)
        return inside[:, 0] & (inside[:, 1:].mean(axis=1) >= 0.5)

    def _place_instances(self, frame: int) -> None:
        for index, mesh in enumerate(self._film.meshes):
            if mesh.frames:
                self._meshes[index].points.assign(mesh.frames[frame])
                self._meshes[index].refit()
                first = int(self._first_face[index])
                rows = self._instances.normals[first : first + len(mesh.faces)]
                rows.assign(corner_normals(mesh.frames[frame], mesh.faces))
        position, orientation = self._film.position[frame], self._film.orientation[frame]
        corners = rotate(orientation[:, None], self._corners) + position[:, None]
        with wp.ScopedDevice("cpu"):
            self._instances.cut = wp.array(np.where(self._film.present[frame], self._cut, REMOVED), dtype=int)
            self._instances.color = wp.array(self._film.color_at(frame), dtype=wp.vec3)
            self._instances.position = wp.array(position, dtype=wp.vec3)
            self._instances.orientation = wp.array(orientation, dtype=wp.quat)
            self._tree = wp.Bvh(
                wp.array(corners.min(axis=1), dtype=wp.vec3),
                wp.array(corners.max(axis=1), dtype=wp.vec3),
            )
        self._instances.tree = self._tree.id

    def _cast(self, camera: CameraView, places: np.ndarray, seeds: np.ndarray, width: int, radius: int) -> np.ndarray:
        """Linear RGB colours of rays through image points in rows of `width`."""
        count = len(places)
        if count == 0:
            return np.zeros((0, 3), np.float32)
        with wp.ScopedDevice("cpu"):
            at, seed = wp.array(places, dtype=wp.vec2), wp.array(seeds, dtype=int)
            seen = Surfaces()
            for name, kind in (("instance", int), ("haze", float), ("sun", float), ("sky", float)):
                setattr(seen, name, wp.zeros(count, dtype=kind))
            for name in ("point", "normal", "color"):
                setattr(seen, name, wp.zeros(count, dtype=wp.vec3))
            color = wp.zeros(count, dtype=wp.vec3)
        rays = RAYS if radius else RAYS_AT_EDGES
        self._launch(trace, count, lambda first: [first, camera, self._instances, at, seed, rays, seen])
        self._launch(compose, count, lambda first: [first, width, radius, camera, self._instances.gloss, seen, color])
        return color.numpy().copy()

    def _launch(self, kernel, count: int, arguments) -> None:
        """Launch a kernel in parts; a CPU launch runs on the calling thread and releases the GIL."""
        cuts = np.linspace(0, count, 4 * self._threads + 1, dtype=int)

        def work(part):
            first, end = int(cuts[part]), int(cuts[part + 1])
            wp.launch(kernel, end - first, arguments(first), device="cpu")

        spread(work, range(len(cuts) - 1), self._threads)


def endless_planes(film: Film) -> np.ndarray:
    """(instances,) True for the squares that stand for infinite planes.

    A tilted plane of one of several environments is drawn as a square, so that it does not cut through the others.
    """
    square = film.flat & ~film.moving & (np.array([len(mesh.faces) for mesh in film.meshes])[film.mesh] == 2)
    square &= film.present.all(axis=0)
    return square & (film.level | (len(film.labels) == 1))


def _edges(picture: np.ndarray) -> np.ndarray:
    """(height, width) True for both pixels of each pair of neighbours with a contrast above EDGE_CONTRAST."""
    edges = np.zeros(picture.shape[:2], dtype=bool)
    # One channel after the other: a maximum along an axis of three elements takes ten times as long.
    down, right = (
        np.logical_or.reduce([np.abs(np.diff(picture[..., k], axis=axis)) > EDGE_CONTRAST for k in range(3)])
        for axis in (0, 1)
    )
    edges[1:] |= down
    edges[:-1] |= down
    edges[:, 1:] |= right
    edges[:, :-1] |= right
    return edges
