"""What notebooks show of scenes, simulators, recordings and sweep results: registered with `warp_rigid.display`."""

import base64
import html
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.checks import shown
from warp_rigid.display import Inline, film_of, html_of
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.runs.drawn_surface import surfaces_of
from warp_rigid.runs.recording import Recorder, Recording, is_moving
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.sweep.columns import COLUMNS
from warp_rigid.sweep.table import SweepResult

MAX_INLINE = 16_000_000
"""Maximum size of a film in a notebook [bytes]."""
MAX_ENVS = 16
"""Maximum number of environments in the film that a recording shows by itself."""
POSE_BYTES = 28
"""Size of the pose of a body in one frame of a page [bytes]."""
PICTURE_WIDTH = 320
"""Width of a picture of a scene [pixel]."""
MAX_TRIANGLES = 200_000
"""Triangles up to which a scene is drawn, counted for each body."""
MAX_ROWS, MAX_COLUMNS, MAX_NAMES = 10, 14, 6
"""What is shown at most of a table and of a list of names."""
FILM_HEIGHT = 420
"""Height of the page of a film [pixel]."""
TYPES = {".gif": "image/gif", ".mp4": "video/mp4", ".png": "image/png"}


@html_of.register
def _scene_html(scene: Scene) -> str:
    rows = [
        ("bodies", _bodies(scene)),
        ("joints", _counted(type(entry.joint).__name__ for entry in scene.joints)),
        ("force fields", _counted(type(field).__name__ for field in scene.force_fields)),
        ("gravity", f"{_vector(scene.gravity)} m/s²"),
        ("bounds", "" if scene.bounds is None else " to ".join(map(_vector, scene.bounds)) + " m"),
    ]
    return _side_by_side(_summary("Scene", rows), _picture(lambda: _first_environment(_AtStart(scene)), scene))


@html_of.register
def _simulator_html(sim: Simulator) -> str:
    used, default = asdict(sim.settings), asdict(Settings())
    changed = [f"{name} {value}" for name, value in used.items() if name != "dt" and value != default[name]]
    rows = [
        ("environments", _environments(sim)),
        ("bodies", _bodies(sim.scenes[0]) if len(sim.scenes) == 1 else f"at most {sim.num_bodies}"),
        ("device", f"{sim.device}, {sim.memory / 1e6:.3g} MB"),
        ("settings", ", ".join([f"dt {sim.settings.dt:.6g} s", *changed])),
        ("time", f"{sim.time:.6g} s"),
        ("status", _status(sim)),
    ]
    return _side_by_side(_summary("Simulator", rows), _picture(lambda: _first_environment(sim), sim.scenes[0]))


@html_of.register
def _recording_html(recording: Recording) -> str:
    optional = ("linear_velocity", "angular_velocity", "contacts")
    quantities = [name for name in optional if getattr(recording, name) is not None]
    named = zip(recording.envs.tolist(), recording.labels, strict=True)
    drawn = _environments_that_fit(recording)
    rows = [
        ("frames", f"{len(recording.time)}, {recording.fps:g} per second"),
        ("time", f"{recording.time[0]:.6g} to {recording.time[-1]:.6g} s"),
        ("environments", _listed([label or str(env) for env, label in named])),
        ("bodies", f"{len(recording.names)}: {_listed(recording.names)}"),
        ("also recorded", ", ".join(quantities)),
        ("film", f"environments {_listed(drawn)}" if 0 < len(drawn) < len(recording.envs) else ""),
    ]
    summary = _summary("Recording", rows)
    if not recording.position.size or not np.isfinite(recording.position).all():
        return summary
    try:
        film = _inline(recording, ".html", envs=drawn).html if drawn else _picture(lambda: recording, recording.scene)
    except (ValueError, ModuleNotFoundError):
        film = _picture(lambda: recording, recording.scene)
    return f"{summary}{film}"


def _environments_that_fit(recording: Recording) -> list[int]:
    """The environments of the film that a recording shows by itself: the first ones; none if one is too large."""
    size = POSE_BYTES * len(recording.time) * max(1, len(recording.names))
    return recording.envs[: min(MAX_ENVS, MAX_INLINE // size)].tolist()


@html_of.register
def _result_html(result: SweepResult) -> str:
    scene = str(result.about.get("scene", "")).partition(":")[0]
    failed = f", {len(result.failed)} failed" if result.failed else ""
    names = [name for name in result.names if name not in COLUMNS or name in ("run", "status", "reason")]
    if all(row.get("reason") is None for row in result.rows):
        names = [name for name in names if name != "reason"]
    hidden = len(names) - MAX_COLUMNS
    names = names[:MAX_COLUMNS]
    heads = [f"{name} [{result.units[name]}]" if name in result.units else name for name in names]
    rows = [[_value(row.get(name)) for name in names] for row in result.rows[:MAX_ROWS]]
    left = [
        f"{len(result) - MAX_ROWS} more rows" if len(result) > MAX_ROWS else "",
        f"{hidden} more columns" if hidden > 0 else "",
    ]
    below = f"<p>{', '.join(filter(None, left))}</p>" if any(left) else ""
    return f"<b>SweepResult</b> of {html.escape(scene)}, {len(result)} runs{failed}{_table(heads, rows)}{below}"


@film_of.register
def _film(recorded: Recording, suffix: str, path: Any = None, **options: Any) -> Inline | None:
    """A film of a recording; the suffix "" takes the page, or a GIF where there can be no page."""
    if path is not None:
        _write(recorded, suffix, path, **options)
        return None
    if suffix:
        return _inline(recorded, suffix, **options)
    try:
        return _inline(recorded, ".html", **options)
    except (_TooLarge, ModuleNotFoundError):
        return _inline(recorded, ".gif", **options)


class _TooLarge(ValueError):
    """A film does not fit into a notebook."""


def _write(recording: Recording, suffix: str, path: Any, envs: Any = None, color: str = "body", **drawn: Any) -> None:
    """Write a film to a file."""
    from warp_rigid.viewer.film_files import film_to_draw, selected, write_film

    if Path(path).suffix != suffix:
        raise ValueError(f"path: must end in {suffix}, got {shown(path)}")
    write_film(film_to_draw(selected(recording, envs), color), path, **drawn)


def _inline(recording: Recording, suffix: str, **options: Any) -> Inline:
    """A film as HTML.

    Raises:
        ValueError: It is larger than MAX_INLINE.
    """
    name = f"a {suffix} film"
    content = _bytes_of(lambda path: _write(recording, suffix, path, **options, name=name), suffix)
    if len(content) > MAX_INLINE:
        raise _TooLarge(
            f"to_{suffix[1:]}: the film has {len(content) / 1e6:.0f} MB, and a notebook shows at most "
            f"{MAX_INLINE / 1e6:.0f} MB; give a path, or fewer envs or a smaller width"
        )
    if suffix == ".html":
        page = html.escape(content.decode())
        style = f"width:100%;max-width:960px;height:{FILM_HEIGHT}px;border:0"
        return Inline(f'<iframe style="{style}" sandbox="allow-scripts" srcdoc="{page}"></iframe>')
    if suffix == ".mp4":
        return Inline(f'<video controls loop style="max-width:100%" src="{_uri(content, suffix)}"></video>')
    return Inline(f'<img style="max-width:100%" src="{_uri(content, suffix)}">')


def _bytes_of(write: Callable[[Path], object], suffix: str) -> bytes:
    """Content of a file that a function writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"film{suffix}"
        write(path)
        return path.read_bytes()


def _uri(content: bytes, suffix: str) -> str:
    return f"data:{TYPES[suffix]};base64,{base64.b64encode(content).decode()}"


class _AtStart:
    """A scene as a simulator of one environment before the first step, with what Recorder reads of it."""

    num_envs, time, times, scene_of = 1, 0.0, np.zeros(1), np.zeros(1, int)

    def __init__(self, scene: Scene) -> None:
        """Store the scene."""
        self.scenes = [scene]

    def get(self, name: str) -> np.ndarray:
        """See Simulator.get."""
        scene = self.scenes[0]
        if name == "gravity":
            return np.array([scene.gravity])
        return np.array([[getattr(body, name, 0) for body in scene.bodies]])  # 0 is "asleep" and "level"


def _first_environment(sim: Simulator | _AtStart) -> Recording:
    """The present state of environment 0."""
    recorder = Recorder(sim, 1.0, [0])
    recorder.capture(sim)
    return recorder.recording()


def _picture(make: Callable[[], Recording], scene: Scene | None) -> str:
    """The last frame of a recording as an image; "" where it cannot be drawn, or not at little cost."""
    if scene is not None and not _is_cheap(scene):
        return ""
    try:
        from warp_rigid.render.images import save_picture
        from warp_rigid.viewer.film_files import film_to_draw

        recording = make()
        if not np.isfinite(recording.position).all():
            return ""
        film = film_to_draw(_end_with_motion(recording))
        content = _bytes_of(lambda path: save_picture(film, path, width=PICTURE_WIDTH), ".png")
    except ModuleNotFoundError:  # Pillow is optional
        return ""
    return f'<img style="max-width:100%" src="{_uri(content, ".png")}">'


def _end_with_motion(recording: Recording) -> Recording:
    """The last frame, after one in which all bodies that can move are one rounding away.

    The renderer frames the bodies whose pose changes, and leaves out walls that hide them.
    """
    last = recording.position[-1:]
    moves = is_moving(recording.motion)[:, None]
    before = np.where(moves, np.nextafter(last, np.float32(np.inf)), last)
    twice: dict[str, Any] = {
        name: np.repeat(getattr(recording, name)[-1:], 2, axis=0)
        for name in ("times", "orientation", "asleep", "level", "active")
    }
    return replace(recording, time=recording.time[-1] + np.arange(2), position=np.concatenate([before, last]), **twice)


def _is_cheap(scene: Scene) -> bool:
    """Whether there is something to draw, and not too much."""
    surfaces, surface = surfaces_of(scene.bodies)
    return 0 < sum(len(surfaces[index].faces) for index in surface) <= MAX_TRIANGLES


def _summary(title: str, rows: Sequence[tuple[str, str]]) -> str:
    """A table of names and texts, without those that are empty."""
    cells = [f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in rows if text]
    style = "text-align:left"
    return f'<table style="{style}"><caption style="{style}"><b>{title}</b></caption>{"".join(cells)}</table>'


def _table(heads: list[str], rows: list[list[str]]) -> str:
    head = "".join(f"<th>{html.escape(text)}</th>" for text in heads)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(text)}</td>" for text in row) + "</tr>" for row in rows)
    return f'<div style="overflow-x:auto"><table><tr>{head}</tr>{body}</table></div>'


def _side_by_side(*parts: str) -> str:
    return f'<div style="display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start">{"".join(parts)}</div>'


def _bodies(scene: Scene) -> str:
    """The numbers of bodies by motion, and their names."""
    kinds = Counter(body.motion for body in scene.bodies)
    counts = ", ".join(f"{kinds[motion]} {motion.name.lower()}" for motion in reversed(Motion) if kinds[motion])
    return f"{counts}: {_listed([body.name for body in scene.bodies])}" if counts else "none"


def _environments(sim: Simulator) -> str:
    return f"{sim.num_envs} of {len(sim.scenes)} scenes" if len(sim.scenes) > 1 else str(sim.num_envs)


def _status(sim: Simulator) -> str:
    """The numbers of environments by status and warning."""
    records = sim.status()
    found = Counter(records["status"].tolist())
    warned = Counter(f"warning: {text}" for text in records["warning"].tolist() if text)
    return ", ".join(text if count == sim.num_envs else f"{count} {text}" for text, count in (found + warned).items())


def _counted(names: Any) -> str:
    return ", ".join(f"{count} {name}" for name, count in Counter(names).items())


def _listed(names: Sequence[Any]) -> str:
    shown = ", ".join(str(name) for name in names[:MAX_NAMES])
    return f"{shown}, … ({len(names)})" if len(names) > MAX_NAMES else shown


def _vector(value: Any) -> str:
    return f"({', '.join(f'{part:g}' for part in value)})"


def _value(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)
