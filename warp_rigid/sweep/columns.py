"""Standard columns of result tables, and the fields of their metadata."""

from typing import Any

from warp_rigid.checks import shown

FINISHED = ("ok", "out of bounds")
"""Statuses of a completed run. A run continues when bodies leave the bounds."""

BOOKKEEPING = ("environment", "wall_time")
"""Columns that depend on how a row was computed; all others depend only on its parameters."""

COLUMNS = ("run", "id", "seed", *BOOKKEEPING, "status", "reason", "most_pairs", "most_contacts", "trajectory")
"""Standard columns of every table, besides the parameters and metrics."""

METADATA_TYPES: dict[str, type] = {
    "scene": str, "fixed": dict, "duration": float, "fps": float, "metrics": list, "axes": list, "parameters": list,
    "version": str, "design_id": str, "runs": int,
}  # fmt: skip
"""Metadata fields and their types."""

REQUIRED_COLUMNS = {"run": int, "id": str, "seed": int, "status": str}
"""Required columns and their types."""


def metadata_field(about: dict[str, Any], name: str) -> Any:
    """Return a metadata field, checked against its type."""
    value, kind = about.get(name), METADATA_TYPES[name]
    words = value if isinstance(value, list) else []
    if not (isinstance(value, kind) and all(isinstance(word, str) for word in words)):
        raise ValueError(f"{name}: must be {kind.__name__} in the metadata, got {shown(value)}")
    return value
