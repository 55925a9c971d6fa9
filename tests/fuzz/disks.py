"""Disks that become full while a file is written, and writers that are killed: the old file or the new one stays."""

import functools
import os
import resource
import signal
import time
from collections.abc import Callable
from pathlib import Path

from hypothesis import strategies as st

import warp_rigid as wr
from tests.fuzz.harness import Target
from warp_rigid.engine import checkpoint
from warp_rigid.files import archive
from warp_rigid.render.film import film_from_recording
from warp_rigid.render.gltf import export_gltf
from warp_rigid.render.images import save_contact_sheet, save_film, save_picture
from warp_rigid.sweep import read


@functools.cache
def made() -> tuple:
    """A simulator, its recording and film, and the table of a sweep."""
    sim = wr.Simulator(wr.scenes.load("box_stack", height=2), device="cpu")
    recording = wr.record(sim, 3)
    table = wr.sweep("incline", {"angle": [10.0, 20.0]}, duration=0.01, device="cpu", metrics=["top_height"])
    return sim, recording, film_from_recording(recording), table


def read_bytes(path: Path) -> None:
    assert path.stat().st_size > 0


def read_image(path: Path) -> None:
    from PIL import Image

    with Image.open(path) as image:
        for frame in range(getattr(image, "n_frames", 1)):
            image.seek(frame)
            image.load()


def read_stage(path: Path) -> None:
    from warp_rigid.render.film import film_from_usd

    assert len(film_from_usd(path).position) > 1


SMALL = {"width": 32, "height": 24}
WRITERS: dict[str, tuple[Callable[[Path], None], Callable[[Path], object]]] = {
    "a.ckpt": (lambda path: made()[0].save(path), lambda path: archive.load(path, checkpoint.KIND, checkpoint.VERSION)),
    "a.npz": (lambda path: made()[1].save(path), wr.Recording.load),
    "a.usda": (lambda path: wr.export_usd(made()[1], path), read_stage),
    "a.usdc": (lambda path: wr.export_usd(made()[1], path), read_stage),
    "a.usdz": (lambda path: wr.export_usd(made()[1], path), read_stage),
    "a.glb": (lambda path: export_gltf(made()[1], path), read_bytes),
    "a.png": (lambda path: save_picture(made()[2], path, **SMALL), read_image),
    "sheet.png": (lambda path: save_contact_sheet(made()[2], path, 2), read_image),
    "a.gif": (lambda path: save_film(made()[2], path, **SMALL), read_image),
    "a.parquet": (lambda path: made()[3].to_parquet(path), read),
    "plot.svg": (lambda path: made()[3].plot(path), read_bytes),
}
"""For each file what writes it, and what reads it whole."""


def other_files(folder: Path, name: str) -> list[str]:
    return sorted(file.name for file in folder.iterdir() if file.name != name)


def try_full_disk(case: tuple[str, float, bool], folder: Path) -> None:
    """Files of this process end at some bytes; what cannot be written leaves the old file, and nothing else."""
    name, share, again = case
    write, read_whole = WRITERS[name]
    path = folder / name
    write(path)
    before = path.read_bytes() if again else None
    limit = int(share * path.stat().st_size)
    if not again:
        path.unlink()
    kept = other_files(folder, name)
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, old[1]))
    try:
        write(path)
    except OSError as error:
        assert (path.read_bytes() if path.exists() else None) == before
        assert str(path) in str(error), error
        raise
    else:
        read_whole(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
        assert other_files(folder, name) == kept


KILLABLE = ("a.ckpt", "a.npz", "a.glb", "a.png", "a.parquet")
"""Files whose writers start no threads, which a fork would lack."""


def try_kill(case: tuple[str, float, bool], folder: Path) -> None:
    """A process that writes a file again and again is killed: the file is whole, or there is none."""
    name, seconds, again = case
    write, read_whole = WRITERS[name]
    path = folder / name
    path.unlink(missing_ok=True)
    if again:
        write(path)
    child = os.fork()
    if child == 0:
        try:
            while True:
                write(path)
        finally:
            os._exit(1)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status), "the writer ended by itself"
    if again or path.exists():
        read_whole(path)
    for left in other_files(folder, name):
        if left.startswith(f".{Path(name).stem}."):
            (folder / left).unlink()


TARGETS = [
    Target(
        "full disks",
        st.tuples(st.sampled_from(sorted(WRITERS)), st.one_of(st.floats(0.0, 1.2), st.just(0.0)), st.booleans()),
        try_full_disk,
    ),
    Target("kills", st.tuples(st.sampled_from(KILLABLE), st.floats(0.0, 0.05), st.booleans()), try_kill),
]
