"""Atomic replacement of files."""

import contextlib
import errno
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Any

__all__ = ["atomic_file", "check_replaceable", "replace_files"]


def check_replaceable(path: Any) -> None:
    """Check that there is no folder, device, pipe or socket at a path, which a file would otherwise replace.

    Raises:
        OSError: There is one.
    """
    path = Path(path)
    if path.is_dir():
        raise OSError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "must be a regular file", str(path))


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
def atomic_file(path: Any) -> Iterator[Path]:
    """Yield a temporary path to write to, which replaces `path` atomically at the end.

    The temporary file is in the same folder and has the same suffix. Its name is random and it is created exclusively,
    so that writers of one path do not interfere and no link that lies there is followed. If writing fails or is
    interrupted, the old file is unchanged. Missing folders are created.

    Raises:
        OSError: The file cannot be written, or something else than a file is there; the error names `path`.
    """
    path = Path(path)
    check_replaceable(path)
    temporary = path.with_name(f".{path.stem[:100]}.{secrets.token_hex(8)}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error).removeprefix(f"{temporary}: "), str(path)) from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
