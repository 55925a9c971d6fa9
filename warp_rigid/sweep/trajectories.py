"""Trajectories of a sweep's runs, in a zarr folder.

Runs of one structure and time step share a group, which the column `trajectory` of a row names. It holds `time`
(frames,) [s], `position` (runs, frames, bodies, 3) [m] and `orientation` (runs, frames, bodies, 4), addressed by the
column `run`, in chunks of one run: one is read without the others, and runs that are not there take no room.
"""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.sweep.design import Run

__all__ = ["Trajectories"]

AXES = {"position": "xyz", "orientation": "xyzw"}


class Trajectories:
    """A folder of trajectories that grows while a sweep runs.

    Args:
        path: the folder, which ends in .zarr.
        runs: runs of the whole design.
        about: what they come from.
        resume: add to what is there.
        overwrite: replace what is there.

    Raises:
        ValueError: The name has another ending, or the folder exists and is neither resumed nor overwritten.
    """

    def __init__(self, path: Any, runs: int, about: dict[str, Any], resume: bool, overwrite: bool) -> None:
        """Look at what is there already."""
        import zarr

        self.path, self.runs = Path(path), runs
        if self.path.suffix != ".zarr":
            raise ValueError(f"trajectories: must end in .zarr, got {path}")
        if self.path.exists() and overwrite and not resume:
            shutil.rmtree(self.path)
        elif self.path.exists() and not resume:
            raise ValueError(f"{path}: exists already; resume it, overwrite it or choose another name")
        self.root = zarr.open_group(self.path, mode="a")
        self.root.attrs["warp_rigid"] = {name: about[name] for name in ("scene", "duration", "fps", "version")}

    def add(self, runs: list[Run], frames: dict[str, Any]) -> None:
        """Keep the trajectories of a batch.

        Args:
            runs: its runs.
            frames: "group", "time", "position" and "orientation" (runs, frames, bodies, ...).
        """
        group = self.root.require_group(frames["group"])
        if "time" not in group:
            group.create_array("time", data=frames["time"], dimension_names=["frame"])
        for name, last in AXES.items():
            values = frames[name]
            if name not in group:
                group.create_array(
                    name,
                    shape=(self.runs, *values.shape[1:]),
                    chunks=(1, *values.shape[1:]),
                    dtype=values.dtype,
                    fill_value=np.nan,
                    dimension_names=["run", "frame", "body", last],
                )
            array: Any = group[name]
            if array.shape[0] < self.runs:
                array.resize((self.runs, *array.shape[1:]))
            for run, rows in zip(runs, values, strict=True):
                array[run.index] = rows
