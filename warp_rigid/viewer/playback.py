"""Films in the browser: with a scrubber, or as a standalone page that needs no server."""

import threading
import time
from dataclasses import replace

import numpy as np

from warp_rigid.files.atomic import atomic_file
from warp_rigid.render.film import Film, film_from_recording, film_from_usd
from warp_rigid.render.framing import event_end
from warp_rigid.rotations import continuous_signs
from warp_rigid.runs.recording import Recording
from warp_rigid.scene.camera import camera_of_text, with_body_index
from warp_rigid.viewer import page
from warp_rigid.viewer.instances import Instances
from warp_rigid.viewer.server import CheckedServer, own_title

PERIOD = 1.0 / 30.0
"""Time between updates of the page [s]."""
PAGE_RATE = 60.0
"""Largest frame rate of a standalone page [1/s]."""
END_PAUSE = 1.0
"""Time for which a standalone page shows the last frame before it starts again [s]."""
LOADER = "e.textContent=code;"
"""Where the page of viser starts its program, which it has unpacked as text."""
LOADER_WITHOUT_RESET = r'e.textContent=code.replace(/[\w$]+\.useEnvironment\.set\([\w$]+\(\)\);/,"return;");'
"""The same, with an empty function `resetScene`.

Viser calls it before every loop and after every step back. It hides all bodies and brings back viser's own lights and
a faded picture, until the messages of the first frame are handled. A film shows the same bodies in the same light from
its first to its last frame, so that nothing has to be reset.
"""


def load_film(path: str, camera: str | None = None) -> Film:
    """A recording (.npz) or a USD film.

    Args:
        path: of the file.
        camera: text for camera_of_text, instead of the camera of the film.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It holds nothing that can be played, or the camera follows none of its bodies.
    """
    if path.endswith(".npz"):
        recording = Recording.load(path)
        film, names = film_from_recording(recording), recording.names
    else:
        film = film_from_usd(path)
        names = tuple(str(index) for index in range(int(film.body.max()) + 1))
    return film if camera is None else replace(film, camera=with_body_index(camera_of_text(camera), names))


class FilmViewer:
    """Plays a film in the browser.

    Args:
        film: what to play.
        host: address to serve on.
        port: the first to try.
        fast: simple light without shadows.

    Attributes:
        server: serves the page.
        playing: whether it runs on.
    """

    def __init__(self, film: Film, host: str = "127.0.0.1", port: int = 8080, fast: bool = False):
        """Open the page at the first frame."""
        self.film = film
        self._at = 0.0
        self.playing = True
        self._speed = 1.0
        self._stop = threading.Event()
        self.server = page.start_server(host, port)
        self._instances = _show_film(self.server, film, fast)
        page.on_each_page(self.server, lambda client: page.keep_framed(client, lambda: self.film))
        self._add_controls()

    def run(self) -> None:
        """Play in a loop until `stop`."""
        shown, last = None, time.perf_counter()
        while not self._stop.is_set():
            now = time.perf_counter()
            if self.playing and self.server.get_clients():
                self._at = (self._at + (now - last) * self._speed * self.film.fps) % self.film.num_frames
            last = now
            if self.frame != shown:
                shown = self.frame
                self._show(shown)
            self._stop.wait(max(0.0, PERIOD - (time.perf_counter() - now)))
        page.stop_server(self.server)

    @property
    def frame(self) -> int:
        """Index of the frame shown."""
        return int(self._at)

    def seek(self, frame: int) -> None:
        """Stop at a frame; indices beyond the ends are clamped."""
        self.playing = False
        self._at = float(np.clip(frame, 0, self.film.num_frames - 1))

    def stop(self) -> None:
        """Make `run` return; may be called from any thread."""
        self._stop.set()

    def _show(self, frame: int) -> None:
        with self.server.atomic():
            self._instances.show(self.film, frame)
            if self.film.camera.body is not None:
                page.follow_with_pages(self.server, self.film, frame)
        if self._scrubber.value != frame:
            self._scrubber.value = frame
        self._time.content = f"{frame / self.film.fps:.2f} s of {(self.film.num_frames - 1) / self.film.fps:.2f} s"

    def _add_controls(self) -> None:
        gui = self.server.gui
        self._time = gui.add_markdown("")
        self._scrubber = gui.add_slider("Frame", 0, max(1, self.film.num_frames - 1), 1, 0)
        buttons = gui.add_button_group("", ("Play / Pause", "Back", "Forward"))
        speed = gui.add_slider("Speed", 0.05, 4.0, 0.05, 1.0)
        wire = gui.add_checkbox("Wireframe", False)
        play = gui.add_command("Play or pause", hotkey="space")

        # A coroutine is called before the next frame sets the slider.
        @self._scrubber.on_update
        async def _(event) -> None:
            if event.client is not None:
                self.seek(int(self._scrubber.value))

        @buttons.on_click
        def _(event) -> None:
            if event.target.value == "Play / Pause":
                self._toggle()
            else:
                self.seek(self.frame + (1 if event.target.value == "Forward" else -1))

        @speed.on_update
        def _(event) -> None:
            self._speed = speed.value

        wire.on_update(lambda event: self._instances.wire(wire.value))
        play.on_trigger(lambda event: self._toggle())

    def _toggle(self) -> None:
        self.playing = not self.playing


def _show_film(server: CheckedServer, film: Film, fast: bool) -> Instances:
    """Show the first frame of a film to all pages, in its light and with its camera."""
    page.set_light(server, fast)
    instances = Instances(server, film, film.moving)
    page.look_at_film(server, film)
    return instances


def save_html(film: Film, path, fast: bool = False) -> None:
    """Write a film as one HTML file, which plays without a server or a network connection.

    Args:
        film: what to write.
        path: the file; folders are made.
        fast: simple light without shadows.

    Raises:
        ModuleNotFoundError: viser is not installed.
    """
    server = page.start_server("127.0.0.1", 8080)
    try:
        instances = _show_film(server, film, fast)
        serializer = server.get_scene_serializer()
        stride = max(1, round(film.fps / PAGE_RATE))
        last = event_end(film)
        film = replace(film, orientation=continuous_signs(film.orientation))
        for frame in [*range(0, last, stride), last]:
            instances.show(film, frame)
            serializer.insert_sleep(stride / film.fps)
        # The page starts again at once: the end is shown for a while, so that the loop is no jump in the motion.
        serializer.insert_sleep(END_PAUSE)
        with atomic_file(path) as beside:
            text = serializer.as_html().replace(LOADER, LOADER_WITHOUT_RESET, 1)
            beside.write_text(own_title(text), encoding="utf-8")
    finally:
        page.stop_server(server)
