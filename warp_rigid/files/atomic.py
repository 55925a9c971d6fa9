"""Files that are written whole or not at all."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

__all__ = ["whole_file"]


@contextlib.contextmanager
def whole_file(path: Any) -> Iterator[Path]:
    """A name beside `path` to write to, of the same ending; at the end the new file takes the old one's place at once.

    Whatever interrupts the writing leaves the old file as it was; missing folders are made.

    Raises:
        OSError: It cannot be written; names `path`.
    """
    path = Path(path)
    beside = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield beside
        with beside.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None
    finally:
        with contextlib.suppress(OSError):
            beside.unlink()
