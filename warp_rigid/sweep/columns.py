"""Standard columns of result tables, the fields of their metadata, and units of columns."""

from typing import Any

from warp_rigid.checks import shown
from warp_rigid.kernels.declare import LAYOUTS
from warp_rigid.runs.assignments import BODY_PROPERTIES

FINISHED = ("ok", "out of bounds")
"""Statuses of a completed run. A run continues when bodies leave the bounds."""

BOOKKEEPING = ("environment", "wall_time")
"""Columns that depend on how a row was computed; all others depend only on its parameters."""

COLUMNS = ("run", "id", "seed", *BOOKKEEPING, "status", "reason", "most_pairs", "most_contacts", "trajectory")
"""Standard columns of every table, besides the parameters and metrics."""

METADATA_TYPES: dict[str, type] = {
    "scene": str, "fixed": dict, "duration": float, "fps": float, "metrics": list, "axes": list, "parameters": list,
    "version": str, "design_id": str, "runs": int, "units": dict,
}  # fmt: skip
"""Metadata fields and their types."""

REQUIRED_COLUMNS = {"run": int, "id": str, "seed": int, "status": str}
"""Required columns and their types."""

OF_BODIES = LAYOUTS["Bodies"] | LAYOUTS["State"]
"""Declarations of all quantities of bodies on the device."""

UNITS = {
    "dt": "s",
    "duration": "s",
    "time": "s",
    "wall_time": "s",
    **{name: field.unit for name, field in OF_BODIES.items() if name in BODY_PROPERTIES and field.unit},
    "final_position": "m",
    "gravity": "m/s^2",
    "field_acceleration": "m/s^2",
    "field_center": "m",
    "field_strength": "m^3/s^2",
    "field_drag": "1/s",
    "field_velocity": "m/s",
    "joint_break_force": "N",
    "joint_break_torque": "N m",
    "center_of_mass": "m",
    "top_height": "m",
    "deepest_overlap": "m",
    "drift": "m",
    "settle_time": "s",
    "kinetic_energy": "J",
    "potential_energy": "J",
    "energy": "J",
    "peak_impulse": "N s",
    "summed_impulse": "N s",
    "first_contact": "s",
    "rest_time": "s",
    "largest_overlap": "m",
}
"""Units of settings, properties, built-in metrics and observers that have one, and the same one in every scene."""


def metadata_field(about: dict[str, Any], name: str) -> Any:
    """Return a metadata field, checked against its type."""
    value, kind = about.get(name), METADATA_TYPES[name]
    words = value if isinstance(value, list) else []
    if not (isinstance(value, kind) and all(isinstance(word, str) for word in words)):
        raise ValueError(f"{name}: must be {kind.__name__} in the metadata, got {shown(value)}")
    return value


def unit_of(column: str) -> str | None:
    """Unit of a column, such as "mass[box_3]"; None if it has none, or is of the user's code."""
    return UNITS.get(column.split("[")[0])
