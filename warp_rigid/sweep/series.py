"""Time series of a sweep, in memory, in a folder to which each batch adds a Parquet file, or in a zarr folder.

The trajectories of its runs are in a zarr folder, too.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.files.atomic import atomic_file
from warp_rigid.sweep.design import Run, digest

SUFFIX = ".series"
ZARR = ".zarr"

EXISTS = "already exists; resume=True (--resume) continues it, overwrite=True (--overwrite) replaces it"
"""Why a sweep does not start: the end of a message that begins with the path."""

RUNS_PER_CHUNK = 64
"""Runs of a chunk of a zarr array, which is one file."""


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
            looks: "time" (runs, samples) [s] and for each name (runs, samples, ...) values.
        """
        table = _table([run.index for run in runs], looks)
        if self.folder is None:
            self.parts.append(table)
            return
        import pyarrow.parquet

        name = digest(",".join(run.id for run in runs).encode())
        with atomic_file(self.folder / f"{name}.parquet") as temporary, temporary.open("wb") as file:
            pyarrow.parquet.write_table(table, file, compression="zstd")

    def table(self) -> Any:
        """All series as a pyarrow.Table; see read_series."""
        return read_series(self.folder) if self.folder is not None else _in_order(self.parts)


class ZarrFolder:
    """A zarr folder with arrays (runs, ...), indexed by the column `run` of the table; missing values are NaN.

    Chunks are replaced atomically; as in `Series`, all of a run is written before its row.

    Args:
        argument: the argument of `sweep` that is the path, for messages.
        path: the folder; must end in .zarr.
        about: metadata of the sweep.
        resume: add to an existing folder.
        overwrite: replace an existing folder.

    Raises:
        ValueError: The path has another suffix, or exists and is neither resumed nor overwritten.
    """

    def __init__(self, argument: str, path: Any, about: dict[str, Any], resume: bool, overwrite: bool) -> None:
        """Open or create the folder."""
        import zarr

        self.folder = Path(path)
        if self.folder.suffix != ZARR:
            raise ValueError(f"{argument}: must end in {ZARR}, got {self.folder}")
        if self.folder.exists() and not resume:
            if not overwrite:
                raise ValueError(f"{self.folder}: {EXISTS}")
            shutil.rmtree(self.folder)
        self.root: Any = zarr.open_group(self.folder, mode="a")
        self._num_runs = about["runs"]

    def put(self, name: str, runs: Sequence[Run], values: np.ndarray, runs_per_chunk: int, axes: Sequence[str]) -> None:
        """Store (runs, samples, ...) values in the array of a name, which is created or enlarged if needed."""
        shape = (self._num_runs, *values.shape[1:])
        if name not in self.root:
            chunks = (runs_per_chunk, *shape[1:])
            self.root.create_array(
                name, shape=shape, chunks=chunks, dtype=values.dtype, fill_value=np.nan, dimension_names=["run", *axes]
            )
        array = self.root[name]
        wanted = (*map(max, array.shape[:2], shape[:2]), *array.shape[2:])
        if wanted != array.shape:
            array.resize(wanted)
        rows = np.array([run.index for run in runs])
        array.set_orthogonal_selection((rows, slice(0, shape[1])), values)


class ZarrSeries(ZarrFolder):
    """The time series of a sweep in a zarr folder: `time` [s] and one array (runs, samples, ...) for each series.

    Raises:
        ValueError: As ZarrFolder, or the folder contains the series of a different sweep.
    """

    def __init__(self, path: Any, about: dict[str, Any], resume: bool, overwrite: bool) -> None:
        """Open or create the folder."""
        super().__init__("series_output", path, about, resume, overwrite)
        own = {name: about[name] for name in ("scene", "duration", "fps", "version", "series")}
        if self.root.attrs.get("warp_rigid", own) != own:
            raise ValueError(f"{path}: holds the series of a different sweep; choose another name")
        self.root.attrs["warp_rigid"] = own

    def add(self, runs: Sequence[Run], looks: dict[str, np.ndarray]) -> None:
        """See Series.add."""
        for name, values in looks.items():
            axes = ("sample", "component")[: values.ndim - 1]
            self.put(name, runs, values.astype(np.float64), RUNS_PER_CHUNK, axes)

    def table(self) -> Any:
        """All series as a pyarrow.Table; see read_series."""
        return read_series(self.folder)


class Trajectories(ZarrFolder):
    """The trajectories of a sweep in a zarr folder.

    Runs with the same structure and time step share a group, named by the column `trajectory` of a row. It holds `time`
    (frames,) [s], `position` (runs, frames, bodies, 3) [m] and `orientation` (runs, frames, bodies, 4). Each chunk
    holds one run, so that runs can be read separately and missing runs use no disk space.
    """

    def __init__(self, path: Any, about: dict[str, Any], resume: bool, overwrite: bool) -> None:
        """Open or create the folder."""
        super().__init__("trajectories", path, about, resume, overwrite)
        self.root.attrs["warp_rigid"] = {name: about[name] for name in ("scene", "duration", "fps", "version")}

    def add(self, runs: Sequence[Run], frames: dict[str, Any]) -> None:
        """Store the trajectories of a batch.

        Args:
            runs: the runs of the batch.
            frames: "group", "time", "position" and "orientation" (runs, frames, bodies, ...).
        """
        group = self.root.require_group(frames["group"])
        if "time" not in group:
            group.create_array("time", data=frames["time"], dimension_names=["frame"])
        for name, last in (("position", "xyz"), ("orientation", "xyzw")):
            self.put(f"{frames['group']}/{name}", runs, frames[name], 1, ("frame", "body", last))


def read_series(folder: Any) -> Any:
    """Read the time series of a sweep.

    Args:
        folder: the folder that the sweep wrote, `TABLE.series` or a .zarr folder.

    Returns:
        A pyarrow.Table with the columns run, time [s] and one for each series, ordered by run and time.

    Raises:
        FileNotFoundError: there is no such folder.
    """
    import pyarrow.parquet

    if not Path(folder).is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    if Path(folder).suffix == ZARR:
        import zarr

        root: Any = zarr.open_group(Path(folder), mode="r")
        looks = {name: root[name][:] for name in ("time", *root.attrs["warp_rigid"]["series"]) if "time" in root}
        return _table(range(len(looks["time"])), looks) if looks else _in_order([])
    # A process that is killed while it writes leaves a temporary file, whose name begins with a dot.
    return _in_order([pyarrow.parquet.read_table(path) for path in sorted(Path(folder).glob("[!.]*.parquet"))])


def _table(runs: Any, looks: dict[str, np.ndarray]) -> Any:
    """One row for each run and finished sample, run by run; looks as for Series.add."""
    import pyarrow

    done = np.isfinite(looks["time"])
    columns: dict[str, Any] = {"run": np.asarray(runs, np.int64)[np.nonzero(done)[0]]}
    for name, values in looks.items():
        columns[name] = values[done] if values.ndim == 2 else list(values[done])
    return pyarrow.table(columns)


def _in_order(tables: list[Any]) -> Any:
    """All rows by run and time, each once."""
    import pyarrow

    if not tables:
        return pyarrow.table({"run": pyarrow.array([], pyarrow.int64()), "time": pyarrow.array([], pyarrow.float64())})
    table = pyarrow.concat_tables(tables, promote_options="permissive")
    _, first = np.unique([table.column(name).to_numpy() for name in ("run", "time")], axis=1, return_index=True)
    return table.take(first)
