"""What an update of the viewer costs, apart from what the browser draws.

    python -m benchmarks.viewer_rate [SCENE[:NAME=VALUE] ...] [--seconds 4]

For each scene: processor time of simulating 1/60 s and of preparing and sending the update, and the updates per second
that a client receives that draws nothing. The page needs the sum of both to be less than 16.7 ms for 60 Hz.
"""

import argparse
import contextlib
import threading
import time
from urllib.parse import urlsplit

import msgspec
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from warp_rigid.viewer.live import LiveViewer
from warp_rigid.viewer.session import Session

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (3.0, 0.0, 1.0),
    "fov": 0.7,
    "near": 0.1,
    "far": 100.0,
    "image_height": 720,
    "image_width": 1280,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}
"""The message by which a page introduces itself."""
SIX = ("box_stack", "leaning_tower", "incline", "plank_launch", "seesaw", "skull_and_brain")
WARM_UP = 4.0
"""Time until the viewer stops waiting for a page that draws nothing, and until kernels are loaded [s]."""


class Meter:
    """Adds up the processor time of a method of an object."""

    def __init__(self, owner, name):
        """Replace the method by one that is timed."""
        self._inner, self.seconds, self.calls = getattr(owner, name), 0.0, 0
        setattr(owner, name, self)

    def __call__(self, *arguments):
        """Call the method."""
        start = time.thread_time()
        found = self._inner(*arguments)
        self.seconds += time.thread_time() - start
        self.calls += 1
        return found


def measure(source: str, assignments: list[str], seconds: float) -> str:
    """One line of the table."""
    viewer = LiveViewer(Session(source, assignments=assignments, device="cpu"), port=8700)
    thread = threading.Thread(target=viewer.run, daemon=True)
    thread.start()
    with open_page(viewer.url):
        time.sleep(WARM_UP)
        viewer.ask(viewer.restart)
        viewer.session.running = True
        time.sleep(0.5)
        advance, publish = Meter(viewer.session, "advance"), Meter(viewer, "_publish")
        before, start = viewer.session.time, time.perf_counter()
        time.sleep(seconds)
        simulated, passed = viewer.session.time - before, time.perf_counter() - start
        frame, sent = 1e3 * advance.seconds / (60.0 * simulated), 1e3 * publish.seconds / publish.calls
        rate = publish.calls / passed
    viewer.stop()
    thread.join()
    bodies = viewer.session.sim.num_bodies
    return f"{source:16} {bodies:6} {frame:8.2f} {sent:8.2f} {rate:8.1f} {simulated / passed:8.2f}"


def open_page(url: str):
    """Connect as a page that takes all messages and draws nothing."""
    address = urlsplit(url)
    path, protocol = f"ws://{address.netloc}{address.path.rstrip('/')}", f"viser-v{viser.__version__}"
    page = connect(path, subprotocols=[protocol], max_size=None)
    page.send(msgspec.msgpack.encode(CAMERA))

    def receive() -> None:
        with contextlib.suppress(ConnectionClosed):
            for _ in page:
                pass

    threading.Thread(target=receive, daemon=True).start()
    return page


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=SIX)
    parser.add_argument("--seconds", type=float, default=4.0)
    chosen = parser.parse_args()
    print(f"{'scene':16} {'bodies':>6} {'step ms':>8} {'send ms':>8} {'updates':>8} {'pace':>8}")
    for text in chosen.scenes:
        source, *assignments = text.split(":")
        print(measure(source, assignments, chosen.seconds), flush=True)


if __name__ == "__main__":
    main()
