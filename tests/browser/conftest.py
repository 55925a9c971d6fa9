"""A real page in a headless Chromium, served by a viewer in a thread of the test."""

import io
import os
import shutil
import threading
import time

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import sync_playwright

from warp_rigid.viewer.live import LiveViewer
from warp_rigid.viewer.session import Session

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
WIDTH, HEIGHT = 680, 420
"""Small: the software renderer's time goes with the number of pixels."""

PATIENCE = 60.0
"""How long to wait for what must come [s]: much, since a busy machine is no fault of the viewer's."""


@pytest.fixture(scope="session")
def browser():
    """The browser of all tests."""
    assert CHROMIUM, "no Chromium found: install Debian's package `chromium`, or set CHROMIUM to the program"
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield found
        found.close()


@pytest.fixture
def page(browser):
    """A page of a test that needs no stage."""
    made = browser.new_page(viewport={"width": 640, "height": 400})
    made.set_default_timeout(1e3 * PATIENCE)
    yield made
    made.close()


class Stage:
    """A live viewer, and its page as a user has it before them."""

    def __init__(self, browser, source, **options):
        session = Session(source, device="cpu", **options)
        self.viewer = LiveViewer(session, port=8790, fast=True)
        self._thread = threading.Thread(target=self.viewer.run, daemon=True)
        self._thread.start()
        self._browser = browser
        self.errors = []
        self.page = self.open()

    @property
    def session(self):
        return self.viewer.session

    def open(self):
        """Another tab."""
        page = self._browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.set_default_timeout(1e3 * PATIENCE)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        # Otherwise the page draws more coarsely while the machine is busy.
        page.goto(f"{self.viewer.server.url}?fixedDpr=1")
        page.wait_for_selector("canvas")
        page.get_by_text("Restart").wait_for()
        # The page warns of software rendering, on top of what is to be clicked.
        warning = page.get_by_text("Software WebGL rendering detected")
        warning.wait_for()
        warning.locator("xpath=ancestor::*[descendant::button][1]").locator("button").click()
        warning.wait_for(state="detached")
        return page

    def close(self):
        self.viewer.stop()
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive(), "the viewer did not stop"
        self.page.close()

    def press(self, key):
        """A key, with nothing focused that would take it."""
        self.done()
        self.page.evaluate("document.activeElement && document.activeElement.blur()")
        self.page.keyboard.press(key)

    def until(self, condition, what):
        """Wait until something holds."""
        end = time.perf_counter() + PATIENCE
        while not condition():
            assert time.perf_counter() < end, f"waited {PATIENCE:g} s in vain until {what}"
            # Sleeping in the page lets the browser's events through.
            self.page.wait_for_timeout(50)

    def done(self):
        """Wait until the viewer has done all that was asked before."""
        finished = threading.Event()
        self.viewer.ask(finished.set)
        assert finished.wait(PATIENCE)

    def tab(self, name):
        self.page.get_by_role("tab", name=name).click()

    def control(self, label, kind="input"):
        """The input that belongs to a label."""
        row = self.page.get_by_text(label, exact=True).locator(f"xpath=ancestor::*[descendant::{kind}][1]")
        return row.locator(kind)

    def until_shown(self, label, field):
        """Wait until the viewer has done what was asked before, and the page shows its value of a control.

        Without it, a value that is still under way to the page could replace what the test enters.
        """
        self.done()
        widgets = self.viewer.server.gui._gui_input_handle_from_uuid.values()
        # Two tabs may have a control of the same name; the page holds only those of the open tab.
        named = [widget for widget in widgets if widget.label == label]
        (widget,) = (one for one in named if self.page.locator(f"[id='{one._impl.uuid}']").count())
        kind = type(widget.value)

        def shown():
            return field.is_checked() if kind is bool else kind(field.input_value() or 0)

        self.until(lambda: shown() == widget.value, f"the page shows {label} = {widget.value}")

    def type_number(self, label, value):
        """A number into the field beside a slider."""
        field = self.control(label).last
        self.until_shown(label, field)
        field.fill(str(value))
        field.press("Enter")

    def choose(self, label, option):
        """An entry of a menu."""
        field = self.control(label).first
        self.until_shown(label, field)
        field.click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def check(self, label):
        """Turn a switch over."""
        field = self.control(label).first
        self.until_shown(label, field)
        field.click()

    def shot(self):
        """The 3-D view as numbers, (height, width, 3)."""
        picture = Image.open(io.BytesIO(self.page.screenshot()))
        return np.asarray(picture.convert("RGB"))[:, : self.canvas()["width"]].astype(int)

    def still(self):
        """The 3-D view once it has stopped to change."""
        last = self.shot()
        for _ in range(60):
            self.page.wait_for_timeout(250)
            now = self.shot()
            if np.array_equal(now, last):
                return now
            last = now
        raise AssertionError("the view does not come to rest")

    def canvas(self):
        boxes = [canvas.bounding_box() for canvas in self.page.locator("canvas").all()]
        # That of the plot has none while its folder is closed.
        return max((box for box in boxes if box), key=lambda box: box["height"])

    def on_screen(self, point):
        """Where a point of the world is on the page [pixel]."""
        (client,) = self.viewer.server.get_clients().values()
        camera, box = client.camera, self.canvas()
        ahead = np.array(camera.look_at) - camera.position
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        to = np.asarray(point) - camera.position
        scale = 0.5 * box["height"] / np.tan(0.5 * camera.fov) / (to @ ahead)
        x = 0.5 * box["width"] + scale * (to @ right)
        y = 0.5 * box["height"] - scale * (to @ np.cross(right, ahead))
        return box["x"] + x, box["y"] + y


@pytest.fixture
def stage(browser):
    """Opens stages and closes them after the test."""
    opened = []

    def open_stage(source, **options):
        opened.append(Stage(browser, source, **options))
        return opened[-1]

    yield open_stage
    for one in opened:
        one.close()
        assert not one.errors, f"errors on the page: {one.errors}"
