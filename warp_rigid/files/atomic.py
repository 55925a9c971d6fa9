"""Atomic replacement of files."""

import contextlib
import errno
import functools
import os
import secrets
import shutil
import stat
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

if sys.platform != "win32":  # where what killed processes leave stays
    import fcntl

TAG = "warp_rigid_"
"""What the names of hidden files contain, before a random number."""
MOST_BYTES = 100
"""Of the name of a file that are kept in that of its hidden file; a name has at most 255."""


def check_replaceable(path: Any) -> None:
    """Check that there is no folder, device, pipe or socket at a path, which a file would otherwise replace.

    Raises:
        OSError: There is one, or the name is too long.
    """
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return
    if stat.S_ISDIR(mode):
        raise OSError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "must be a regular file", str(path))


def check_unread(outputs: Iterable[Any], inputs: Iterable[Any]) -> None:
    """Check that no output is a file that is read, also under another name.

    Raises:
        ValueError: One is.
    """
    read = [Path(path) for path in inputs if Path(path).is_file()]
    for output in outputs:
        if any(Path(output).exists() and path.samefile(output) for path in read):
            raise ValueError(f"{output}: must not be a file that is read, which would be overwritten")


def replace_files(folder: Path, target: Path) -> None:
    """Move the files of a folder and of the folders in it to another folder of the same disk, over older ones.

    Those in folders are moved first, since the others refer to them.

    Raises:
        OSError: A file cannot be moved.
    """
    files = sorted((file for file in folder.rglob("*") if file.is_file()), key=lambda file: -len(file.parts))
    for file in files:
        with file.open("rb+") as stream:
            os.fsync(stream.fileno())
    for file in files:
        place = target / file.relative_to(folder)
        place.parent.mkdir(exist_ok=True)
        os.replace(file, place)


@contextlib.contextmanager
def hidden_beside(path: Path, is_folder: bool = False) -> Iterator[Path]:
    """Yield a new file or folder beside a path, with the same suffix, which is removed at the end if it is still there.

    Its name is random and it is created exclusively, so that writers of one path do not interfere and no link that lies
    there is followed. It is locked until the end. What a killed process leaves is not locked, and is removed by the
    next one that writes to the folder.

    Raises:
        OSError: It cannot be made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_leftovers(path.parent)
    descriptor, hidden = _claimed(path, is_folder)
    try:
        yield hidden
    finally:
        _remove(hidden)
        os.close(descriptor)


def _claimed(path: Path, is_folder: bool) -> tuple[int, Path]:
    """Make and lock a hidden file or folder. If another process removes it before it is locked, another one is made."""
    stem = path.stem.encode()[:MOST_BYTES].decode(errors="ignore")
    while True:
        hidden = path.with_name(f".{stem}.{TAG}{secrets.token_hex(8)}{path.suffix}")
        if is_folder:
            hidden.mkdir()
        else:
            os.close(os.open(hidden, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        with contextlib.suppress(FileNotFoundError):
            descriptor = os.open(hidden, os.O_RDONLY)
            if sys.platform != "win32":
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            if os.fstat(descriptor).st_nlink:
                return descriptor, hidden
            os.close(descriptor)


@functools.cache
def _remove_leftovers(folder: Path) -> None:
    """Remove, once in a process, the hidden files and folders in a folder that no process has locked."""
    if sys.platform == "win32":
        return
    for hidden in folder.glob(f".*.{TAG}*"):
        with contextlib.suppress(OSError):
            descriptor = os.open(hidden, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _remove(hidden)
            finally:
                os.close(descriptor)


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


@contextlib.contextmanager
def atomic_file(path: Any) -> Iterator[Path]:
    """Yield a temporary path to write to, which replaces `path` atomically at the end.

    The temporary file is one of `hidden_beside`. If writing fails or is interrupted, the old file is unchanged. Missing
    folders are created.

    Raises:
        OSError: The file cannot be written, or something else than a file is there; the error names `path`.
    """
    path = Path(path)
    check_replaceable(path)
    temporary = path
    try:
        with hidden_beside(path) as temporary:
            yield temporary
            with temporary.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error).removeprefix(f"{temporary}: "), str(path)) from None
