"""Archives of arrays and one JSON header, written atomically and validated when read.

An archive is a .npz file: a zip archive of .npy members. Reading never executes code: members with Python objects are
rejected, and so are members whose declared size does not match their content. Only the members that are asked for are
read, after a check of their shape.
"""

import contextlib
import copy
import json
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.files.atomic import atomic_file

HEADER = "header"
"""Member that holds the JSON text, as bytes."""

LEAST_BYTES, MOST_EXPANSION = 2**29, 100
"""The arrays of a file may take 512 MiB [bytes], and this many times the size of the file in addition."""
LEAST_HEADER, MOST_HEADER_EXPANSION = 2**22, 50
"""The same for the header, whose text takes more time and memory than an array: 4 MiB, and 50 times its own size."""

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


def load(path: Any, kind: str, version: int) -> tuple[dict[str, Any], "Members"]:
    """Read the header of a file written by `save`, and return it with the arrays, each of which is read on first use.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is of another kind or version, truncated or damaged.
    """
    try:
        arrays = Members(Path(path))
        if HEADER not in arrays:
            raise ValueError("another kind of file")
        header = json.loads(arrays[HEADER].tobytes())
        if not isinstance(header, dict) or header.get("kind") != kind:
            raise ValueError("another kind of file")
        if header.get("version") != version:
            raise ValueError(f"version must be {version}, got {header.get('version')!r}")
        return header, arrays
    except OSError as error:
        if error.filename is not None:
            raise
        raise unusable(path, kind, error) from None  # an offset beyond the end of the file
    except UNREADABLE as error:
        raise unusable(path, kind, error) from None


class Members(Mapping[str, np.ndarray]):
    """The arrays of an archive by name. An array is read when it is asked for; other members are never read.

    Args:
        path: the file, which stays open as long as this object exists.
    """

    def __init__(self, path: Path) -> None:
        """Read the directory of the archive, and check that its header is not too large for its size in the file."""
        if path.exists() and not path.is_file():
            raise ValueError("must be a regular file")  # a named pipe would be waited for without end
        self._archive, self._prefix = zipfile.ZipFile(path), ""
        self._left = [LEAST_BYTES + MOST_EXPANSION * sum(m.compress_size for m in self._archive.infolist())]
        header = self._archive.NameToInfo.get(f"{HEADER}.npy")
        if header is not None and header.file_size > LEAST_HEADER + MOST_HEADER_EXPANSION * header.compress_size:
            raise ValueError(f"{HEADER} is too large for the size of the file")

    def below(self, prefix: str) -> "Members":
        """The arrays whose names start with a prefix, without it."""
        found = copy.copy(self)
        found._prefix = self._prefix + prefix
        return found

    def __iter__(self) -> Iterator[str]:
        """Names of the arrays."""
        names = (name.removesuffix(".npy") for name in self._archive.namelist())
        return (name.removeprefix(self._prefix) for name in names if name.startswith(self._prefix))

    def __len__(self) -> int:
        """Number of arrays."""
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        """Whether there is an array of this name."""
        return f"{self._prefix}{name}.npy" in self._archive.NameToInfo

    def __getitem__(self, name: str) -> np.ndarray:
        """Read an array."""
        dtype, shape = self.declared(name)
        self._left[0] -= math.prod(shape) * dtype.itemsize
        if self._left[0] < 0:
            raise ValueError(f"{name} is too large for the size of the file")
        with self._opened(name) as (_, stream):
            try:
                return np.lib.format.read_array(stream, allow_pickle=False)
            except ValueError:
                raise ValueError(f"{name} is truncated") from None

    def declared(self, name: str) -> tuple[np.dtype, tuple[int, ...]]:
        """Type and shape of an array, without reading its values."""
        with self._opened(name) as (member, stream):
            reader = READERS.get(np.lib.format.read_magic(stream))
            if reader is None:
                raise ValueError(f"{name} is of an unknown format")
            shape, _, dtype = reader(stream)
            if dtype.kind not in "biufU":
                raise ValueError(f"{name} must hold numbers or text, got {dtype}")
            if math.prod(shape) * dtype.itemsize != member.file_size - stream.tell():
                raise ValueError(f"{name} does not have its declared size")
            return dtype, shape

    @contextlib.contextmanager
    def _opened(self, name: str) -> Iterator[tuple[zipfile.ZipInfo, Any]]:
        """The description of a member, and its stream."""
        try:
            member = self._archive.getinfo(f"{self._prefix}{name}.npy")
            with self._archive.open(member) as stream:
                yield member, stream
        except OSError as error:
            raise ValueError(f"{name}: {error}") from None  # an offset beyond the end of the file


def unusable(path: Any, kind: str, error: Exception) -> ValueError:
    """The error for an invalid file, of one line."""
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return ValueError(f"{path}: not a {kind} of warp_rigid, or damaged: {reason}")


def shaped(arrays: Mapping[str, np.ndarray], name: str, dtype: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return one array of a file after a check of its type and shape (None: any length).

    Raises:
        ValueError: The array is missing, or has another type or shape.
    """
    if name not in arrays:
        raise ValueError(f"{name} is missing")
    found: Any = arrays[name] if not isinstance(arrays, Members) else None
    kind, extent = arrays.declared(name) if isinstance(arrays, Members) else (found.dtype, found.shape)
    fits = len(extent) == len(shape) and all(n is None or n == m for n, m in zip(shape, extent, strict=True))
    if kind != np.dtype(dtype) or not fits:
        raise ValueError(f"{name} must be {np.dtype(dtype)} shaped {shape}, got {kind} shaped {extent}")
    return arrays[name]
