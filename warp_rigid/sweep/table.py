"""Result tables: rows in memory, Parquet files that are replaced atomically, and their metadata."""

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid import scenes
from warp_rigid.checks import instance_of, listed, shown, suggestion
from warp_rigid.display import html_of
from warp_rigid.extras import need
from warp_rigid.files.atomic import atomic_file, check_replaceable
from warp_rigid.sweep.axes import plain
from warp_rigid.sweep.batch_run import Batch, prepare
from warp_rigid.sweep.columns import COLUMNS, FINISHED, METADATA_TYPES, REQUIRED_COLUMNS, metadata_field, unit_of
from warp_rigid.sweep.design import MAX_RUNS, Run
from warp_rigid.sweep.job import Job, resolve_scene
from warp_rigid.sweep.result_plots import plot
from warp_rigid.sweep.series import EXISTS, Series, ZarrSeries, series_folder

WRITE_INTERVAL_RATIO = 10.0
"""Minimum time between two writes of the file, relative to the duration of a write."""

METADATA = b"warp_rigid"


class SweepResult:
    """The rows of a sweep, in the order of its design.

    Attributes:
        rows: one dictionary per run: run, id, seed, parameters, environment, status, reason, peak pair and contact
            counts, metrics, wall_time [s].
        about: metadata: scene, design, versions.
        source: the scene as passed to `sweep`; for a table read from a file, the name of its built-in scene, or None.
    """

    def __init__(
        self,
        rows: Sequence[dict[str, Any]],
        about: dict[str, Any],
        source: Any = None,
        series: Series | ZarrSeries | None = None,
    ) -> None:
        """Sort the rows by their position in the design."""
        self._series = series
        self.rows = sorted(rows, key=lambda row: row["run"])
        self.about = about
        named = about.get("source")
        self.source = source if source is not None else named if named in scenes.names() else None

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.rows)

    def __repr__(self) -> str:
        """Show the number of runs."""
        scene = str(self.about.get("scene")).partition(":")[0]
        return f"SweepResult({len(self)} runs of {scene}, {len(self.failed)} failed)"

    def _repr_html_(self) -> str:
        return html_of(self)

    @property
    def failed(self) -> list[dict[str, Any]]:
        """Rows of runs that did not complete."""
        return [row for row in self.rows if row["status"] not in FINISHED]

    @property
    def names(self) -> list[str]:
        """Names of the columns."""
        return list(dict.fromkeys(name for names in dict.fromkeys(map(tuple, self.rows)) for name in names))

    @property
    def axes(self) -> list[str]:
        """Names of the axes."""
        return list(self.about.get("axes", ()))

    @property
    def metrics(self) -> list[str]:
        """Names of the metric columns."""
        return [name for name in self.names if name not in COLUMNS and name not in self.about.get("parameters", ())]

    def series(self) -> Any:
        """Return the time series as a pyarrow.Table with the columns run, time [s] and one for each name of `series`.

        Raises:
            ValueError: The sweep has no series, or no folder of series is beside the table.
        """
        if self._series is None:
            raise ValueError("series: none were kept; give series to sweep, or read the folder with read_series")
        return self._series.table()

    def column(self, name: str) -> np.ndarray:
        """Values of a column, one per row; NaN for a missing number.

        Raises:
            ValueError: The column does not exist.
        """
        if name not in self.names:
            raise ValueError(
                f"column: must be a column, got {shown(name)}{suggestion(name, self.names, 'result.names')}"
            )
        values = [row.get(name) for row in self.rows]
        if any(isinstance(value, tuple | list) for value in values):
            return _objects(values)
        if all(value is None or isinstance(value, float | int) for value in values) and None in values:
            return np.array([np.nan if value is None else value for value in values], float)
        return _objects(values) if None in values else np.array(values)

    @property
    def units(self) -> dict[str, str]:
        """Units by the names of the columns that have one."""
        stated = self.about.get("units", {})
        found = {name: unit_of(name) or stated.get(name) for name in self.names}
        return {name: str(unit) for name, unit in found.items() if unit}

    def to_arrow(self) -> Any:
        """The rows as a pyarrow.Table, with units as the metadata `unit` of the fields."""
        pyarrow = need("pyarrow")
        columns = {name: _arrow_column(name, [row.get(name) for row in self.rows]) for name in self.names}
        units = {name: {"unit": unit} for name, unit in self.units.items()}
        fields = [pyarrow.field(name, column.type, metadata=units.get(name)) for name, column in columns.items()]
        return pyarrow.table(list(columns.values()), schema=pyarrow.schema(fields))

    def to_pandas(self) -> Any:
        """The rows as a pandas.DataFrame, with `units` as attrs["units"].

        Raises:
            ModuleNotFoundError: pandas is not installed.
        """
        need("pandas")
        frame = self.to_arrow().to_pandas()
        frame.attrs["units"] = self.units
        return frame

    def to_polars(self) -> Any:
        """The rows as a polars.DataFrame, which cannot store units.

        Raises:
            ModuleNotFoundError: polars is not installed.
        """
        return need("polars").from_arrow(self.to_arrow())

    def to_xarray(self) -> Any:
        """The rows as an xarray.Dataset, with units as attrs["units"] of its variables.

        A grid has one dimension for each axis, and `repeat` if there are repeats; values of missing runs are NaN. Other
        designs have the dimension `run`, along which the axes are coordinates.

        Raises:
            ModuleNotFoundError: xarray is not installed.
        """
        xarray = need("xarray")
        grid = _grid(self) if self.rows else None
        row = "row" if grid else "run"
        found = xarray.Dataset({name: _variable(row, name, self.column(name)) for name in self.names})
        if grid:
            if "repeat" in grid:
                found["repeat"] = row, found["run"].values % len(grid["repeat"])
            # Runs that are missing are filled with NaN.
            found = found.set_index({row: list(grid)}).unstack(row).reindex(grid).transpose(*grid, ...)
        else:
            found = found.set_coords([name for name in self.axes if name in found])
        for name, unit in self.units.items():
            found[name].attrs["units"] = unit
        found.attrs.update({name: self.about[name] for name in ("scene", "version") if name in self.about})
        return found

    def to_parquet(self, path: Any) -> None:
        """Write the rows to a Parquet file and the metadata to PATH.json.

        Raises:
            ValueError: The path does not end in .parquet.
        """
        check_ending("path", path)
        write(self, path)

    def replay(self, row: Mapping[str, Any] | int, scene: Any = None, device: Any = None) -> Any:
        """Build a Simulator of one row in its initial state, to simulate that run again.

        Events of a built-in scene, such as a thrown box, are not included. A table read from a file is data: a scene
        file that it names is neither opened nor run.

        Args:
            row: one of `rows`, or the number of its run in the column "run".
            scene: the scene as passed to `sweep`; required for a table read from a file, unless the scene is built in.
            device: as in Simulator; results are bitwise equal only on the same kind of device.

        Returns:
            The Simulator, with one environment.

        Raises:
            ValueError: The row is invalid, or the scene is missing or not that of the rows.
        """
        if not isinstance(row, Mapping):
            given: Any = row
            numbers = [one["run"] for one in self.rows]
            if isinstance(given, bool) or not isinstance(given, int | np.integer) or given not in numbers:
                raise ValueError(
                    f"row: must be one of the rows or the number of a run, {listed(numbers)}, got {shown(row)}"
                )
            row = self.rows[numbers.index(row)]
        source = self.source if scene is None else scene
        if source is None:
            named = shown(self.about.get("source"))
            raise ValueError(f"scene: must be given: a file named in a table is not run, and the table names {named}")
        demo, scene_id = resolve_scene(source)
        if scene_id != self.about.get("scene"):
            raise ValueError(f"scene: must be that of the rows, {self.about.get('scene')}, got {scene_id}")
        job = Job(demo, scene_id, metadata_field(self.about, "fixed"), demo.duration, 1.0, (), device=device)
        parameters = {name: row[name] for name in metadata_field(self.about, "parameters")}
        return prepare(job, [Run(0, row["id"], parameters, row["seed"])]).sim

    def plot(self, path: Any = None, x: str | None = None, y: str | None = None, kind: str | None = None) -> Any:
        """Plot the rows and return the matplotlib Figure, which a notebook shows as the value of a cell.

        Args:
            path: output file, .png, .svg or .pdf; None writes none.
            x: the axis on the x axis; None uses the one with most distinct values.
            y: the metric; None uses the first numeric one.
            kind: "line" (one line per value of the other axes), "heatmap" (over x and one other numeric axis, one panel
                per value of the remaining axes) or "scatter" (scatter matrix of all numeric axes and the metric). None
                chooses by the axes.

        Raises:
            ValueError: The column or kind is unknown, or there is nothing to plot.
            ModuleNotFoundError: matplotlib is not installed.
        """
        return plot(self, path, x, y, kind)


class ResultFile:
    """Result file of a sweep, written while it runs.

    Each write replaces the whole file atomically, so that a complete file exists at any time. The interval between
    writes is proportional to their duration.

    Args:
        path: the Parquet file; None keeps the rows in memory only.
        about: metadata of the table.
        resume: start with the finished rows of an existing file.
        overwrite: replace an existing file.
        source: the scene as passed to `sweep`.

    Raises:
        ValueError: The file exists and is neither resumed nor overwritten, or contains rows of a different sweep.
        OSError: The name of the file, or of the metadata file beside it, is too long, or the path is not a file.
    """

    def __init__(
        self, path: Any, about: dict[str, Any], resume: bool = False, overwrite: bool = False, source: Any = None
    ) -> None:
        """Check the path and load finished rows if resumed."""
        self.path = None if path is None else Path(path)
        self.about = about
        self.source = source
        self.series: Any = None
        self.trajectories: Any = None
        self.rows: dict[str, dict[str, Any]] = {}
        self._written = self._cost = 0.0
        self._changed = False
        if self.path is None:
            return
        # Fails before any run if pyarrow is missing, and excludes its slow import from the measured write time.
        SweepResult([{"run": 0}], {}).to_arrow()
        check_ending("output", self.path)
        check_replaceable(self.path)
        check_replaceable(sidecar_of(self.path))
        if self.path.exists() and resume:
            before = read(self.path)
            check_same_sweep(self.path, before.about, about)
            self.rows = {row["id"]: row for row in before.rows if row["status"] in FINISHED}
            about["units"] = before.about.get("units", {})
        elif self.path.exists() and not overwrite:
            raise ValueError(f"{self.path}: {EXISTS}")

    def missing(self, runs: Sequence[Run]) -> list[Run]:
        """The runs of a design that have no finished row.

        Raises:
            ValueError: A finished row belongs to none of the runs.
        """
        index = {run.id: run.index for run in runs}
        unknown = set(self.rows) - set(index)
        if unknown:
            raise ValueError(f"{self.path}: holds {len(unknown)} runs of a different design; choose another name")
        for row_id, row in self.rows.items():
            row["run"] = index[row_id]
        return [run for run in runs if run.id not in self.rows]

    def store(self, batch: Batch) -> None:
        """Store a batch; its rows come last, so that no row lacks its trajectory or series after an interruption."""
        for recorded, poses in batch.trajectories:
            self.trajectories.add(recorded, poses)
        for observed, looks in batch.series:
            self.series.add(observed, looks)
        self.about["units"] = {**self.about.get("units", {}), **batch.units}
        self.add(batch.rows)

    def add(self, rows: Iterable[dict[str, Any]]) -> None:
        """Add rows, and write the file if a write is due."""
        for row in rows:
            self.rows[row["id"]] = row
            self._changed = True
        if time.monotonic() - self._written >= WRITE_INTERVAL_RATIO * self._cost:
            self.write()

    def write(self, **about: Any) -> None:
        """Write the file now.

        Args:
            **about: metadata to update.
        """
        self._changed |= any(self.about.get(name) != value for name, value in about.items())
        self.about |= about
        if self.path is None or not self._changed:
            return
        start = time.monotonic()
        write(self.result(), self.path, sidecar=bool(about))
        self._changed = False
        self._written = time.monotonic()
        self._cost = self._written - start

    def result(self) -> SweepResult:
        """The rows so far."""
        return SweepResult(list(self.rows.values()), self.about, self.source, self.series)


def check_same_sweep(path: Any, before: dict[str, Any], now: dict[str, Any]) -> None:
    """Check that two tables come from the same sweep.

    Raises:
        ValueError: They differ; the message names the first difference.
    """
    for name in ("scene", "fixed", "duration", "fps", "metrics", "observe", "series", "version"):
        if before.get(name) != now.get(name):
            raise ValueError(
                f"{path}: holds a different sweep: {name} is {before.get(name)!r} there, {now.get(name)!r} here"
            )


def check_ending(name: str, path: Any) -> None:
    """Check that the name of a table ends in .parquet; `name` is that of the argument in the message."""
    if Path(path).suffix != ".parquet":
        raise ValueError(f"{name}: must end in .parquet, got {path}; for CSV use to_pandas().to_csv()")


def write(result: SweepResult, path: Any, sidecar: bool = True) -> None:
    """Write a table atomically and, if `sidecar`, its metadata to PATH.json."""
    import pyarrow.parquet

    path = Path(path)
    about = json.dumps(result.about, default=str)
    table = result.to_arrow().replace_schema_metadata({METADATA: about.encode()})
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        pyarrow.parquet.write_table(table, file, compression="zstd")
    if sidecar:
        with atomic_file(sidecar_of(path)) as temporary:
            temporary.write_text(json.dumps(result.about, default=str, indent=2) + "\n")


def sidecar_of(path: Path) -> Path:
    """The file beside a table that holds its metadata."""
    return path.with_name(path.name + ".json")


def read(path: Any) -> SweepResult:
    """Read a table written by a sweep.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It is not a table of a sweep.
    """
    import pyarrow

    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        import pyarrow.parquet

        # Repeated values compress to almost nothing, so a small file can hold too many rows.
        count = pyarrow.parquet.read_metadata(path).num_rows
        if count > MAX_RUNS:
            raise ValueError(f"must have at most {MAX_RUNS} rows, got {count}")
        table = pyarrow.parquet.read_table(path)
        about = json.loads(table.schema.metadata[METADATA])
        columns = {name: table.column(name).to_pylist() for name in table.column_names}
        rows = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
        _check(about, rows)
        for name in _axes(about) if rows else ():
            for row in rows:
                row[name] = plain(row[name])  # a vector is a list in the file
    except (pyarrow.ArrowException, ValueError, OSError, KeyError, TypeError, RecursionError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}: not a table of a sweep: {reason[:300]}") from None
    kept = bool(about.get("series")) and series_folder(path).is_dir()
    return SweepResult(rows, about, series=Series(path, resume=True) if kept else None)


def _check(about: Any, rows: list[dict[str, Any]]) -> None:
    """Check that metadata and rows are those of a sweep."""
    instance_of("metadata", about, dict, "a JSON object")
    for name in METADATA_TYPES.keys() & about.keys():
        metadata_field(about, name)
    for row in rows:
        for name, kind in REQUIRED_COLUMNS.items():
            if not isinstance(row.get(name), kind):
                raise ValueError(f"{name}: must be {kind.__name__} in every row, got {shown(row.get(name))}")
    missing = [name for name in _axes(about) if rows and name not in rows[0]]
    if missing:
        raise ValueError(f"{missing[0]}: is an axis without a column")


def _axes(about: dict[str, Any]) -> list[str]:
    """Columns of parameters and axes."""
    return [*about.get("parameters", ()), *about.get("axes", ())]


def merge(paths: Sequence[Any]) -> SweepResult:
    """Merge the tables of several shards. For a run that occurs twice, a finished row takes precedence.

    Raises:
        ValueError: No file is given, or the files hold different sweeps.
    """
    if not paths:
        raise ValueError("merge: requires at least one file")
    parts = [read(path) for path in paths]
    rows: dict[str, dict[str, Any]] = {}
    for path, part in zip(paths, parts, strict=True):
        check_same_sweep(path, part.about, parts[0].about)
        if metadata_field(part.about, "design_id") != parts[0].about["design_id"]:
            raise ValueError(f"{path}: holds a shard of a different design")
        for row in part.rows:
            if rows.get(row["id"], row)["status"] not in FINISHED or row["id"] not in rows:
                rows[row["id"]] = row
    for name in ("scene", "runs"):
        metadata_field(parts[0].about, name)
    units = {name: unit for part in parts for name, unit in part.about.get("units", {}).items()}
    about = {**parts[0].about, "shard": None, "merged": [str(path) for path in paths], "units": units}
    return SweepResult(list(rows.values()), about)


def _objects(values: list) -> np.ndarray:
    found = np.empty(len(values), object)
    found[:] = values
    return found


def _variable(row: str, name: str, values: np.ndarray) -> tuple:
    """A column: its dimensions and values. The components of vectors have a dimension of their own."""
    if values.dtype == object and len({np.shape(value) for value in values}) == 1 and np.shape(values[0]):
        values = np.array(values.tolist())
    inner = (f"{name}_component" if k == 1 else f"{name}_component_{k}" for k in range(1, values.ndim))
    return (row, *inner), values


def _grid(result: Any) -> dict[str, np.ndarray] | None:
    """The values of each axis of a grid of single values, and the repeats; None for other designs."""
    design = result.about.get("design") or {}
    values = design.get("axes") or {}
    if design.get("kind") != "grid" or not values or not all(map(_is_coordinate, values.values())):
        return None
    if any(row[name] not in axis for row in result.rows for name, axis in values.items()):
        return None  # values of different types, which a file keeps as text
    repeats = design.get("repeats") or 1
    return {name: np.array(axis) for name, axis in values.items()} | (
        {"repeat": np.arange(repeats)} if repeats > 1 else {}
    )


def _is_coordinate(axis: Any) -> bool:
    """Whether an axis is a list of different single values, and no distribution."""
    single = isinstance(axis, list) and not any(isinstance(value, list | tuple) for value in axis)
    return single and len(set(axis)) == len(axis)


def _arrow_column(name: str, values: list) -> Any:
    """Convert a column to an Arrow array; mixed types become strings, an empty column becomes floats."""
    import pyarrow

    try:
        column = pyarrow.array(values)
    except (pyarrow.ArrowInvalid, pyarrow.ArrowTypeError):
        column = pyarrow.array([None if value is None else str(value) for value in values])
    if not pyarrow.types.is_null(column.type):
        return column
    return column.cast(pyarrow.string() if name == "reason" else pyarrow.float64())
