"""Files of arrays and one JSON header, written whole or not at all, and read with care.

A file is a .npz: a zip archive of .npy members. Nothing in it is ever run: members of Python objects are refused, and
so is a member that claims more bytes than it has.
"""

import json
import math
import struct
import tokenize
import zipfile
import zlib
from typing import Any

import numpy as np

from warp_rigid.files.atomic import whole_file

HEADER = "header"
"""Member that holds the JSON text, as bytes."""

MOST_BYTES = 2**36
"""Larger files are refused."""

READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}

UNREADABLE = (
    ValueError, KeyError, TypeError, EOFError, OverflowError, RecursionError, MemoryError, NotImplementedError,
    RuntimeError, SyntaxError, tokenize.TokenError, zipfile.BadZipFile, zlib.error, struct.error,
)  # fmt: skip
"""What reading a file that was cut off, damaged or made by something else can raise."""


def save(
    path: Any, kind: str, version: int, header: dict[str, Any], arrays: dict[str, np.ndarray], compress: bool = False
) -> None:
    """Write a file; a reader, or a crash in between, finds the old one or the new one, never a part.

    Args:
        path: where; missing folders are made.
        kind: what the file is, in words.
        version: of the format.
        header: plain data for JSON.
        arrays: by name.
        compress: take less room, and more time.

    Raises:
        OSError: it cannot be written; an old file is as it was.
    """
    text = json.dumps({"kind": kind, "version": version, **header}).encode()
    write: Any = np.savez_compressed if compress else np.savez
    with whole_file(path) as beside, beside.open("wb") as stream:
        write(stream, **{HEADER: np.frombuffer(text, np.uint8)}, **arrays)


def load(path: Any, kind: str, version: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read a file that `save` wrote: its header and its arrays.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not of this kind or version, cut off or damaged; one line that names it.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > MOST_BYTES:
                raise ValueError(f"claims more than {MOST_BYTES} bytes")
            if f"{HEADER}.npy" not in archive.namelist():
                raise ValueError("another kind of file")
            header = json.loads(_read(archive, f"{HEADER}.npy").tobytes())
            if not isinstance(header, dict) or header.get("kind") != kind:
                raise ValueError("another kind of file")
            if header.get("version") != version:
                raise ValueError(f"version {header.get('version')!r}, but {version} is what can be read")
            names = [name for name in archive.namelist() if name != f"{HEADER}.npy"]
            return header, {name.removesuffix(".npy"): _read(archive, name) for name in names}
    except OSError as error:
        if error.filename is not None:
            raise
        raise unusable(path, kind, error) from None  # a place in the file that does not exist
    except UNREADABLE as error:
        raise unusable(path, kind, error) from None


def unusable(path: Any, kind: str, error: Exception) -> ValueError:
    """The one line that refuses a file."""
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return ValueError(f"{path}: not a {kind} of warp_rigid, or not a whole one: {reason}")


def shaped(arrays: dict[str, np.ndarray], name: str, dtype: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """One array of a file, of this type and shape (None: any length).

    Raises:
        ValueError: there is none.
    """
    array = arrays.get(name)
    if array is None:
        raise ValueError(f"{name} is missing")
    fits = array.ndim == len(shape) and all(n is None or n == m for n, m in zip(shape, array.shape, strict=True))
    if array.dtype != np.dtype(dtype) or not fits:
        raise ValueError(f"{name} must be {np.dtype(dtype)} shaped {shape}, got {array.dtype} shaped {array.shape}")
    return array


def _read(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """One member, if it holds as many plain numbers as it says."""
    member = archive.getinfo(name)
    with archive.open(member) as stream:
        reader = READERS.get(np.lib.format.read_magic(stream))
        if reader is None:
            raise ValueError(f"{name} is of an unknown format")
        shape, fortran, dtype = reader(stream)
        if dtype.kind not in "biufU":
            raise ValueError(f"{name} must hold numbers or text, got {dtype}")
        size = math.prod(shape) * dtype.itemsize
        if size != member.file_size - stream.tell():
            raise ValueError(f"{name} has not as many numbers as it says")
        content = stream.read(size)
    if len(content) != size:
        raise ValueError(f"{name} is cut off")
    array = np.frombuffer(content, dtype) if size else np.zeros(math.prod(shape), dtype)
    return array.reshape(shape, order="F" if fortran else "C")
