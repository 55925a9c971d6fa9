"""Archives of arrays: only what is asked for is read, and no more than the file can hold."""

import io
import os
import resource
import zipfile

import numpy as np
import pytest

import warp_rigid as wr
from tests.fuzz.files import saved
from warp_rigid.files import archive

LOADERS = {"recording": wr.Recording.load, "checkpoint": lambda path: wr.Simulator.load(path, "cpu")}


def zeros(shape, dtype="<f8"):
    """A member of zeros, written piece by piece."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": dtype, "fortran_order": False, "shape": shape})
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    yield head.getvalue()
    for start in range(0, size, 2**24):
        yield bytes(min(2**24, size - start))


def with_member(path, kind, name, shape, dtype="<f8"):
    """A good file with one member added or replaced by zeros, deflated."""
    with (
        zipfile.ZipFile(io.BytesIO(saved(kind))) as good,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, True, 1) as new,
    ):
        for member in good.namelist():
            if member != name:
                new.writestr(member, good.read(member))
        with new.open(name, "w", force_zip64=True) as stream:
            for part in zeros(shape, dtype):
                stream.write(part)


def peak_memory():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@pytest.mark.parametrize("kind", LOADERS)
def test_an_unused_member_is_not_read(tmp_path, kind):
    with_member(tmp_path / "file", kind, "unused.npy", (2**26,))
    before = peak_memory()
    LOADERS[kind](tmp_path / "file")
    assert peak_memory() - before < 2**28


@pytest.mark.parametrize(
    ("kind", "name", "shape", "dtype", "told"),
    [
        ("recording", "position.npy", (2**26,), "<f4", "position must be float32 shaped"),
        ("recording", "time.npy", (2**27,), "<f8", "time is too large for the size of the file"),
        ("checkpoint", "State.position.npy", (2**26, 3), "<f4", "State.position must be float32 shaped"),
        ("checkpoint", "header.npy", (2**30,), "|u1", "header is too large for the size of the file"),
    ],
)
def test_a_member_that_is_too_large_is_refused_before_it_is_read(tmp_path, kind, name, shape, dtype, told):
    with_member(tmp_path / "file", kind, name, shape, dtype)
    before = peak_memory()
    with pytest.raises(ValueError, match=f"^{tmp_path}/file: not a .* or damaged: {told}"):
        LOADERS[kind](tmp_path / "file")
    assert peak_memory() - before < 2**28


def test_a_member_is_read_only_when_it_is_asked_for(tmp_path):
    archive.save(tmp_path / "file", "thing", 1, {}, {"a": np.arange(3), "part.b": np.zeros((2, 2))})
    _, arrays = archive.load(tmp_path / "file", "thing", 1)
    assert set(arrays) == {"header", "a", "part.b"} and list(arrays.below("part.")) == ["b"]
    assert arrays.declared("part.b") == (np.float64, (2, 2)) and "b" not in arrays
    np.testing.assert_array_equal(arrays.below("part.")["b"], np.zeros((2, 2)))


def test_a_header_that_is_much_larger_than_the_file_is_refused_before_it_is_parsed(tmp_path):
    """20 MB of brackets in a file of 20 kB: parsing them would take seconds and 600 MB."""
    path = tmp_path / "brackets.npz"
    text = b'{"kind": "checkpoint", "more": [' + b"[]," * 6_600_000 + b"[]]}"
    np.savez_compressed(path, header=np.frombuffer(text, np.uint8))
    with pytest.raises(ValueError, match="header is too large for the size of the file"):
        archive.load(path, "checkpoint", 1)


def test_a_named_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="must be a regular file"):
        archive.load(tmp_path / "pipe", "checkpoint", 1)
