"""Parts of all pages: the server, light, camera and labels."""

import contextlib
import io
import math
from collections.abc import Iterator

import numpy as np
import rich
import viser

from warp_rigid.render.camera import FIELD_OF_VIEW as FITTED_FIELD
from warp_rigid.render.camera import TOWARD_LIGHT, fit_camera, points_to_see
from warp_rigid.render.film import Film
from warp_rigid.render.raycast import WALL_THICKNESS
from warp_rigid.rotations import rotate
from warp_rigid.viewer.server import CheckedServer

__all__ = [
    "add_ground",
    "add_labels",
    "ground_heights",
    "keep_above_ground",
    "level_planes",
    "look_at_film",
    "look_from",
    "look_from_page",
    "opacity_of_walls",
    "png_bytes",
    "set_light",
    "start_server",
    "stop_server",
]

ZENITH, HORIZON, GROUND = (176, 200, 224), (238, 241, 243), (214, 214, 210)
"""Colours of the sky and of infinite grounds."""
LAMP_LIGHT, SKY_LIGHT = 2.1, 1.4
"""Strengths with which a white surface that faces the lamp is about white on the page."""
FIELD_OF_VIEW = math.radians(40.0)
USUAL_SIZE = (1280, 900)
"""Width and height of the view that is assumed until a page reports its own [pixel]."""
ROOM = 1.5
"""Distance of the camera, relative to the one at which the bodies fill the view: they will move."""


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
    places = [
        film.position[0][i, 2] + film.meshes[film.mesh[i]].vertices[0, 2] for i in np.flatnonzero(level_planes(film))
    ]
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


def level_planes(film: Film) -> np.ndarray:
    """(instances,) True for planes that lie level and fixed, which are drawn as one endless ground."""
    flat = np.array([mesh.flat for mesh in film.meshes])[film.mesh] & ~film.moving
    normals = np.array([mesh.normals[0, 0] if mesh.flat else (0.0, 0.0, 0.0) for mesh in film.meshes])[film.mesh]
    return flat & (rotate(film.orientation[0], normals)[:, 2] > 1.0 - 1.0e-6)


def opacity_of_walls(film: Film) -> np.ndarray:
    """(instances,) less than 1 for fixed, thin, upright bodies, behind which others may lie."""
    sizes = np.stack([np.ptp(mesh.vertices, axis=0) for mesh in film.meshes])[film.mesh]
    thinnest = sizes.argmin(axis=1)
    thin = sizes.min(axis=1) < WALL_THICKNESS * np.median(sizes, axis=1)
    upright = np.abs(rotate(film.orientation[0], np.eye(3)[thinnest])[:, 2]) < 0.5
    flat = np.array([mesh.flat for mesh in film.meshes])[film.mesh]
    return np.where(thin & upright & ~flat & ~film.moving, 0.35, 1.0)


def look_at_film(server: viser.ViserServer, film: Film) -> None:
    """Place the camera so that the film's bodies are seen: for pages opened later, and for those open now."""
    for client in server.get_clients().values():
        look_from_page(client, film)
    look_from(server.initial_camera, film, *USUAL_SIZE)


def look_from_page(client: viser.ClientHandle, film: Film) -> None:
    """Place the camera of an open page."""
    size = client.camera.image_width, client.camera.image_height
    usable = all(isinstance(part, int | float) and math.isfinite(part) and part >= 1 for part in size)
    # A page that has reported an impossible camera keeps it.
    with contextlib.suppress(ValueError):
        look_from(client.camera, film, *(size if usable else USUAL_SIZE))


def look_from(view, film: Film, width: int, height: int) -> None:
    """Place a camera so that the film's bodies fill the view.

    Args:
        view: viser's camera.
        film: the film.
        width: width of the view, without the panel [pixel].
        height: height of the view [pixel].
    """
    points = points_to_see(film, np.unique(np.linspace(0, film.num_frames - 1, 12).astype(int)))
    camera = fit_camera(points, width / height, height, film.view)
    eye, ahead = np.array(camera.eye), np.array(camera.forward)
    target = eye + ahead * float(np.median((points - eye) @ ahead))
    half = math.tan(0.5 * FIELD_OF_VIEW)
    room = ROOM if film.num_frames == 1 else 1.0
    eye = target + room * math.tan(0.5 * FITTED_FIELD) / half * (eye - target)
    view.fov = FIELD_OF_VIEW
    # The nearer the first visible distance, the less of the depth's precision is left for the rest.
    view.near = 0.02 * float(np.linalg.norm(eye - target))
    view.position = tuple(eye)
    view.look_at = tuple(target)


def keep_above_ground(client: viser.ClientHandle, heights: list[float]) -> None:
    """Lift the camera of a page if it is below the lowest of the grounds [m]."""
    camera = client.camera
    if heights:
        lowest = min(heights) + 0.02 * float(np.linalg.norm(camera.position - camera.look_at))
        if camera.position[2] < lowest - 1e-6:
            with contextlib.suppress(ValueError):
                camera.position = (camera.position[0], camera.position[1], lowest)


def png_bytes(picture: np.ndarray) -> bytes:
    """A picture (height, width, 3) uint8 as the content of a PNG file."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="PNG")
    return file.getvalue()


def add_labels(server: viser.ViserServer, film: Film) -> list:
    """The environments' labels above the ground in front of each."""
    handles = []
    for index, text in enumerate(film.labels):
        if text:
            handles.append(
                server.scene.add_label(
                    f"/label_{index}", text, position=tuple(film.offset[index]), anchor="top-center", depth_test=False
                )
            )
    return handles
