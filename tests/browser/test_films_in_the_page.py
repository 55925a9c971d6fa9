"""Films in the page, and as pages of their own."""

import re
import signal
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import warp_rigid as wr
from warp_rigid.render.film import film_from_recording
from warp_rigid.viewer.playback import FilmViewer, load_film, save_html


@pytest.fixture(scope="module")
def recording():
    scene = wr.Scene()
    scene.add_static(wr.Plane(normal=(0, 0, 1), offset=0.0))
    scene.add_body(wr.Box((0.2, 0.2, 0.2)), position=(-1.0, 0, 0.2), linear_velocity=(0.3, 0, 0), friction=0.0)
    scene.add_body(wr.Sphere(0.2), position=(0, 0.6, 1.5))
    return wr.record(wr.Simulator(scene, device="cpu"), frames=120, fps=15)


def picture(page, path):
    page.screenshot(path=path, clip={"x": 0, "y": 170, "width": 300, "height": 200})
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def changed(before, after):
    return int((np.abs(before - after).max(axis=-1) > 12).sum())


@pytest.mark.parametrize("ending", ["npz", "usdc"])
def test_scrubber_and_play(page, recording, tmp_path, ending):
    path = str(tmp_path / f"film.{ending}")
    if ending == "npz":
        recording.save(path)
    else:
        wr.export_usd(recording, path)
    viewer = FilmViewer(load_film(path), port=8890, fast=True)
    viewer.playing = False
    thread = threading.Thread(target=viewer.run, daemon=True)
    thread.start()
    try:
        page.goto(viewer.server.url)
        page.wait_for_selector("canvas")
        page.get_by_text("of 8.00 s").wait_for()
        page.wait_for_timeout(1000)
        first = picture(page, tmp_path / "first.png")
        assert first.std(axis=(0, 1)).max() > 8.0
        field = page.locator("input[type=text]").first
        field.fill("120")
        field.press("Enter")
        page.get_by_text("8.00 s of 8.00 s").wait_for()
        page.wait_for_timeout(500)
        assert viewer.frame == 120 and not viewer.playing
        assert changed(first, picture(page, tmp_path / "last.png")) > 200
        page.get_by_text("Play / Pause").click()
        page.wait_for_timeout(400)
        assert viewer.playing and viewer.frame != 120
    finally:
        viewer.stop()
        thread.join(10.0)
    assert not thread.is_alive()


def test_page_of_its_own_plays_from_the_disk(page, recording, tmp_path):
    path = tmp_path / "film.html"
    save_html(film_from_recording(recording), path, fast=True)
    asked, errors = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(path.as_uri())
    page.wait_for_selector("canvas")
    page.wait_for_timeout(1500)
    first = picture(page, tmp_path / "first.png")
    assert first.std(axis=(0, 1)).max() > 8.0
    page.wait_for_timeout(1000)
    assert changed(first, picture(page, tmp_path / "later.png")) > 200
    assert not errors
    assert [url for url in asked if not url.startswith(("file:", "blob:", "data:"))] == []


def test_command_serves_the_page_and_ends_with_ctrl_c(page):
    command = [sys.executable, "-u", "-m", "warp_rigid", "view", "incline", "--fast", "--port", "8950"]
    process = subprocess.Popen(
        [*command, "--device", "cpu"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Tests that run in the background ignore Ctrl-C, and what they start would too.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        told = ""
        while "Ctrl-C" not in told:
            told = process.stderr.readline()
            assert told, "the command ended before it told its address"
        url = re.search(r"http://127\.0\.0\.1:\d+/\S+", told).group()
        page.goto(url)
        page.wait_for_selector("canvas")
        page.get_by_text("real time").wait_for()
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60)
        assert process.returncode in (0, 130)
        assert out == ""
    finally:
        if process.poll() is None:
            process.kill()


def test_every_loop_of_a_page_of_its_own_shows_the_same_picture(page, recording, tmp_path):
    """A short film of bodies that lie still: each picture of three loops is the first one."""
    still = film_from_recording(recording)
    still = replace(
        still, position=still.position[-1:].repeat(3, axis=0), orientation=still.orientation[-1:].repeat(3, axis=0)
    )
    path = tmp_path / "film.html"
    save_html(still, path)
    page.goto(path.as_uri() + "?fixedDpr=1")
    page.wait_for_selector("canvas")
    page.add_style_tag(content=".mantine-Notification-root {display: none !important}")
    page.wait_for_timeout(3000)
    first = picture(page, tmp_path / "first.png")
    assert first.std(axis=(0, 1)).max() > 8.0
    for _ in range(12):
        page.wait_for_timeout(250)
        assert changed(first, picture(page, tmp_path / "later.png")) == 0
