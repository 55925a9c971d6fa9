"""Columns that every table of results has, and what is told beside the rows."""

from typing import Any

from warp_rigid.checks import shown

__all__ = ["BOOKKEEPING", "COLUMNS", "FINISHED", "NEEDED", "TOLD", "told"]

FINISHED = ("ok", "out of bounds")
"""What the status of a run that came to its end can be: one that bodies leave goes on."""

BOOKKEEPING = ("environment", "wall_time")
"""Columns that tell how a row came about; all others depend on its parameters alone."""

COLUMNS = ("run", "id", "seed", *BOOKKEEPING, "status", "reason", "most_pairs", "most_contacts", "trajectory")
"""Columns of every table beside the parameters and metrics."""

TOLD: dict[str, type] = {
    "scene": str, "fixed": dict, "duration": float, "fps": float, "metrics": list, "axes": list, "parameters": list,
    "version": str, "design_id": str, "runs": int,
}  # fmt: skip
"""What must be told beside the rows."""

NEEDED = {"run": int, "id": str, "seed": int, "status": str}
"""Columns without which nothing can be done with a row."""


def told(about: dict[str, Any], name: str) -> Any:
    """What is told beside the rows under a name of TOLD."""
    value, kind = about.get(name), TOLD[name]
    words = value if isinstance(value, list) else []
    if not (isinstance(value, kind) and all(isinstance(word, str) for word in words)):
        raise ValueError(f"{name}: must be told beside the rows as {kind.__name__}, got {shown(value)}")
    return value
