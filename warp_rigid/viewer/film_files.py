"""Films of recordings as files: a page, a GIF or a video, for the command line and for notebooks."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from warp_rigid.checks import one_of, whole_in
from warp_rigid.extras import need_for_file
from warp_rigid.progress_bar import progress
from warp_rigid.render.appearance import COLORINGS
from warp_rigid.render.film import Film, colored, film_from_recording, film_from_usd
from warp_rigid.render.strings import with_strings
from warp_rigid.runs.recording import CAPTURED, VELOCITIES, Recording

MAX_WIDTH = 7680
"""Maximum width of a panel [pixel]."""


def film_to_draw(recording: Recording, color: str = "body", usd: Any = None) -> Film:
    """The film that is drawn of a recording.

    Args:
        recording: the recording.
        color: one of COLORINGS.
        usd: a file written from it, which is drawn instead, so that images show the content of the file.

    Raises:
        ValueError: The colouring is unknown, or its quantity was not recorded.
    """
    one_of("color", color, COLORINGS)
    film = film_from_usd(usd) if usd else colored(film_from_recording(recording), recording, color)
    return with_strings(film, recording)


def selected(recording: Recording, envs: Any = None) -> Recording:
    """The recording of some of its environments (indices in the simulation); None for all.

    Raises:
        ValueError: One of them was not recorded.
    """
    if envs is None:
        return recording
    rows = recording.rows(envs)
    kept = {name: getattr(recording, name) for name in ("times", *CAPTURED, *VELOCITIES)}
    return replace(
        recording,
        **{name: None if values is None else values[:, rows] for name, values in kept.items()},
        envs=recording.envs[rows],
        labels=tuple(recording.labels[row] for row in rows),
    )


def write_film(film: Film, path: Any, width: int | None = None, height: int | None = None, name: Any = None) -> None:
    """Write a film to a .html, .gif or .mp4 file.

    Args:
        film: the film.
        path: the file; missing folders are created.
        width: width of a panel of .gif and .mp4 [pixel]; None for 1280 pixels in all, or 640 for .gif,
            and at least 320.
        height: height of a panel [pixel]; None for 9/16 of its width.
        name: what the progress bar says is drawn; None for the path.

    Raises:
        ValueError: The width or height is out of range.
        ModuleNotFoundError: The extra "picture", or for .html "viewer", is not installed.
    """
    for side, value in (("width", width), ("height", height)):
        if value is not None:
            whole_in(side, value, 16, MAX_WIDTH)
    need_for_file(path)
    if Path(path).suffix == ".html":
        from warp_rigid.viewer.playback import save_html

        save_html(film, path)
        return
    from warp_rigid.render.images import save_film

    with progress(f"drawing {name or path}", film.num_frames) as advance:
        save_film(film, path, width, height, on_frame=advance)
