"""Result tables as tables of pyarrow and as datasets of xarray, with units."""

from typing import Any

import numpy as np

from warp_rigid.extras import need


def arrow_table(result: Any) -> Any:
    """The rows of a SweepResult as a pyarrow.Table with units."""
    pyarrow = need("pyarrow")
    columns = {name: _arrow_column(name, [row.get(name) for row in result.rows]) for name in result.names}
    units = {name: {"unit": unit} for name, unit in result.units.items()}
    fields = [pyarrow.field(name, column.type, metadata=units.get(name)) for name, column in columns.items()]
    return pyarrow.table(list(columns.values()), schema=pyarrow.schema(fields))


def dataset(result: Any) -> Any:
    """The rows of a SweepResult as an xarray.Dataset with units."""
    xarray = need("xarray")
    grid = _grid(result) if result.rows else None
    row = "row" if grid else "run"
    found = xarray.Dataset({name: _variable(row, name, result.column(name)) for name in result.names})
    if grid:
        if "repeat" in grid:
            found["repeat"] = row, found["run"].values % len(grid["repeat"])
        # Runs that are missing are filled with NaN.
        found = found.set_index({row: list(grid)}).unstack(row).reindex(grid).transpose(*grid, ...)
    else:
        found = found.set_coords([name for name in result.axes if name in found])
    for name, unit in result.units.items():
        found[name].attrs["units"] = unit
    found.attrs.update({name: result.about[name] for name in ("scene", "version") if name in result.about})
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
