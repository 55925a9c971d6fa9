"""Parameters of force fields by name, such as "field_strength": read and changed for each environment."""

from typing import Any

import numpy as np

from warp_rigid.checks import shown
from warp_rigid.engine.layout import LACKING, Layout, spread_rows
from warp_rigid.scene.fields import FIELDS, ForceField

PREFIX = "field_"


VALUE_SHAPES = {
    PREFIX + name: (3,) if is_vector else ()
    for kind in FIELDS.values()
    for name, is_vector in kind.parameters().items()
}
"""Shape of the parameters of all kinds of force fields by name: that of a vector or of a number."""


def read(layout: Layout, parameters: np.ndarray, name: str) -> np.ndarray:
    """A parameter of all force fields, (envs, most fields, ...); NaN where a field does not have it.

    Args:
        layout: the environments.
        parameters: (fields, columns) parameters of all fields as on the device.
        name: one of VALUE_SHAPES.

    Raises:
        ValueError: no force field of the scenes has the parameter.
    """
    values = np.full((len(parameters), *VALUE_SHAPES[name]), np.nan, np.float32)
    fields, source = _entries(layout)
    for index, columns in _columns(fields, name).items():
        own = source == index
        values[own] = parameters[own, columns].reshape(-1, *VALUE_SHAPES[name])
    return spread_rows(values, layout.table("fields"))


def write(layout: Layout, parameters: np.ndarray, name: str, new: np.ndarray, rows: np.ndarray) -> None:
    """Change a parameter of fields, after a check of every value.

    Args:
        layout: the environments.
        parameters: (fields, columns) as for `read`; changed in place.
        name: one of VALUE_SHAPES.
        new: (n, most fields, ...) values.
        rows: (n, most fields) rows of the fields.

    Raises:
        ValueError: a value is out of range.
    """
    fields, source = _entries(layout)
    changes = []
    for index, columns in _columns(fields, name).items():
        chosen = (rows != LACKING) & (source[np.maximum(rows, 0)] == index)
        values = new[chosen].reshape(-1, columns.stop - columns.start)
        for value in np.unique(values, axis=0):
            check(fields[index], name, value)
        changes.append((rows[chosen], columns, values))
    for own, columns, values in changes:
        parameters[own, columns] = values


def having(layout: Layout, name: str) -> np.ndarray:
    """Mask of the fields that have a parameter, (envs, most fields)."""
    table, (fields, source) = layout.table("fields"), _entries(layout)
    return (table != LACKING) & np.isin(source[np.maximum(table, 0)], list(_columns(fields, name)))


def check(field: ForceField, name: str, value: Any) -> None:
    """Check a value of a parameter as the class of the field does.

    Raises:
        ValueError: the value is out of range.
    """
    parameter = name.removeprefix(PREFIX)
    values = np.asarray(value, np.float64).reshape(-1).tolist()
    is_vector = type(field).parameters()[parameter]
    if len(values) != (3 if is_vector else 1):
        raise ValueError(f"{name}: must be {'three numbers' if is_vector else 'a number'}, got {shown(value)}")
    try:
        type(field)(**{**field.values(), parameter: tuple(values) if is_vector else values[0]})
    except ValueError as error:
        raise ValueError(f"{PREFIX}{error}") from None


def fields_with(fields: list[ForceField], name: str) -> list[ForceField]:
    """The fields that have a parameter.

    Raises:
        ValueError: there is none.
    """
    parameter = name.removeprefix(PREFIX)
    found = [field for field in fields if parameter in type(field).parameters()]
    if not found:
        raise ValueError(f"{name}: no force field of the scene has a {parameter}")
    return found


def potential(layout: Layout, parameters: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Potential energy per mass by all force fields [J/kg].

    Args:
        layout: the environments.
        parameters: (fields, columns) as for `read`.
        x: (envs, bodies, 3) points [m].

    Returns:
        (envs, bodies) potential.
    """
    total = np.zeros(x.shape[:2])
    env_of_field = np.repeat(np.arange(layout.num_envs), np.diff(layout.starts["fields"]))
    fields, source = _entries(layout)
    for index, field in enumerate(fields):
        rows = np.flatnonzero(source == index)
        width = len(field.row())
        for values in np.unique(parameters[rows, :width], axis=0):
            own = rows[(parameters[rows, :width] == values).all(axis=1)]
            envs = env_of_field[own]
            now = field if np.array_equal(values, field.row()) else type(field).from_row(values)
            total[envs] += now.potential(x[envs])
    return total


def _entries(layout: Layout) -> tuple[list[ForceField], np.ndarray]:
    """The fields of the distinct scenes, and the index of each field of all environments."""
    return layout.entries(lambda scene: scene.force_fields)


def _columns(fields: list[ForceField], name: str) -> dict[int, slice]:
    """For each of some fields that has a parameter, the columns of it."""
    fields_with(fields, name)
    columns = [type(field).columns().get(name.removeprefix(PREFIX)) for field in fields]
    return {index: own for index, own in enumerate(columns) if own is not None}
