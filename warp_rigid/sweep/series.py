"""Time series of a sweep: in memory, or in a folder to which each batch adds a file."""

import hashlib
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.files.atomic import atomic_file
from warp_rigid.sweep.design import Run

__all__ = ["Series", "read_series", "series_folder"]

SUFFIX = ".series"


def series_folder(output: Any) -> Path:
    """The folder of the time series beside a table."""
    return Path(output).with_suffix(SUFFIX)


class Series:
    """The time series of a sweep.

    Each batch is written to a Parquet file of its own before its rows enter the table. After an interruption no row is
    without its series; a series without a row is written again with the same values, and read once.

    Args:
        output: the table; None keeps the series in memory.
        resume: keep the files of an existing folder.
    """

    def __init__(self, output: Any, resume: bool) -> None:
        """Open the folder; without `resume` an existing one is emptied."""
        self.folder = None if output is None else series_folder(output)
        self.parts: list[Any] = []
        if self.folder is not None and not resume and self.folder.is_dir():
            shutil.rmtree(self.folder)

    def add(self, runs: Sequence[Run], looks: dict[str, np.ndarray]) -> None:
        """Store the series of a batch.

        Args:
            runs: the runs of the batch.
            looks: "time" (looks,) [s] and for each name (looks, runs, ...) values.
        """
        table = _table(runs, looks)
        if self.folder is None:
            self.parts.append(table)
            return
        import pyarrow.parquet

        name = hashlib.sha256(",".join(run.id for run in runs).encode()).hexdigest()[:16]
        with atomic_file(self.folder / f"{name}.parquet") as temporary, temporary.open("wb") as file:
            pyarrow.parquet.write_table(table, file, compression="zstd")

    def table(self) -> Any:
        """All series as a pyarrow.Table; see read_series."""
        return read_series(self.folder) if self.folder is not None else _in_order(self.parts)


def read_series(folder: Any) -> Any:
    """Read the time series of a sweep.

    Args:
        folder: the folder that the sweep wrote, `TABLE.series`.

    Returns:
        A pyarrow.Table with the columns run, time [s] and one for each series, ordered by run and time.

    Raises:
        FileNotFoundError: there is no such folder.
    """
    import pyarrow.parquet

    if not Path(folder).is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    return _in_order([pyarrow.parquet.read_table(path) for path in sorted(Path(folder).glob("*.parquet"))])


def _table(runs: Sequence[Run], looks: dict[str, np.ndarray]) -> Any:
    """One row for each run and look, run by run."""
    import pyarrow

    count = len(looks["time"])
    columns: dict[str, Any] = {
        "run": np.repeat(np.array([run.index for run in runs], np.int64), count),
        "time": np.tile(looks["time"], len(runs)),
    }
    for name, values in looks.items():
        if name != "time":
            by_run = np.swapaxes(values, 0, 1).reshape(len(runs) * count, -1)
            columns[name] = by_run[:, 0] if values.ndim == 2 else list(by_run)
    return pyarrow.table(columns)


def _in_order(tables: list[Any]) -> Any:
    """All rows by run and time, each once."""
    import pyarrow

    if not tables:
        return pyarrow.table({"run": pyarrow.array([], pyarrow.int64()), "time": pyarrow.array([], pyarrow.float64())})
    table = pyarrow.concat_tables(tables, promote_options="permissive")
    keys = np.stack([table.column("run").to_numpy(), table.column("time").to_numpy()], axis=1)
    return table.take(np.unique(keys, axis=0, return_index=True)[1])
