"""Make docs/viewer.png: the seesaw in the viewer, rendered by a headless Chromium.

Run it from the top of the repository: `.venv/bin/python docs/make_viewer_picture.py`.
"""

import io
import os
import shutil
import threading
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from warp_rigid.viewer.live import LiveViewer
from warp_rigid.viewer.session import Session

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


def main() -> None:
    """Run the seesaw until it has tipped back, show the contacts, and save a screenshot."""
    session = Session("seesaw", device="cpu")
    viewer = LiveViewer(session)
    thread = threading.Thread(target=viewer.run)
    thread.start()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=os.environ.get("CHROMIUM") or shutil.which("chromium"), args=FLAGS
        )
        page = browser.new_page(viewport={"width": 1100, "height": 700})
        page.goto(f"{viewer.server.url}?fixedDpr=1")
        warning = page.get_by_text("Software WebGL rendering detected")
        warning.wait_for()
        warning.locator("xpath=ancestor::*[descendant::button][1]").locator("button").click()
        viewer.ask(viewer.toggle)
        while session.time < 3.0:
            time.sleep(0.05)
        viewer.ask(viewer.toggle)
        viewer.ask(viewer.overlay, "Contacts and impulses", True)
        page.wait_for_timeout(4000)
        picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        browser.close()
    viewer.stop()
    thread.join()
    # This quantization method preserves small areas of one colour.
    picture.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
        Path(__file__).with_name("viewer.png"), optimize=True
    )


if __name__ == "__main__":
    main()
