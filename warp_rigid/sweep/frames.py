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
    dims, coordinates, places = _grid(result) or _runs(result)
    variables = {}
    for name in result.names:
        if name not in coordinates:
            variables[name] = _variable(dims, coordinates, places, name, result.column(name))
    found = xarray.Dataset(variables, coordinates)
    for name, unit in result.units.items():
        found[name].attrs["units"] = unit
    found.attrs.update({name: result.about[name] for name in ("scene", "version") if name in result.about})
    return found


def _variable(dims: tuple[str, ...], coordinates: dict, places: tuple, name: str, values: np.ndarray) -> tuple:
    """A column on the dimensions: dimensions and values. The components of vectors have a dimension of their own."""
    if values.dtype == object and len({np.shape(value) for value in values}) == 1 and np.shape(values[0]):
        values = np.array(values.tolist())
    size = [len(coordinates[dim][1]) for dim in dims]
    if len(values) < np.prod(size):
        values = values.astype(float if values.dtype.kind in "iuf" else object)
    found = np.full((*size, *values.shape[1:]), {"f": np.nan, "O": None}.get(values.dtype.kind, 0), values.dtype)
    found[places] = values
    inner = tuple(f"{name}_component" if k == 1 else f"{name}_component_{k}" for k in range(1, values.ndim))
    return (*dims, *inner), found


def _runs(result: Any) -> tuple[tuple[str, ...], dict[str, Any], tuple]:
    """One dimension, the run, with the axes as coordinates."""
    rows = (np.arange(len(result.rows)),)
    coordinates: dict[str, Any] = {"run": ("run", result.column("run"))}
    for name in result.axes:
        coordinates[name] = _variable(("run",), coordinates, rows, name, result.column(name))
    return ("run",), coordinates, rows


def _grid(result: Any) -> tuple[tuple[str, ...], dict[str, Any], tuple] | None:
    """A dimension for each axis of a grid of single values, and the repeats; None for other designs."""
    design = result.about.get("design") or {}
    values = design.get("axes") or {}
    if design.get("kind") != "grid" or not values or not all(map(_is_coordinate, values.values())):
        return None
    if any(row[name] not in axis for row in result.rows for name, axis in values.items()):
        return None  # values of different types, which a file keeps as text
    dims = tuple(values)
    coordinates: dict[str, Any] = {name: (name, np.array(axis)) for name, axis in values.items()}
    places = [np.array([axis.index(row[name]) for row in result.rows], int) for name, axis in values.items()]
    repeats = design.get("repeats") or 1
    if repeats > 1:
        dims = (*dims, "repeat")
        coordinates["repeat"] = ("repeat", np.arange(repeats))
        places.append(np.array([row["run"] % repeats for row in result.rows], int))
    return dims, coordinates, tuple(places)


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
