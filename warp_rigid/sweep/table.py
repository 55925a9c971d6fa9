"""Tables of results: rows in memory, Parquet files that survive a kill, and what is told beside them."""

import json
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.checks import shown
from warp_rigid.files.atomic import whole_file
from warp_rigid.sweep.axes import plain
from warp_rigid.sweep.batch import replay
from warp_rigid.sweep.columns import BOOKKEEPING, COLUMNS, FINISHED, NEEDED, TOLD, told
from warp_rigid.sweep.design import MOST_RUNS
from warp_rigid.sweep.plots import plot

__all__ = ["BOOKKEEPING", "COLUMNS", "Book", "SweepResult", "merge", "read", "told", "write"]

REST = 10.0
"""The file is written anew no sooner than after so many times what the last writing took."""

METADATA = b"warp_rigid"


class SweepResult:
    """The rows of a sweep, in the order of its design.

    Attributes:
        rows: one dictionary a run: run, id, seed, parameters, environment, status, reason, high-water marks, metrics,
            wall_time [s].
        about: what the rows come from: scene, design, versions.
        source: the scene as it was given, None if only a file tells of it.
    """

    def __init__(self, rows: Sequence[dict[str, Any]], about: dict[str, Any], source: Any = None) -> None:
        """Sort the rows by their place in the design."""
        self.rows = sorted(rows, key=lambda row: row["run"])
        self.about = about
        self.source = about.get("source") if source is None else source

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.rows)

    def __repr__(self) -> str:
        """Tell the size."""
        return f"SweepResult({len(self)} runs of {self.about.get('scene')}, {len(self.failed)} failed)"

    @property
    def failed(self) -> list[dict[str, Any]]:
        """Rows of runs that did not come to their end."""
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
        """Names of the columns that were measured."""
        return [name for name in self.names if name not in COLUMNS and name not in self.about.get("parameters", ())]

    def column(self, name: str) -> np.ndarray:
        """Values of a column, one a row; NaN for a number that is missing.

        Raises:
            ValueError: There is no such column.
        """
        if name not in self.names:
            raise ValueError(f"column: must be one of {', '.join(self.names)}, got {name!r}")
        values = [row.get(name) for row in self.rows]
        if any(isinstance(value, tuple | list) for value in values):
            return _objects(values)
        if all(value is None or isinstance(value, float | int) for value in values) and None in values:
            return np.array([np.nan if value is None else value for value in values], float)
        return _objects(values) if None in values else np.array(values)

    def to_arrow(self) -> Any:
        """The rows as a pyarrow.Table."""
        import pyarrow

        columns = {name: [row.get(name) for row in self.rows] for name in self.names}
        return pyarrow.table({name: _arrow_column(name, values) for name, values in columns.items()})

    def to_pandas(self) -> Any:
        """The rows as a pandas.DataFrame."""
        return self.to_arrow().to_pandas()

    def to_parquet(self, path: Any) -> None:
        """Write the rows to a Parquet file, and beside it PATH.json, which tells where they come from."""
        write(self, path)

    def replay(self, row: dict[str, Any], scene: Any = None, device: Any = None) -> Any:
        """A Simulator of one row, at its start: it does again what the row did, to record it or to look at it.

        Events of a built-in scene, such as a box that flies in, are not part of it.

        Args:
            row: one of `rows`.
            scene: the scene as it was given to `sweep`; only needed for a table that was read from a file and whose
                scene has neither a name nor a file.
            device: as in Simulator; only the same kind of device gives the same bits.
        """
        return replay(self, row, scene, device)

    def plot(self, path: Any, x: str | None = None, y: str | None = None, kind: str | None = None) -> Any:
        """Draw the rows, and return the matplotlib Figure; see warp_rigid.sweep.plots.plot."""
        return plot(self, path, x=x, y=y, kind=kind)


class Book:
    """A result file that grows while a sweep runs.

    The whole file is written anew beside the old one and then takes its place, so that at any moment there is a
    complete, readable one. Writing rests in proportion to what it costs.

    Args:
        path: the Parquet file; None keeps the rows in memory only.
        about: what the rows come from.
        resume: begin with the finished rows of an existing file.
        overwrite: replace an existing file.
        source: the scene as it was given.

    Raises:
        ValueError: The file exists and is neither resumed nor overwritten, or it holds rows of another sweep.
    """

    def __init__(
        self, path: Any, about: dict[str, Any], resume: bool = False, overwrite: bool = False, source: Any = None
    ) -> None:
        """Look at what is there already."""
        self.path = None if path is None else Path(path)
        self.about = about
        self.source = source
        self.rows: dict[str, dict[str, Any]] = {}
        self._written = self._cost = 0.0
        self._changed = False
        if self.path is None:
            return
        # Fails here, before anything runs, where pyarrow is missing; and its slow start shall not count as writing.
        SweepResult([{"run": 0}], {}).to_arrow()
        if self.path.suffix != ".parquet":
            raise ValueError(f"output: must end in .parquet, got {self.path}")
        if self.path.exists() and resume:
            self._take_up()
        elif self.path.exists() and not overwrite:
            raise ValueError(f"{self.path}: exists already; resume it, overwrite it or choose another name")

    def keep(self, ids: Iterable[str]) -> None:
        """Refuse rows that the design does not ask for.

        Args:
            ids: addresses of all runs of the design.
        """
        strange = set(self.rows) - set(ids)
        if strange:
            raise ValueError(f"{self.path}: holds {len(strange)} runs that are not of this design; choose another name")

    def add(self, rows: Iterable[dict[str, Any]]) -> None:
        """Take in rows, and write the file if it is time."""
        for row in rows:
            self.rows[row["id"]] = row
            self._changed = True
        if time.monotonic() - self._written >= REST * self._cost:
            self.write()

    def write(self, **about: Any) -> None:
        """Write the file now.

        Args:
            **about: what else to tell beside the rows.
        """
        self._changed |= any(self.about.get(name) != value for name, value in about.items())
        self.about |= about
        if self.path is None or not self._changed:
            return
        start = time.monotonic()
        write(self.result(), self.path, tell=bool(about))
        self._changed = False
        self._written = time.monotonic()
        self._cost = self._written - start

    def result(self) -> SweepResult:
        """The rows so far."""
        return SweepResult(list(self.rows.values()), self.about, self.source)

    def _take_up(self) -> None:
        """Begin with the finished rows of the file."""
        before = read(self.path)
        check_same_sweep(self.path, before.about, self.about)
        self.rows = {row["id"]: row for row in before.rows if row["status"] in FINISHED}


def check_same_sweep(path: Any, before: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuse to put rows together that were made in different ways.

    Raises:
        ValueError: They were; the message names the first difference.
    """
    for name in ("scene", "fixed", "duration", "fps", "metrics", "version"):
        if before.get(name) != now.get(name):
            raise ValueError(
                f"{path}: holds another sweep: {name} is {before.get(name)!r} there, {now.get(name)!r} here"
            )


def write(result: SweepResult, path: Any, tell: bool = True) -> None:
    """Write a table and, if `tell`, the file beside it; an existing file is replaced in one moment."""
    import pyarrow.parquet

    path = Path(path)
    about = json.dumps(result.about, default=str)
    table = result.to_arrow().replace_schema_metadata({METADATA: about.encode()})
    with whole_file(path) as beside, beside.open("wb") as file:
        pyarrow.parquet.write_table(table, file, compression="zstd")
    if tell:
        with whole_file(path.with_name(path.name + ".json")) as beside:
            beside.write_text(json.dumps(result.about, default=str, indent=2) + "\n")


def read(path: Any) -> SweepResult:
    """Read a table that a sweep wrote.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no table of a sweep.
    """
    import pyarrow

    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        import pyarrow.parquet

        # Equal values take next to no room in a file, however many they are.
        count = pyarrow.parquet.read_metadata(path).num_rows
        if count > MOST_RUNS:
            raise ValueError(f"at most {MOST_RUNS} rows can be read, not {count}")
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
        raise ValueError(f"{path}: holds no rows of a sweep ({reason[:300]})") from None
    return SweepResult(rows, about)


def _check(about: Any, rows: list[dict[str, Any]]) -> None:
    """Refuse what is no table of a sweep, though it has rows and something is told beside them."""
    if not isinstance(about, dict):
        raise ValueError(f"what is told beside the rows must be named, got {shown(about)}")
    for name in TOLD.keys() & about.keys():
        told(about, name)
    for row in rows:
        for name, kind in NEEDED.items():
            if not isinstance(row.get(name), kind):
                raise ValueError(f"{name}: must be {kind.__name__} in every row, got {shown(row.get(name))}")
    missing = [name for name in _axes(about) if rows and name not in rows[0]]
    if missing:
        raise ValueError(f"{missing[0]}: is an axis, but no column")


def _axes(about: dict[str, Any]) -> list[str]:
    """Columns that a design has chosen."""
    return [*about.get("parameters", ()), *about.get("axes", ())]


def merge(paths: Sequence[Any]) -> SweepResult:
    """Put the tables of several shards together; of a run that occurs twice, a finished row comes first.

    Raises:
        ValueError: No file is given, or they hold different sweeps.
    """
    if not paths:
        raise ValueError("merge: needs at least one file")
    parts = [read(path) for path in paths]
    rows: dict[str, dict[str, Any]] = {}
    for path, part in zip(paths, parts, strict=True):
        check_same_sweep(path, part.about, parts[0].about)
        if told(part.about, "design_id") != parts[0].about["design_id"]:
            raise ValueError(f"{path}: holds a shard of another design")
        for row in part.rows:
            if rows.get(row["id"], row)["status"] not in FINISHED or row["id"] not in rows:
                rows[row["id"]] = row
    for name in ("scene", "runs"):
        told(parts[0].about, name)
    about = {**parts[0].about, "shard": None, "merged": [str(path) for path in paths]}
    return SweepResult(list(rows.values()), about)


def _arrow_column(name: str, values: list) -> Any:
    """An Arrow array; a column of unlike values becomes text, one without any values numbers."""
    import pyarrow

    try:
        column = pyarrow.array(values)
    except (pyarrow.ArrowInvalid, pyarrow.ArrowTypeError):
        column = pyarrow.array([None if value is None else str(value) for value in values])
    if not pyarrow.types.is_null(column.type):
        return column
    return column.cast(pyarrow.string() if name == "reason" else pyarrow.float64())


def _objects(values: list) -> np.ndarray:
    found = np.empty(len(values), object)
    found[:] = values
    return found
