"""Files are written whole or not at all: on a full disk, by several writers at once, and beside planted links."""

import contextlib
import os
import resource
import subprocess
import sys
import threading
import zipfile

import numpy as np
import pytest
from pxr import Usd, UsdUtils

import warp_rigid as wr
from warp_rigid.commands.terminal import check_writable
from warp_rigid.files import archive
from warp_rigid.files.atomic import _remove_leftovers, atomic_file
from warp_rigid.usd.instancing import flatten_usd


@pytest.fixture(scope="module")
def recording():
    sim = wr.Simulator(wr.scenes.load("box_stack", height=3), num_envs=2, device="cpu")
    return wr.record(sim, 4)


@contextlib.contextmanager
def full_disk(size=1000):
    """Files of this process end at some bytes, as they do on a disk that becomes full while they are written."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("damage", [300, 0, -1])
def test_a_package_that_is_incomplete_is_an_error(tmp_path, recording, monkeypatch, damage):
    """On a full disk the library reports success, and the file is cut off, empty or of zeros."""
    wr.export_usd(recording, tmp_path / "a.usdz")
    before = (tmp_path / "a.usdz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.usdz") as package:
        assert package.testzip() is None
    make = UsdUtils.CreateNewUsdzPackage

    def on_a_full_disk(inner, path):
        make(inner, path)
        with open(path, "rb+") as file:
            if damage < 0:
                file.seek(100)
                file.write(bytes(1000))
            else:
                file.truncate(damage)
        return True

    monkeypatch.setattr(UsdUtils, "CreateNewUsdzPackage", on_a_full_disk)
    with pytest.raises(OSError, match="cannot be written"):
        wr.export_usd(recording, tmp_path / "a.usdz")
    assert [file.name for file in tmp_path.iterdir()] == ["a.usdz"]
    assert (tmp_path / "a.usdz").read_bytes() == before


@pytest.mark.parametrize("size", [0, 10, 1000])
@pytest.mark.parametrize("suffix", [".usdc", ".usda", ".usdz", ".usd"])
def test_an_export_onto_a_full_disk_leaves_the_old_film(tmp_path, recording, suffix, size):
    path = tmp_path / f"a{suffix}"
    wr.export_usd(recording, path)
    before = path.read_bytes()
    with full_disk(size), pytest.raises(OSError) as error:
        wr.export_usd(recording, path)
    assert str(path) in str(error.value)
    assert [file.name for file in tmp_path.iterdir()] == [path.name] and path.read_bytes() == before
    if suffix != ".usdz":
        with full_disk(), pytest.raises(OSError):
            flatten_usd(path, path.with_name("b.usda"))
        assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("options", [{}, {"layout": "payloads"}, {"layout": "clips"}])
def test_a_stream_onto_a_full_disk_tells_it_once_and_again(tmp_path, options):
    """The error of the first frame that is not written is that of every later call, too."""
    sim = wr.Simulator(wr.scenes.load("box_stack", height=3), device="cpu")
    path = tmp_path / "a.usdc"
    with pytest.raises(OSError, match="cannot be written") as error:
        with wr.UsdStream(sim, path, **options) as film, full_disk():
            for _ in range(60):
                sim.step(4)
                film.capture(sim)
    with pytest.raises(OSError) as again:
        film.close()
    assert str(again.value) == str(error.value)


def files_of(folder):
    return {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize("layout", ["single", "payloads", "clips"])
@pytest.mark.parametrize(("suffix", "profile"), [(".usdc", "animation"), (".usda", "animation"), (".usdc", "scene")])
def test_a_stream_onto_a_full_disk_leaves_the_old_film(tmp_path, recording, suffix, profile, layout):
    """All files of the older film, byte for byte, and no other ones; with room, the new film replaces it."""
    sim = wr.Simulator(wr.scenes.load("box_stack", height=3), device="cpu")
    path = tmp_path / f"a{suffix}"
    wr.export_usd(recording, path, profile=profile, layout=layout)
    before = files_of(tmp_path)

    def stream():
        with wr.UsdStream(sim, path, profile=profile, layout=layout) as film:
            for _ in range(30):
                sim.step(4)
                film.capture(sim)

    with full_disk(6000), pytest.raises(OSError) as error:
        stream()
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    assert files_of(tmp_path) == before
    stream()
    assert Usd.Stage.Open(str(path)).GetEndTimeCode() == 30.0
    assert not [file.name for file in tmp_path.iterdir() if file.name.startswith(".")]


def test_an_old_film_stays_until_the_new_one_is_complete(tmp_path, recording):
    """Also if the writer is killed or the run is interrupted by an error of its own."""
    sim = wr.Simulator(wr.scenes.load("box_stack", height=3), device="cpu")
    path = tmp_path / "a.usdc"
    wr.export_usd(recording, path)
    before = path.read_bytes()
    film = wr.UsdStream(sim, path)
    for _ in range(30):
        sim.step(4)
        film.capture(sim)
        assert path.read_bytes() == before
    film.close()
    assert Usd.Stage.Open(str(path)).GetEndTimeCode() == 30.0 and list(tmp_path.iterdir()) == [path]


def test_an_override_onto_a_full_disk_leaves_the_old_one(tmp_path):
    wr.export_usd(wr.record(wr.Simulator(wr.scenes.load("box_stack", height=3), device="cpu"), 0), tmp_path / "a.usda")
    scene = wr.import_usd(tmp_path / "a.usda")
    film = wr.record(wr.Simulator(scene, device="cpu"), 4)
    wr.export_usd(film, tmp_path / "b.usda", layout="override")
    before = files_of(tmp_path)
    with full_disk(10), pytest.raises(OSError, match=r"b\.usda"):
        wr.export_usd(film, tmp_path / "b.usda", layout="override")
    assert files_of(tmp_path) == before


def test_an_open_stage_shows_the_film_that_replaced_its_file(tmp_path, recording):
    wr.export_usd(recording, tmp_path / "a.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert stage.GetEndTimeCode() == 4.0
    sim = wr.Simulator(wr.scenes.load("box_stack", height=3), device="cpu")
    wr.export_usd(wr.record(sim, 7), tmp_path / "a.usdc")
    assert stage.GetEndTimeCode() == 7.0


def test_writers_of_one_path_do_not_disturb_each_other(tmp_path):
    """Each writes all of its file; the last one to finish stays."""
    path, errors = tmp_path / "a.npz", []
    parties = threading.Barrier(8)

    def write(value):
        try:
            for _ in range(20):
                parties.wait(10)
                archive.save(path, "thing", 1, {"value": value}, {"x": np.full(1000, value)})
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=write, args=(value,)) for value in range(8)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert not errors
    header, arrays = archive.load(path, "thing", 1)
    assert (arrays["x"] == header["value"]).all()
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_but_a_file_is_replaced(tmp_path):
    """Not a pipe, nor a device such as /dev/null, which an administrator may replace."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name in ("pipe", "folder"):
        for check in (check_writable, lambda path: archive.save(path, "thing", 1, {}, {})):
            with pytest.raises(OSError) as error:
                check(tmp_path / name)
            assert error.value.filename == str(tmp_path / name)
    assert (tmp_path / "pipe").is_fifo() and len(list(tmp_path.iterdir())) == 2


def test_a_planted_link_is_not_followed(tmp_path, monkeypatch):
    """Neither at a name that is easily guessed nor at the very name that is chosen."""
    victim = tmp_path / "victim"
    victim.write_text("precious")
    for name in (".a.tmp.npz", ".a.npz.tmp", ".a.warp_rigid_chosen.npz", "a.tmp.npz"):
        os.symlink(victim, tmp_path / name)
    archive.save(tmp_path / "a.npz", "thing", 1, {}, {})
    monkeypatch.setattr("secrets.token_hex", lambda _: "chosen")
    with pytest.raises(OSError):
        archive.save(tmp_path / "a.npz", "thing", 1, {}, {})
    assert victim.read_text() == "precious"


LEFT = """
import os, sys
from pathlib import Path
import warp_rigid as wr
from warp_rigid.files.atomic import atomic_file
if sys.argv[2] == "film":
    film = wr.UsdStream(wr.Simulator(wr.scenes.load("box_stack", height=2), device="cpu"), sys.argv[1])
    os.kill(os.getpid(), 9)
with atomic_file(sys.argv[1]) as temporary:
    temporary.write_text("half")
    os.kill(os.getpid(), 9)
"""


@pytest.mark.long
@pytest.mark.parametrize("kind", ["film", "file"])
def test_what_a_killed_process_leaves_is_removed_by_the_next(tmp_path, recording, kind):
    """But not what another process still writes, nor what belongs to others."""
    path = tmp_path / "a.usdc"
    wr.export_usd(recording, path)
    before = path.read_bytes()
    done = subprocess.run([sys.executable, "-c", LEFT, str(path), kind])
    assert done.returncode == -9 and path.read_bytes() == before and len(list(tmp_path.iterdir())) == 2
    (tmp_path / ".a.1234.usdc").write_text("of another program")
    _remove_leftovers.cache_clear()
    with atomic_file(tmp_path / "b.txt") as other:
        _remove_leftovers.cache_clear()
        with atomic_file(path) as temporary:
            temporary.write_text("new")
            names = {file.name for file in tmp_path.iterdir()}
            assert names == {path.name, ".a.1234.usdc", other.name, temporary.name}
        other.write_text("done")
    assert {file.name for file in tmp_path.iterdir()} == {path.name, ".a.1234.usdc", "b.txt"}


@pytest.mark.parametrize("letter", ["a", "\u00e4", "\U0001f600"])
def test_names_of_up_to_255_bytes(tmp_path, letter):
    """Also of letters that take several bytes."""
    length = 250 // len(letter.encode())
    path = tmp_path / (letter * length + ".usda")
    with atomic_file(path) as temporary:
        temporary.write_text("x")
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_the_permissions_are_those_of_a_new_file(tmp_path):
    with atomic_file(tmp_path / "a.txt") as temporary:
        temporary.write_text("x")
    (tmp_path / "b.txt").write_text("x")
    assert (tmp_path / "a.txt").stat().st_mode == (tmp_path / "b.txt").stat().st_mode
