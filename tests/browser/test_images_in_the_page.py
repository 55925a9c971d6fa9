"""Bodies with an image in the page: the pixels of the image are at their places, in their colours."""

import numpy as np
import trimesh
from PIL import Image

import warp_rigid as wr
from warp_rigid.render.film import film_from_recording
from warp_rigid.scene.look import Look
from warp_rigid.viewer.playback import save_html

COLORS = np.array([[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (200, 120, 60)]], np.uint8)
"""The image, upper row first."""


def slab_scene(folder):
    """A slab whose upper side shows the image upright, and beside it a box of the colour of its last pixel."""
    Image.fromarray(COLORS).resize((64, 64), Image.Resampling.NEAREST).save(folder / "image.png")
    slab = trimesh.creation.box((2, 2, 0.2))
    scene = wr.Scene(camera=wr.Camera(position=(1.5, -1e-2, 9.0), look_at=(1.5, 0, 0), field_of_view=45.0))
    scene.add_static(wr.Plane(offset=-0.1))
    first = scene.add_body(wr.Mesh(slab.vertices, slab.faces, 16, uv=0.5 * (slab.vertices[:, :2] + 1.0)), name="slab")
    plain = scene.add_body(wr.Box((1, 1, 0.1)), position=(3, 0, 0), name="plain")
    light = ((COLORS[1, 1] / 255 + 0.055) / 1.055) ** 2.4
    scene.looks = {first: Look(None, 1.0, 0.0, folder / "image.png"), plain: Look(tuple(light), 1.0, 0.0)}
    return scene


def assert_image_seen(found):
    """The hues of three quarters of the image; the last one has the colour of the box.

    Args:
        found: a function of a point of the world: the colour of its pixel.
    """
    quarters = [found((x, y, 0.1)) for y in (0.5, -0.5) for x in (-0.5, 0.5)]
    assert [int(np.argmax(color)) for color in quarters[:3]] == [0, 1, 2]
    assert all(np.sort(color)[-1] > np.sort(color)[-2] + 80 for color in quarters[:3]), quarters
    np.testing.assert_allclose(quarters[3], found((3.0, 0.0, 0.1)), atol=4)


def test_the_live_page_shows_images_until_other_colours_are_chosen(stage, tmp_path):
    slab_scene(tmp_path)
    (tmp_path / "slab.py").write_text(
        f"from pathlib import Path\nfrom tests.browser.test_images_in_the_page import slab_scene\n\n"
        f"def scene():\n    return slab_scene(Path({str(tmp_path)!r}))\n"
    )
    live = stage(str(tmp_path / "slab.py"))
    live.press("Space")
    live.until(lambda: live.session.time > 0.1, "it runs")
    live.press("Space")
    live.until(lambda: not live.session.running, "it pauses")
    picture = live.still()

    def pixel(point):
        x, y = live.on_screen(point)
        return picture[round(y), round(x)]

    assert_image_seen(pixel)
    live.viewer.ask(live.viewer.option, "coloring", "speed")
    live.done()
    picture = live.still()
    quarters = [pixel((x, y, 0.1)) for y in (0.5, -0.5) for x in (-0.5, 0.5)]
    assert np.ptp(quarters, axis=0).max() < 8
    live.viewer.ask(live.viewer.option, "coloring", "body")
    live.done()
    picture = live.still()
    assert_image_seen(pixel)


def test_a_page_of_its_own_has_the_image_in_it(page, tmp_path):
    film = film_from_recording(wr.record(wr.Simulator(slab_scene(tmp_path), device="cpu"), frames=2))
    save_html(film, tmp_path / "film.html", fast=True)
    (tmp_path / "image.png").unlink()
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto((tmp_path / "film.html").as_uri() + "?fixedDpr=1")
    page.wait_for_selector("canvas")
    page.add_style_tag(content=".mantine-Notification-root {display: none !important}")
    page.wait_for_timeout(3000)
    page.screenshot(path=tmp_path / "page.png")
    picture = np.asarray(Image.open(tmp_path / "page.png").convert("RGB")).astype(int)
    colors = picture[:330].reshape(-1, 3)
    for channel in range(3):
        others = np.delete(colors, channel, axis=1).max(axis=1)
        assert (colors[:, channel] > others + 80).sum() > 500
    assert not errors
