"""The live page: a session in the browser."""

import io
import logging
import queue
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.commands.terminal import explain, is_device_error
from warp_rigid.render.appearance import apply_coloring
from warp_rigid.render.film import Film, film_from_recording
from warp_rigid.render.framing import points_to_see
from warp_rigid.runs.recording import Recorder
from warp_rigid.scene.scene import Motion
from warp_rigid.scene.shapes import Box, Capsule, Sphere
from warp_rigid.viewer import page
from warp_rigid.viewer.controls import check_point
from warp_rigid.viewer.history import QUANTITIES, History, Moment
from warp_rigid.viewer.instances import Instances, bytes_of_light
from warp_rigid.viewer.overlays import CONTACTS, Overlays
from warp_rigid.viewer.panel import Panel
from warp_rigid.viewer.picking import first_hit
from warp_rigid.viewer.session import Paced, Session
from warp_rigid.viewer.slicing import SliceView

log = logging.getLogger(__name__)

PERIOD = 1.0 / 60.0
"""Time between updates of the page [s]."""
MOST_SHOWN = 6000
"""Bodies on the page; of more environments than hold so many, only the first are shown."""
REFUSALS = (ValueError, FileNotFoundError, ModuleNotFoundError)
"""Errors of requests that are not valid. All others are bugs, and are logged with their traceback."""
LOADING_PATIENCE, PICTURE_PATIENCE = 3.0, 20.0
"""Longest time to wait until a page shows the scene, and until it returns a picture [s]."""
SEEN_THROUGH = 0.7
"""Opacity of bodies with contacts while these are shown."""
LEAST_DIRECTION = 1.0e-6
"""Shortest vector that still gives a direction."""


class LiveViewer:
    """Shows a session in the browser and executes the requests of the page.

    All work is done by the thread that calls `run`; the page's events only put what they ask for in a queue.

    Args:
        session: what is played.
        host: address to serve on; the default is reached from this machine alone.
        port: the first to try.
        fast: no shadows and simple light, for graphics without a GPU.

    Attributes:
        server: serves the page.
        session: as given.
        given: the scene that the session was opened with. If it is a file, the page may load it again.
        rows: environments on the page.
        chosen: environment and body that slices and clusters are of.
        fast: as given.
    """

    def __init__(self, session: Session, host: str = "127.0.0.1", port: int = 8080, fast: bool = False):
        """Open the page; `run` starts updating it."""
        self.session = session
        self.given = session.source
        self.fast = fast
        self.server = page.start_server(host, port)
        self._wishes: queue.SimpleQueue = queue.SimpleQueue()
        self._loaded: set[int] = set()
        self.history = History()
        self._past: Moment | None = None
        self._looping = False
        self._stopped = False
        self._instances: Instances | None = None
        self._options: dict[str, Any] = {"coloring": "body", "sleepers": True, "wireframe": False, "strength": 2.0}
        self._options |= {"slice": False, "axis": "y", "place": 0.5}
        self._overlays = Overlays(self.server)
        self._slice = SliceView(self.server)
        self._rope = self.server.scene.add_line_segments("/rope", np.zeros((1, 2, 3)), (30, 30, 30), visible=False)
        self.rows = self._some_rows(0, session.sim.num_envs)
        self.chosen = (0, 0)
        self._panel = Panel(self)
        page.set_light(self.server, fast)
        self._stale = True
        self._widen = Paced(share=0.01, period=0.5)
        self._updates, self._since, self._rate, self._pace = 0, (time.perf_counter(), 0.0), 0.0, 0.0
        self._show_scene()
        page.on_each_page(self.server, self._welcome)

    def run(self) -> None:
        """Step and show until `stop`; the simulation waits while no page is open."""
        last = due = time.perf_counter()
        changed = False
        while not self._stopped:
            changed |= self._do_wishes()
            now = time.perf_counter()
            watched = bool(self._loaded.intersection(self.server.get_clients()))
            if watched and self._looping:
                self._loop_time = (self._loop_time + (now - last) * self.session.speed) % max(self.history.length, 1e-9)
                self._past = self.history.at(self.history.length - self._loop_time)
                changed = True
            elif watched and self._attempt(self.session.advance, now - last, max(0.0, due - now)):
                changed = True
                self.history.add(self.session.time, self.session.sim)
            last = now
            if time.perf_counter() >= due:
                if changed and watched:
                    self._attempt(self._publish)
                self._count_update(changed and watched)
                if watched and self._stale:
                    shown = self._attempt(self._panel.hud.update, self.session, self.rows, self._rate, self._pace)
                    self._stale = shown is False
                    if shown:
                        self._attempt(self._panel.inspect, self.session, *self.chosen)
                changed &= not watched
                due = max(due + PERIOD, time.perf_counter())
            elif not (watched and self.session.behind) and self._wishes.empty():
                time.sleep(max(0.0, due - time.perf_counter()))
        page.stop_server(self.server)

    def stop(self) -> None:
        """Make `run` return; may be called from any thread."""
        self.ask(setattr, self, "_stopped", True)

    def ask(self, action: Callable, *arguments: Any) -> None:
        """Queue an action for the viewer's thread; may be called from any thread."""
        self._wishes.put((action, arguments))

    def toggle(self) -> None:
        """Start or pause the simulation; it continues from the moment that is shown."""
        self._return_to_present()
        self.session.running = not self.session.running

    def single_step(self) -> None:
        """Pause and do one step."""
        self._return_to_present()
        self.session.running = False
        self.session.step(1)

    def restart(self) -> None:
        """Restart the scene; it keeps running if it was running."""
        self._forget()
        self.session.restart()
        self._panel.hud.restart()

    def load(self, source: str, compare: bool = False, assignments: Sequence[str] = ()) -> None:
        """Load another scene, alone or with all its variants, and run it."""
        self._panel.say(f"building {source} ...")
        self._forget()
        self.session.open(source, compare=compare, assignments=assignments)
        self.session.running = True
        self._overlays.clear()
        self.rows = self._some_rows(0, self.session.sim.num_envs)
        self._show_scene()
        self._panel.say("")

    def use_variant(self, name: str) -> None:
        """Restart with the settings of a variant."""
        if name in self.session.variants:
            self.session.use_variant(name)
            self.session.running = True
        self._panel.refresh(self.session, int(self.rows[0]))
        self._panel.hud.restart()

    def change(self, name: str, value: Any) -> None:
        """Change a setting or property in the environments shown."""
        self.session.change(name, value, self.rows)
        self._panel.show_variant(self.session)

    def overlay(self, name: str, on: bool) -> None:
        """Switch an overlay on or off."""
        self._overlays.switch(name, on)

    def choose(self, body: int, env: int | None = None) -> None:
        """Select the body whose slices and clusters are shown."""
        self.chosen = (int(self.rows[0]) if env is None else env, body)
        self._panel.choose_body(body)
        self._cut()

    def option(self, name: str, value: Any) -> None:
        """Change what is displayed, and how."""
        self._options[name] = value
        if name == "wireframe":
            self._instances.wire(value)
        elif name == "shadows":
            page.set_light(self.server, not value)
        elif name in ("slice", "axis", "place"):
            self._cut()

    def compare(self, on: bool) -> None:
        """Load the scene again, with all its variants side by side or alone."""
        self.load(self.session.source, compare=on and bool(self.session.plan.demo.variants))

    def show_envs(self, first: int, count: int) -> None:
        """Show a number of environments from one on."""
        self.rows = self._some_rows(first, count)
        self._show_scene()

    def rewind(self, back: float) -> None:
        """Pause, and show the moment `back` seconds ago; running continues from there."""
        self._looping = False
        self.session.running = False
        self._past = self.history.at(back)
        self._publish()

    def loop(self, on: bool) -> None:
        """Show the last seconds again and again, or return to the present."""
        self._looping = on and len(self.history.moments) > 1
        self._past, self._loop_time = None, 0.0
        self.session.running = False
        self._publish()

    def spawn(self, kind: str) -> None:
        """Drop a body above the others: a shape of the size of the selected body, or one like it."""
        session, (env, body) = self.session, self.chosen
        model = session.plan.scene.bodies[body].shape
        half = 0.5 * float(np.min(np.ptp(np.asarray(model.bounds), axis=0))) if not model.static_only else 0.1
        shape = {"box": Box((half,) * 3), "sphere": Sphere(half), "capsule": Capsule(0.5 * half, half)}.get(kind, model)
        if shape.static_only:
            raise ValueError("body: the selected one has a shape that only static bodies can have")
        dynamic = [i for i, other in enumerate(session.plan.scene.bodies) if other.motion == Motion.DYNAMIC]
        places = session.sim.get("position")[:, dynamic or slice(None)]
        above = np.median(places, axis=1)
        above[:, 2] = places[..., 2].max(axis=1) + 3.0 * half + float(np.linalg.norm(np.ptp(model.bounds, axis=0)))
        self._forget()
        index = session.spawn(shape, above)
        self._show_scene()
        self.choose(index, env)

    def restart_with(self, parameters: dict[str, Any]) -> None:
        """Load the scene again with other parameters."""
        demo = self.session.plan.demo
        changed = [f"{name}={value}" for name, value in parameters.items() if value != demo.parameters[name]]
        self.load(self.session.source, assignments=changed)

    def film(self) -> Film:
        """The last seconds of the environments on the page as a film."""
        moments = self.history.moments
        if len(moments) < 2:
            raise ValueError("film: nothing has moved yet")
        rate = (len(moments) - 1) / max(self.history.length, 1e-9)
        poses = [self._poses(moment.state) for moment in moments]
        return replace(
            self._film, fps=rate, **{name: np.concatenate([one[name] for one in poses]) for name in poses[0]}
        )

    def send_film(self, client_id: int) -> None:
        """Let a page download the last seconds, as a page that plays without the viewer."""
        from warp_rigid.viewer.playback import save_html

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{self.session.plan.demo.name}.html"
            save_html(self.film(), path, self.fast)
            self._send(client_id, path.name, path.read_bytes())

    def send_picture(self, client_id: int) -> None:
        """Let a page download its picture of the scene."""
        from PIL import Image

        client = self.server.get_clients().get(client_id)
        if client is None:
            return
        picture = client.get_render(client.camera.image_height, client.camera.image_width, timeout=PICTURE_PATIENCE)
        file = io.BytesIO()
        Image.fromarray(picture).save(file, format="PNG")
        self._send(client_id, f"{self.session.plan.demo.name}.png", file.getvalue())

    def _send(self, client_id: int, name: str, content: bytes) -> None:
        client = self.server.get_clients().get(client_id)
        if client is not None:
            client.send_file_download(name, content, save_immediately=True)

    def _welcome(self, client: Any) -> None:
        """Fit the view to the page, and let the simulation wait until the page shows the scene."""
        page.keep_framed(client, lambda: self._film)
        client.camera.on_update(lambda _: page.keep_above_ground(client, page.ground_heights(self._film)))
        try:
            client.get_render(16, 16, timeout=LOADING_PATIENCE)
        except Exception as error:  # a page in the background draws nothing
            log.info("the page did not report that it was loaded: %s", error)
        self._loaded.add(client.client_id)

    def _return_to_present(self) -> None:
        """Continue from the moment that is shown, if it was chosen by the slider; a loop changes nothing."""
        if self._past is not None and not self._looping:
            self.session.show(self._past)
            self.history.forget_after(self._past.time)
        self._past, self._looping = None, False
        self._panel.reset_time()

    def _forget(self) -> None:
        """Remove the recorded seconds, for another scene or a restart."""
        self.history.moments.clear()
        self._past = None
        self._return_to_present()

    def _some_rows(self, first: int, count: int) -> np.ndarray:
        """Show a number of environments from one on, as far as they exist and the page can show them."""
        sim = self.session.sim
        count = max(1, min(count, MOST_SHOWN // sim.num_bodies, sim.num_envs))
        first = min(first, sim.num_envs - count)
        return np.arange(first, first + count)

    def _do_wishes(self) -> bool:
        """Execute all queued requests; errors are shown on the page."""
        done = False
        while not self._wishes.empty():
            action, arguments = self._wishes.get()
            done = True
            try:
                action(*arguments)
            except Exception as error:
                self._report(error)
                self._attempt(self._panel.refresh, self.session, int(self.rows[0]))
        return done

    def _attempt(self, action: Callable, *arguments: Any) -> Any:
        """Call an action; if it raises, report the error, pause the simulation and return None.

        Raises:
            RuntimeError: The device does not work.
        """
        try:
            return action(*arguments)
        except Exception as error:
            if isinstance(error, RuntimeError) and is_device_error(error):
                raise
            self.session.running = False
            self._report(error)
            return None

    def _report(self, error: Exception) -> None:
        """Show an error on the open pages; bugs go to the log too."""
        expected = isinstance(error, REFUSALS)
        if not expected:
            log.error("a request failed: %s", error, exc_info=error)
        text = explain(error) if expected else f"{type(error).__name__}: {explain(error)}"
        for client in self.server.get_clients().values():
            client.add_notification("Not possible" if expected else "Error", text, color="red")

    def _show_scene(self) -> None:
        """Put the bodies of the shown environments on the page."""
        session = self.session
        labels = [session.plan.labels[row] for row in self.rows]
        recorder = Recorder(session.sim, 1.0 / PERIOD, self.rows, labels, camera=session.plan.camera)
        recorder.capture(session.sim)
        self._film = film = film_from_recording(recorder.recording())
        self._plain = bytes_of_light(film.color)
        self._walls = np.where(film.motion == Motion.STATIC, page.opacity_of_walls(film), 1.0)
        with self.server.atomic():
            if self._instances is not None:
                self._instances.remove()
            self._instances = Instances(self.server, film, film.motion != Motion.STATIC)
            self._instances.wire(self._options["wireframe"])
        self._extent = float(np.ptp(points_to_see(film, [0]), axis=0).max())
        for handle, chosen in self._instances.handles:
            self._listen(handle, chosen)
        page.look_at_film(self.server, film)
        moving = np.flatnonzero(film.dynamic)
        self.chosen = (int(self.rows[0]), int(moving[0]) if len(moving) else 0)
        self._panel.refresh(session, int(self.rows[0]))
        self._panel.choose_body(self.chosen[1])
        self._panel.hud.restart()
        self._cut()
        self._publish()

    def _listen(self, handle: Any, chosen: np.ndarray) -> None:
        """Connect clicks to pushes and drags to pulls of the bodies of a batch.

        Where a fixed body fills the view, drags turn the camera.
        """
        handle.on_click(
            lambda event: self.ask(self._push, chosen, event.instance_index, event.ray_origin, event.ray_direction)
        )
        size = np.ptp(self._film.meshes[self._film.mesh[chosen[0]]].vertices, axis=0).max()
        if self._film.dynamic[chosen].any() or size < self._extent:

            @handle.on_drag
            async def _(event) -> None:
                line = event.client.camera.position, event.start_position, event.end_position
                self.ask(self._drag, event.phase, chosen, event.instance_index, *line)

    def _picked(
        self, chosen: np.ndarray, index: Any, origin: np.ndarray, direction: np.ndarray
    ) -> tuple[int, int, np.ndarray]:
        """Row and body that the page has picked, and where its ray hits the body or passes its origin.

        The page gives no index for what it draws around the body under the pointer: then the ray tells the body.

        Raises:
            ValueError: There is no such body, or no longer.
        """
        sim = self.session.sim
        film = replace(self._film, **self._poses({name: sim.get(name) for name in QUANTITIES}))
        if index is None:
            found = first_hit(film, np.flatnonzero(~film.flat), origin, direction)
            if found is None:
                raise ValueError("body: there is none under the pointer")
        elif not isinstance(index, int) or not 0 <= index < len(chosen) or chosen[index] >= len(film.mesh):
            raise ValueError("body: the one that was clicked is not on the page")
        else:
            ahead = direction / np.linalg.norm(direction)
            passed = origin + ((film.position[0, chosen[index]] - origin) @ ahead) * ahead
            found = first_hit(film, chosen[[index]], origin, direction) or (int(chosen[index]), passed)
        return *divmod(found[0], sim.num_bodies), found[1]

    def _push(self, chosen: np.ndarray, index: Any, origin: Any, direction: Any) -> None:
        """Push the body that a ray hits, away from the camera."""
        origin, direction = check_point("ray", origin), check_point("direction", direction)
        if np.linalg.norm(direction) < LEAST_DIRECTION:
            raise ValueError("direction: must not be zero")
        row, body, place = self._picked(chosen, index, origin, direction)
        env, data = int(self.rows[row]), self.session.plan.scene.bodies[body]
        if data.motion != Motion.DYNAMIC:
            self._panel.say(f"**{data.name}** is {data.motion.name.lower()}: a push does not move it")
            self.choose(body, env)
            return
        point = place - self._film.offset[row]
        velocity = self._options["strength"] * direction / np.linalg.norm(direction)
        strength = np.linalg.norm(self.session.push(env, body, point, velocity))
        self._panel.say(f"pushed **{data.name}** with {strength:.3g} N s at {np.round(point, 3).tolist()} m")
        self.choose(body, env)

    def _drag(self, phase: str, chosen: np.ndarray, index: Any, eye: Any, start: Any, end: Any) -> None:
        """Pull a body toward the pointer while the button is down."""
        if phase == "end":
            self.session.release()
            return
        # A drag may outlast its scene.
        if phase == "update" and self.session.pull_ends is None:
            return
        end = check_point("end", end)
        if phase == "update":
            self.session.move_pull(end - self._film.offset[self.session.pull_ends[0] - int(self.rows[0])])
            return
        eye = check_point("camera", eye)
        row, body, _ = self._picked(chosen, index, eye, end - eye)
        data, offset = self.session.plan.scene.bodies[body], self._film.offset[row]
        if data.motion != Motion.DYNAMIC:
            raise ValueError(f"{data.name}: is {data.motion.name.lower()}; only dynamic bodies can be pulled")
        # Without an index the page knows no place on the body.
        start = check_point("start", start) if isinstance(index, int) else end
        self.session.pull(int(self.rows[row]), body, start - offset, end - offset)

    def _cut(self) -> None:
        """Update or remove the slice."""
        shown = self._options["slice"]
        shape = self.session.plan.scene.bodies[self.chosen[1]].shape
        image = self._slice.cut(shape, "xyz".index(self._options["axis"]), self._options["place"]) if shown else None
        if not shown:
            self._slice.hide()
        self._panel.picture(image)

    def _publish(self) -> None:
        """Send the current state."""
        sim, rows = self.session.sim, self.rows
        now = {name: sim.get(name) for name in QUANTITIES} if self._past is None else self._past.state
        poses = self._poses(now)
        position, orientation = poses["position"][0], poses["orientation"][0]
        with self.server.atomic():
            self._instances.pose(position, orientation)
            self._instances.color(self._colors())
            self._instances.fade(np.where(poses["present"][0], self._opacity(), 0.0))
            if self._overlays.shown:
                self._overlays.update(sim, rows, self._film.offset, self.chosen)
            self._slice.follow(position[self._chosen_instance], orientation[self._chosen_instance])
            ends = self.session.pull_ends
            self._rope.visible = ends is not None
            if ends is not None:
                place = self._film.offset[ends[0] - int(rows[0])]
                self._rope.points = np.array([[ends[1] + place, ends[2] + place]], np.float32)
            if self._film.camera.body is not None:
                page.follow_with_pages(self.server, replace(self._film, **poses), 0)
            elif self.session.running or self._looping:
                self._widen(page.widen_views, self.server, replace(self._film, **poses))
        self._stale = True

    def _poses(self, state: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """A state of all environments as the poses of a film of one frame."""
        offset = self._film.offset[:, None].astype(np.float32)
        return {
            "position": (state["position"][self.rows] + offset).reshape(1, -1, 3),
            "orientation": state["orientation"][self.rows].reshape(1, -1, 4),
            "present": state["active"][self.rows].reshape(1, -1),
        }

    @property
    def _chosen_instance(self) -> int:
        return (self.chosen[0] - int(self.rows[0])) * self.session.sim.num_bodies + self.chosen[1]

    def _colors(self) -> np.ndarray:
        sim, by = self.session.sim, self._options["coloring"]
        if by == "body":
            return self._plain
        if by == "environment":
            values = np.repeat(self.rows, sim.num_bodies)
        elif by == "speed":
            values = np.linalg.norm(sim.get("linear_velocity")[self.rows].reshape(-1, 3), axis=1)
        else:
            values = sim.get(by)[self.rows].reshape(-1)
        return bytes_of_light(apply_coloring(by, self._film.color, self._film.dynamic, values))

    def _opacity(self) -> np.ndarray:
        opacity = self._walls.copy()
        if CONTACTS in self._overlays.shown:
            opacity[self._touching()] *= SEEN_THROUGH
        if self._options["sleepers"]:
            asleep = self.session.sim.get("asleep")[self.rows].reshape(-1)
            opacity[asleep & self._film.dynamic & (self._film.image < 0)] *= 0.35
        if self._options["slice"]:
            opacity[self._chosen_instance] = 0.15
        return opacity

    def _touching(self) -> np.ndarray:
        """(instances,) True for moving bodies with contacts: the contacts lie inside them."""
        sim = self.session.sim
        contacts = sim.contacts()
        touching = np.zeros((sim.num_envs, sim.num_bodies), bool)
        for name in ("body_a", "body_b"):
            touching[contacts["env"], contacts[name]] = True
        return touching[self.rows].reshape(-1) & self._film.dynamic

    def _count_update(self, changed: bool) -> None:
        """Measure the update rate and the simulation speed over half a second."""
        self._updates += changed
        now, (then, before) = time.perf_counter(), self._since
        if now - then >= 0.5:
            self._stale |= self._updates == 0 and self._rate > 0.0
            self._rate, self._pace = self._updates / (now - then), max(0.0, self.session.time - before) / (now - then)
            self._updates, self._since = 0, (now, self.session.time)
