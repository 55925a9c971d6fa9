"""Ray caster on the CPU, for rendering mesh instances without a display.

Every mesh has its own bounding volume hierarchy, built once per film; each frame builds a hierarchy over the instances.
Each pixel casts a primary ray and a shadow ray.
"""

import numpy as np
import warp as wp

from warp_rigid.engine.cores import spread, usable_cores
from warp_rigid.kernel_cache import load_module
from warp_rigid.render.appearance import bound_corners, corner_normals
from warp_rigid.render.film import Film
from warp_rigid.rotations import rotate
from warp_rigid.threads import exclusive

wp.set_module_options({"enable_backward": False})

__all__ = ["Camera", "RayCaster"]

FAR = wp.constant(1.0e6)
HORIZON_COLOR = wp.constant(wp.vec3(0.72, 0.76, 0.80))
ZENITH_COLOR = wp.constant(wp.vec3(0.42, 0.55, 0.72))
GROUND_GLOW = wp.constant(wp.vec3(0.24, 0.23, 0.22))
SKY_GLOW = wp.constant(wp.vec3(0.40, 0.44, 0.50))
GLASS_TINT = wp.constant(0.18)  # opacity of transparent walls
LIGHT_COLOR = wp.constant(wp.vec3(0.86, 0.82, 0.76))

WALL_THICKNESS = 0.3
"""Maximum ratio of the thickness of a wall to its height and width."""
HIDDEN_PART = 0.1
"""A wall that hides more than this fraction of the moving bodies of an environment is drawn as glass."""
EDGE_CONTRAST = 0.1
"""Minimum sRGB difference between neighbouring pixels for antialiasing."""
EDGE_RAYS = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))
"""Offsets of the antialiasing rays from the pixel centre: a rotated square [pixel]."""


@wp.struct
class Camera:
    """A camera and a light.

    `right` and `up` extend from the centre of the image to its borders, at unit distance from the eye.
    """

    eye: wp.vec3
    forward: wp.vec3
    right: wp.vec3
    up: wp.vec3
    light: wp.vec3
    grid: float  # distance between grid lines on flat grounds [m]
    haze: float  # distance at which grounds start to fade [m]
    pixel: float  # width of a pixel at unit distance from the eye


@wp.struct
class InstanceArrays:
    """The instances of one frame, and the concatenated corner normals of all meshes."""

    tree: wp.uint64
    mesh: wp.array[wp.uint64]
    first_face: wp.array[int]
    flat: wp.array[wp.bool]
    glass: wp.array[wp.bool]
    position: wp.array[wp.vec3]
    orientation: wp.array[wp.quat]
    color: wp.array[wp.vec3]
    normals: wp.array2d[wp.vec3]
    panes: int  # number of glass instances


@wp.struct
class Hit:
    """The nearest surface along a ray; `instance` is -1 without a hit."""

    instance: int
    face: int
    distance: float
    u: float
    v: float


@wp.func
def nearest(instances: InstanceArrays, origin: wp.vec3, direction: wp.vec3, glass: wp.bool) -> Hit:
    """Nearest hit of a ray, either with glass or with opaque instances."""
    hit = Hit()
    hit.instance = -1
    hit.distance = FAR
    candidates = wp.bvh_query_ray(instances.tree, origin, direction)
    i = int(0)
    while wp.bvh_query_next(candidates, i, hit.distance):
        if instances.glass[i] != glass:
            continue
        inverse = wp.quat_inverse(instances.orientation[i])
        local_origin = wp.quat_rotate(inverse, origin - instances.position[i])
        local_direction = wp.quat_rotate(inverse, direction)
        query = wp.mesh_query_ray(instances.mesh[i], local_origin, local_direction, hit.distance)
        if query.result:
            hit.instance = i
            hit.face = query.face
            hit.distance = query.t
            hit.u = query.u
            hit.v = query.v
    return hit


@wp.func
def lit(instances: InstanceArrays, point: wp.vec3, light: wp.vec3) -> float:
    """1 if the light is visible from a point, 0 in shadow; glass casts no shadow."""
    candidates = wp.bvh_query_ray(instances.tree, point, light)
    i = int(0)
    while wp.bvh_query_next(candidates, i):
        if instances.glass[i]:
            continue
        inverse = wp.quat_inverse(instances.orientation[i])
        local_point = wp.quat_rotate(inverse, point - instances.position[i])
        local_light = wp.quat_rotate(inverse, light)
        if wp.mesh_query_ray_anyhit(instances.mesh[i], local_point, local_light, FAR):
            return 0.0
    return 1.0


@wp.func
def line_coverage(coordinate: float, spacing: float, footprint: float) -> float:
    """Fraction of a pixel covered by a grid line; `footprint` is the pixel width on the ground."""
    offset = wp.abs(coordinate / spacing - wp.round(coordinate / spacing)) * spacing
    width = 0.008 * spacing + footprint
    return wp.clamp((width - offset) / footprint, 0.0, 1.0) * wp.min(width / spacing * 8.0, 1.0)


@wp.func
def grid_shade(point: wp.vec3, normal: wp.vec3, spacing: float, footprint: float) -> float:
    """Brightness of a flat ground with grid lines along the two axes closest to its plane."""
    a = point[0]
    b = point[1]
    if wp.abs(normal[0]) > wp.abs(normal[2]):
        a = point[2]
    elif wp.abs(normal[1]) > wp.abs(normal[2]):
        b = point[2]
    fade = wp.clamp(1.0 - 4.0 * footprint / spacing, 0.0, 1.0)
    lines = wp.max(line_coverage(a, spacing, footprint), line_coverage(b, spacing, footprint))
    return 1.0 - 0.35 * fade * lines


@wp.func
def sky(direction: wp.vec3) -> wp.vec3:
    """Background colour."""
    return wp.lerp(HORIZON_COLOR, ZENITH_COLOR, wp.clamp(direction[2], 0.0, 1.0))


@wp.func
def surface_color(instances: InstanceArrays, camera: Camera, hit: Hit, direction: wp.vec3) -> wp.vec3:
    """Colour of a hit, shaded."""
    i = hit.instance
    face = instances.first_face[i] + hit.face
    smooth = (
        hit.u * instances.normals[face, 0]
        + hit.v * instances.normals[face, 1]
        + (1.0 - hit.u - hit.v) * instances.normals[face, 2]
    )
    normal = wp.normalize(wp.quat_rotate(instances.orientation[i], smooth))
    slope = wp.dot(normal, direction)
    if slope > 0.0:
        normal = -normal
    point = camera.eye + hit.distance * direction
    color = instances.color[i]
    if instances.flat[i]:
        footprint = hit.distance * camera.pixel / wp.max(wp.abs(slope), 0.05)
        color = color * grid_shade(point, normal, camera.grid, footprint)
    facing = wp.dot(normal, camera.light)
    if facing > 0.0:
        facing = facing * lit(instances, point + 1.0e-4 * hit.distance * normal, camera.light)
    ambient = wp.lerp(GROUND_GLOW, SKY_GLOW, 0.5 + 0.5 * normal[2])
    light = ambient + wp.max(facing, 0.0) * LIGHT_COLOR
    shaded = wp.cw_mul(color, light)
    if instances.flat[i]:
        haze = wp.clamp(hit.distance / camera.haze - 1.0, 0.0, 1.0)
        shaded = wp.lerp(shaded, HORIZON_COLOR, haze)
    return shaded


@wp.func
def seen_color(instances: InstanceArrays, camera: Camera, direction: wp.vec3) -> wp.vec3:
    """Colour seen along a ray."""
    hit = nearest(instances, camera.eye, direction, False)
    color = sky(direction)
    if hit.instance >= 0:
        color = surface_color(instances, camera, hit, direction)
    if instances.panes == 0:
        return color
    pane = nearest(instances, camera.eye, direction, True)
    if pane.instance >= 0 and pane.distance < hit.distance:
        color = wp.lerp(color, surface_color(instances, camera, pane, direction), GLASS_TINT)
    return color


@wp.kernel
def find_hidden(
    eye: wp.vec3,
    instances: InstanceArrays,
    wall: wp.array[int],
    target: wp.array[wp.vec3],
    hidden: wp.array2d[wp.bool],
):
    """Whether a wall lies between the eye and a target."""
    k, t = wp.tid()
    i = wall[k]
    inverse = wp.quat_inverse(instances.orientation[i])
    start = wp.quat_rotate(inverse, eye - instances.position[i])
    way = wp.quat_rotate(inverse, target[t] - eye)
    hidden[k, t] = wp.mesh_query_ray_anyhit(instances.mesh[i], start, way, 1.0)


@wp.kernel
def cast_rays(
    first: int,
    camera: Camera,
    instances: InstanceArrays,
    point: wp.array[wp.vec2],
    color: wp.array[wp.vec3],
):
    """One ray per thread, through the image point `point` (-1 to 1, right and up)."""
    ray = first + wp.tid()
    at = point[ray]
    direction = wp.normalize(camera.forward + at[0] * camera.right + at[1] * camera.up)
    color[ray] = seen_color(instances, camera, direction)


class RayCaster:
    """Renders frames of one film.

    Args:
        film: the film.
        camera: the camera. Walls that hide moving bodies from it are drawn as glass.
    """

    def __init__(self, film: Film, camera: Camera):
        """Build the data shared by all frames."""
        with exclusive():  # it changes the default device of all threads
            self._upload(film, camera)

    def _upload(self, film: Film, camera: Camera) -> None:
        load_module(wp.get_device("cpu"), __name__, 1)
        self._film, self._camera = film, camera
        self._threads = min(usable_cores(), 16)
        corners = np.stack([bound_corners(np.concatenate([m.vertices, *m.frames])) for m in film.meshes])
        self._corners = corners[film.mesh]
        with wp.ScopedDevice("cpu"):
            self._meshes = [
                wp.Mesh(wp.array(m.vertices, dtype=wp.vec3), wp.array(m.faces.reshape(-1))) for m in film.meshes
            ]
            faces = np.array([len(mesh.faces) for mesh in film.meshes])
            first_face = (np.cumsum(faces) - faces)[film.mesh]
            ids = np.array([mesh.id for mesh in self._meshes], dtype=np.uint64)[film.mesh]
            flat = np.array([mesh.flat for mesh in film.meshes])[film.mesh]
            self._instances = InstanceArrays()
            self._instances.mesh = wp.array(ids)
            self._instances.first_face = wp.array(first_face, dtype=int)
            self._instances.flat = wp.array(flat)
            normals = np.concatenate([mesh.normals for mesh in film.meshes])
            self._instances.normals = wp.array(normals, dtype=wp.vec3)
            self._first_face = np.cumsum(faces) - faces
            waving = np.array([len(mesh.frames) > 0 for mesh in film.meshes])[film.mesh]
            glass = self._hiding_walls(~film.moving & ~flat & ~waving)
            self._instances.glass = wp.array(glass)
            self._instances.panes = int(glass.sum())

    def draw(self, frame: int, width: int, height: int) -> np.ndarray:
        """Render one frame, (height, width, 3) uint8 (sRGB)."""
        with exclusive():
            return self._draw(frame, width, height)

    def _draw(self, frame: int, width: int, height: int) -> np.ndarray:
        self._place_instances(frame)
        x = (2.0 * np.arange(width) + 1.0) / width - 1.0
        y = 1.0 - (2.0 * np.arange(height) + 1.0) / height
        centers = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1)
        picture = self._cast(centers.reshape(-1, 2)).reshape(height, width, 3)
        screen = on_screen(picture)
        edges = _edges(screen)
        turns = np.array(EDGE_RAYS) * (2.0 / width, 2.0 / height)
        finer = self._cast((centers[edges][:, None] + turns).reshape(-1, 2))
        screen[edges] = on_screen(finer.reshape(-1, len(EDGE_RAYS), 3).mean(axis=1))
        return np.round(255.0 * screen).astype(np.uint8)

    def _hiding_walls(self, fixed: np.ndarray) -> np.ndarray:
        """(instances,) True for walls that hide more than HIDDEN_PART of the moving bodies."""
        size = np.sort(np.ptp(self._corners, axis=1), axis=1)
        walls = np.flatnonzero(fixed & (size[:, 0] < WALL_THICKNESS * size[:, 1]))
        targets = self._film.position[:: max(1, self._film.num_frames // 8), self._film.moving]
        glass = np.zeros(len(fixed), dtype=bool)
        if len(walls) and targets.size:
            self._place_instances(0)
            targets = wp.array(targets.reshape(-1, 3), dtype=wp.vec3)
            hidden = wp.zeros((len(walls), len(targets)), dtype=wp.bool)
            arguments = [self._camera.eye, self._instances, wp.array(walls, dtype=int), targets]
            wp.launch(find_hidden, hidden.shape, arguments, outputs=[hidden])
            part = hidden.numpy().mean(axis=1) * len(self._film.labels)
            glass[walls] = part > HIDDEN_PART
        return glass

    def _move_vertices(self, frame: int) -> None:
        """Update the meshes that change their shape."""
        for index, mesh in enumerate(self._film.meshes):
            if mesh.frames:
                vertices = mesh.frames[frame]
                self._meshes[index].points.assign(vertices)
                self._meshes[index].refit()
                first = int(self._first_face[index])
                rows = self._instances.normals[first : first + len(mesh.faces)]
                rows.assign(corner_normals(vertices, mesh.faces))

    def _place_instances(self, frame: int) -> None:
        self._move_vertices(frame)
        position, orientation = self._film.position[frame], self._film.orientation[frame]
        corners = rotate(orientation[:, None], self._corners) + position[:, None]
        with wp.ScopedDevice("cpu"):
            self._instances.color = wp.array(self._film.color_at(frame), dtype=wp.vec3)
            self._instances.position = wp.array(position, dtype=wp.vec3)
            self._instances.orientation = wp.array(orientation, dtype=wp.quat)
            self._tree = wp.Bvh(
                wp.array(corners.min(axis=1), dtype=wp.vec3),
                wp.array(corners.max(axis=1), dtype=wp.vec3),
            )
        self._instances.tree = self._tree.id

    def _cast(self, places: np.ndarray) -> np.ndarray:
        """Linear RGB colours of rays through image points."""
        count = len(places)
        point = wp.array(places, dtype=wp.vec2, device="cpu")
        color = wp.zeros(count, dtype=wp.vec3, device="cpu")
        cuts = np.linspace(0, count, 4 * self._threads + 1, dtype=int)

        # A CPU launch runs on the calling thread and releases the GIL.
        def cast(part):
            first, end = int(cuts[part]), int(cuts[part + 1])
            arguments = [first, self._camera, self._instances, point]
            wp.launch(cast_rays, end - first, arguments, outputs=[color], device="cpu")

        spread(cast, range(len(cuts) - 1), self._threads)
        return color.numpy().copy()


def on_screen(light: np.ndarray) -> np.ndarray:
    """Convert linear RGB to sRGB, both from 0 to 1."""
    light = np.clip(light, 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)


def _edges(picture: np.ndarray) -> np.ndarray:
    """(height, width) True for both pixels of each pair of neighbours with a contrast above EDGE_CONTRAST."""
    edges = np.zeros(picture.shape[:2], dtype=bool)
    down = np.abs(np.diff(picture, axis=0)).max(axis=-1) > EDGE_CONTRAST
    right = np.abs(np.diff(picture, axis=1)).max(axis=-1) > EDGE_CONTRAST
    edges[1:] |= down
    edges[:-1] |= down
    edges[:, 1:] |= right
    edges[:, :-1] |= right
    return edges
