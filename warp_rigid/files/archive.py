"""Archives of arrays and one JSON header, written atomically and validated when read.

An archive is a .npz file: a zip archive of .npy members. Reading never executes code: members with Python objects are
rejected, and so are members whose declared size does not match their content.
"""

import json
import math
import struct
import tokenize
import zipfile
import zlib
from typing import Any

import numpy as np

from warp_rigid.files.atomic import atomic_file

HEADER = "header"
"""Member that holds the JSON text, as bytes."""

MAX_BYTES = 2**36
"""Maximum uncompressed size [bytes]."""

READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}

UNREADABLE = (
    ValueError, KeyError, TypeError, EOFError, OverflowError, RecursionError, MemoryError, NotImplementedError,
    RuntimeError, SyntaxError, tokenize.TokenError, zipfile.BadZipFile, zlib.error, struct.error,
)  # fmt: skip
"""Exceptions raised by reading a truncated, damaged or foreign file."""


def save(
    path: Any, kind: str, version: int, header: dict[str, Any], arrays: dict[str, np.ndarray], compress: bool = False
) -> None:
    """Write an archive atomically.

    Args:
        path: output file; missing folders are created.
        kind: kind of the file, for validation and messages.
        version: version of the format.
        header: plain data for JSON.
        arrays: arrays by name.
        compress: whether to compress the arrays.

    Raises:
        OSError: The file cannot be written; an existing file is unchanged.
    """
    text = json.dumps({"kind": kind, "version": version, **header}).encode()
    write: Any = np.savez_compressed if compress else np.savez
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        write(stream, **{HEADER: np.frombuffer(text, np.uint8)}, **arrays)


def load(path: Any, kind: str, version: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the header and the arrays of a file written by `save`.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is of another kind or version, truncated or damaged.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > MAX_BYTES:
                raise ValueError(f"must be at most {MAX_BYTES} bytes")
            if f"{HEADER}.npy" not in archive.namelist():
                raise ValueError("another kind of file")
            header = json.loads(_read(archive, f"{HEADER}.npy").tobytes())
            if not isinstance(header, dict) or header.get("kind") != kind:
                raise ValueError("another kind of file")
            if header.get("version") != version:
                raise ValueError(f"version must be {version}, got {header.get('version')!r}")
            names = [name for name in archive.namelist() if name != f"{HEADER}.npy"]
            return header, {name.removesuffix(".npy"): _read(archive, name) for name in names}
    except OSError as error:
        if error.filename is not None:
            raise
        raise unusable(path, kind, error) from None  # an offset beyond the end of the file
    except UNREADABLE as error:
        raise unusable(path, kind, error) from None


def unusable(path: Any, kind: str, error: Exception) -> ValueError:
    """The error for an invalid file, of one line."""
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return ValueError(f"{path}: not a {kind} of warp_rigid, or damaged: {reason}")


def shaped(arrays: dict[str, np.ndarray], name: str, dtype: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return one array of a file and check its type and shape (None: any length).

    Raises:
        ValueError: The array is missing, or has another type or shape.
    """
    array = arrays.get(name)
    if array is None:
        raise ValueError(f"{name} is missing")
    fits = array.ndim == len(shape) and all(n is None or n == m for n, m in zip(shape, array.shape, strict=True))
    if array.dtype != np.dtype(dtype) or not fits:
        raise ValueError(f"{name} must be {np.dtype(dtype)} shaped {shape}, got {array.dtype} shaped {array.shape}")
    return array


def _read(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Read one member and check its type and size."""
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
            raise ValueError(f"{name} does not have its declared size")
        content = stream.read(size)
    if len(content) != size:
        raise ValueError(f"{name} is truncated")
    array = np.frombuffer(content, dtype) if size else np.zeros(math.prod(shape), dtype)
    return array.reshape(shape, order="F" if fortran else "C")
