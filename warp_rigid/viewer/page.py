"""Parts of all pages: the server, light, camera and labels."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import rich
import viser

from warp_rigid.render.film import Film
from warp_rigid.render.framing import (
    TOWARD_LIGHT,
    camera_directions,
    fit_camera,
    is_placed,
    place_camera,
    points_to_see,
    shifted,
)
from warp_rigid.render.raycast import WALL_THICKNESS
from warp_rigid.rotations import rotate
from warp_rigid.scene.camera import NARROWEST
from warp_rigid.viewer.server import CheckedServer

ZENITH, HORIZON, GROUND = (176, 200, 224), (238, 241, 243), (214, 214, 210)
"""Colours of the sky and of infinite grounds."""
LAMP_LIGHT, SKY_LIGHT = 2.1, 1.4
"""Strengths with which a white surface that faces the lamp is about white on the page."""
USUAL_SIZE = (1280, 900)
"""Width and height of the view that is assumed until a page reports its own [pixel]."""
ROOM = 1.5
"""Distance of the camera, relative to the one at which the bodies fill the view: they will move."""
FALL = 4.0
"""Height above the ground, relative to the size of all bodies together, up to which the ground below is in view."""
SETTLING = 10.0
"""Time after opening in which a page takes its size [s]."""
STILL = 1.0e-4
"""Motion of a followed body that moves no camera, relative to its distance."""
NARROW, UPRIGHT = 576, 0.75
"""Width, and width relative to the height, below which the panel covers the lower part of a page [pixel]."""
UNCOVERED = 0.4
"""Upper part of such a page that the panel does not cover."""
UNTOUCHED = 0.01
"""Motion of a camera by the user that counts as none, relative to its distance: pages report rounded numbers."""
STEEPEST = 89.9
"""Largest elevation of the camera: viser loses the horizon where it looks straight up or down [degree]."""


_placed: WeakKeyDictionary[viser.ClientHandle, np.ndarray] = WeakKeyDictionary()
"""Where the cameras of open pages were placed last [m]."""


def start_server(host: str, port: int) -> CheckedServer:
    """Serve on the first free port from `port` on, without console output.

    Raises:
        ValueError: as CheckedServer.
    """
    with _silent_console():
        server = CheckedServer(host, port)
    server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(46, 110, 190))
    server.gui.main_panel.dock_right()
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Close all pages, without console output."""
    with _silent_console():
        server.stop()


def on_each_page(server: viser.ViserServer, action: Callable[[viser.ClientHandle], None]) -> None:
    """Call an action for each page, in a thread of its own: it may wait for the page, and viser's threads are few."""
    server.on_client_connect(lambda client: threading.Thread(target=action, args=(client,), daemon=True).start())


@contextlib.contextmanager
def _silent_console() -> Iterator[None]:
    """Let viser, which prints with rich, print nothing: neither on stdout nor in a notebook."""
    shown = rich.get_console()
    before, shown.quiet = shown.quiet, True
    try:
        yield
    finally:
        shown.quiet = before


def set_light(server: viser.ViserServer, fast: bool) -> None:
    """Add sky light and a lamp, which casts shadows unless `fast`."""
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(enabled=False)
    server.scene.add_light_directional(
        "/lamp", color=(255, 246, 232), intensity=LAMP_LIGHT, cast_shadow=not fast, position=TOWARD_LIGHT
    )
    server.scene.add_light_hemisphere(
        "/light", sky_color=(236, 242, 255), ground_color=(150, 140, 128), intensity=SKY_LIGHT
    )
    rows = np.linspace(0.0, 1.0, 64)[:, None, None]
    sky = (1.0 - rows) * np.array(ZENITH) + rows * np.array(HORIZON)
    server.scene.set_background_image(np.broadcast_to(sky, (64, 4, 3)).astype(np.uint8), format="png")


def ground_heights(film: Film) -> list[float]:
    """Heights at which level planes lie [m]."""
    places = [film.position[0][i, 2] + film.meshes[film.mesh[i]].vertices[0, 2] for i in np.flatnonzero(film.level)]
    return sorted({round(float(place), 6) for place in places})


def add_ground(server: viser.ViserServer, film: Film) -> list:
    """Add an infinite grid for each height at which a level plane lies; returns the handles."""
    heights = ground_heights(film)
    cell = float(fit_camera(points_to_see(film, [0]), 1.0, 480).grid)
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    handles = []
    for index, height in enumerate(heights):
        grid = server.scene.add_grid(
            f"/ground_{index}",
            infinite_grid=True,
            plane="xy",
            position=(0.0, 0.0, height),
            cell_size=cell,
            section_size=5.0 * cell,
            cell_color=(176, 178, 178),
            section_color=(150, 154, 158),
            fade_distance=150.0 * cell,
            shadow_opacity=0.3,
            plane_color=GROUND,
            plane_opacity=1.0,
        )
        # What lies below shines through the grid; a sheet under it, just large enough, hides that.
        sheet = server.scene.add_mesh_simple(
            f"/ground_{index}/sheet",
            25.0 * cell * square,
            np.array([[0, 1, 2], [0, 2, 3]]),
            color=GROUND,
            position=(0.0, 0.0, -0.02 * cell),
            cast_shadow=False,
            receive_shadow=False,
        )
        handles += [sheet, grid]
    return handles


def opacity_of_walls(film: Film) -> np.ndarray:
    """(instances,) less than 1 for fixed, thin, upright bodies without an image, behind which others may lie."""
    sizes = np.stack([np.ptp(mesh.vertices, axis=0) for mesh in film.meshes])[film.mesh]
    thinnest = sizes.argmin(axis=1)
    thin = sizes.min(axis=1) < WALL_THICKNESS * np.median(sizes, axis=1)
    upright = np.abs(rotate(film.orientation[0], np.eye(3)[thinnest])[:, 2]) < 0.5
    return np.where(thin & upright & ~film.flat & ~film.moving & (film.image < 0), 0.35, 1.0)


def _below(film: Film, points: np.ndarray) -> np.ndarray:
    """Where points that are not too high above a level ground will land, (n, 3) [m]: bodies are seen to fall."""
    middle, size = points.mean(axis=0), float(np.linalg.norm(np.ptp(points, axis=0)))
    heights = [height for height in ground_heights(film) if middle[2] - FALL * size < height < middle[2]]
    return points * (1.0, 1.0, 0.0) + (0.0, 0.0, max(heights)) if heights else points[:0]


def look_at_film(server: viser.ViserServer, film: Film) -> None:
    """Place the camera so that the film's bodies are seen: for pages opened later, and for those open now."""
    for client in server.get_clients().values():
        look_from_page(client, film)
    look_from(server.initial_camera, film, *USUAL_SIZE)


def keep_framed(client: viser.ClientHandle, film: Callable[[], Film]) -> None:
    """Place the camera of an open page, and again while the page takes its final size.

    The panel narrows the view when it appears.
    """
    sizes: list[tuple[int, int]] = []
    end = time.monotonic() + SETTLING

    def place(_: Any = None) -> None:
        size = client.camera.image_width, client.camera.image_height
        if size not in sizes[-1:] and time.monotonic() < end:
            sizes.append(size)
            look_from_page(client, film())

    client.camera.on_update(place)
    place()


def follow_with_pages(server: viser.ViserServer, film: Film, frame: int) -> None:
    """Move the cameras of open pages with the body that the camera of a film follows; the user may turn and zoom."""
    camera = shifted(film.camera, film.offset[0])
    eye, distance = place_camera(camera, film, frame)
    target = eye - distance * camera_directions(camera)[0]
    for client in server.get_clients().values():
        if np.abs(client.camera.look_at - target).max() > STILL * distance:
            with contextlib.suppress(ValueError):
                # What the page reports may be late, but how it looks at the body does not change by following.
                away = client.camera.position - client.camera.look_at
                client.camera.position = target + away
                client.camera.look_at = target


def look_from_page(client: viser.ClientHandle, film: Film) -> None:
    """Place the camera of an open page."""
    # A page that has reported an impossible camera keeps it.
    with contextlib.suppress(ValueError):
        look_from(client.camera, film, client.camera.image_width, client.camera.image_height)
        _placed[client] = np.array(client.camera.position)


def widen_views(server: viser.ViserServer, film: Film) -> None:
    """Place the cameras of open pages again where bodies have left the view, unless the user has moved the camera.

    Args:
        server: serves the pages.
        film: one frame of the bodies as they are now.
    """
    if is_placed(film.camera):
        return
    points = points_to_see(film, [0])
    for client in server.get_clients().values():
        camera, placed = client.camera, _placed.get(client)
        away = np.linalg.norm(camera.position - camera.look_at)
        untouched = placed is not None and np.abs(camera.position - placed).max() < UNTOUCHED * away
        if untouched and not _in_view(camera, points):
            look_from_page(client, film)


def _in_view(camera: Any, points: np.ndarray) -> bool:
    """Whether a camera of a page shows all points (n, 3) [m]."""
    ahead = camera.look_at - camera.position
    ahead = ahead / max(np.linalg.norm(ahead), 1e-12)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= max(np.linalg.norm(right), 1e-12)
    to = points - camera.position
    tall = math.tan(0.5 * camera.fov) * (to @ ahead)
    wide = tall * camera.image_width / camera.image_height
    return bool(((np.abs(to @ right) < wide) & (np.abs(to @ np.cross(right, ahead)) < tall)).all())


def look_from(view, film: Film, width: int, height: int) -> None:
    """Place a camera of the page where the camera of the film is.

    Args:
        view: viser's camera.
        film: the film.
        width: width of the view, without the panel [pixel].
        height: height of the view [pixel].
    """
    camera = shifted(film.camera, film.offset[0])
    if abs(camera.elevation) > STEEPEST:
        camera = replace(camera, position=None, elevation=math.copysign(STEEPEST, camera.elevation))
    back, _, up = camera_directions(camera)
    tall = math.tan(0.5 * math.radians(camera.field_of_view))
    free = UNCOVERED if width < min(NARROW, UPRIGHT * height) else 1.0
    if is_placed(camera):
        eye, distance = place_camera(camera, film, 0)
    else:
        points = points_to_see(film, np.unique(np.linspace(0, film.num_frames - 1, 12).astype(int)))
        if film.num_frames == 1:
            points = np.concatenate([points, _below(film, points)])
        part = replace(camera, field_of_view=max(NARROWEST, 2.0 * math.degrees(math.atan(free * tall))))
        fitted = fit_camera(points, width / (free * height), height, part)
        eye = np.array(fitted.eye)
        distance = float(np.median((eye - points) @ back))
        room = ROOM if film.num_frames == 1 and camera.distance is None else 1.0
        eye, distance = eye + (room - 1.0) * distance * back, room * distance
    # The middle of the uncovered part is above that of the page.
    eye = eye - (1.0 - free) * tall * distance * up
    view.fov = math.radians(camera.field_of_view)
    # The nearer the first visible distance, the less of the depth's precision is left for the rest.
    view.near = 0.02 * distance
    view.position = tuple(eye)
    view.look_at = tuple(eye - distance * back)


def keep_above_ground(client: viser.ClientHandle, heights: list[float]) -> None:
    """Lift the camera of a page if it is below the lowest of the grounds [m]."""
    camera = client.camera
    if heights:
        lowest = min(heights) + 0.02 * float(np.linalg.norm(camera.position - camera.look_at))
        if camera.position[2] < lowest - 1e-6:
            with contextlib.suppress(ValueError):
                camera.position = (camera.position[0], camera.position[1], lowest)


def add_labels(server: viser.ViserServer, film: Film) -> list:
    """The environments' labels above the ground in front of each."""
    options = {"anchor": "top-center", "depth_test": False}
    return [
        server.scene.add_label(f"/label_{index}", text, position=tuple(film.offset[index]), **options)
        for index, text in enumerate(film.labels)
        if text
    ]
