"""Atomic replacement of files."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

__all__ = ["atomic_file"]


@contextlib.contextmanager
def atomic_file(path: Any) -> Iterator[Path]:
    """Yield a temporary path to write to, which replaces `path` atomically at the end.

    The temporary file is in the same folder and has the same suffix. If writing fails or is interrupted, the old file
    is unchanged. Missing folders are created.

    Raises:
        OSError: The file cannot be written; the error names `path`.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
