"""Trajectories of the runs of a sweep, in a zarr folder.

Runs with the same structure and time step share a group, named by the column `trajectory` of a row. It holds `time`
(frames,) [s], `position` (runs, frames, bodies, 3) [m] and `orientation` (runs, frames, bodies, 4), indexed by the
column `run`. Each chunk holds one run, so that runs can be read separately and missing runs use no disk space.
"""

from pathlib import Path
from typing import Any

from warp_rigid.sweep.design import Run
from warp_rigid.sweep.series import array_of_runs, open_zarr

AXES = {"position": "xyz", "orientation": "xyzw"}


class Trajectories:
    """Folder of the trajectories of a sweep, written while it runs.

    Args:
        path: the folder; must end in .zarr.
        runs: number of runs of the whole design.
        about: metadata of the sweep.
        resume: add to an existing folder.
        overwrite: replace an existing folder.

    Raises:
        ValueError: The path has another suffix, or exists and is neither resumed nor overwritten.
    """

    def __init__(self, path: Any, runs: int, about: dict[str, Any], resume: bool, overwrite: bool) -> None:
        """Open or create the folder."""
        self.path, self.runs = Path(path), runs
        self.root = open_zarr("trajectories", self.path, resume, overwrite)
        self.root.attrs["warp_rigid"] = {name: about[name] for name in ("scene", "duration", "fps", "version")}

    def add(self, runs: list[Run], frames: dict[str, Any]) -> None:
        """Store the trajectories of a batch.

        Args:
            runs: the runs of the batch.
            frames: "group", "time", "position" and "orientation" (runs, frames, bodies, ...).
        """
        group = self.root.require_group(frames["group"])
        if "time" not in group:
            group.create_array("time", data=frames["time"], dimension_names=["frame"])
        for name, last in AXES.items():
            values = frames[name]
            shape, dimensions = (self.runs, *values.shape[1:]), ["run", "frame", "body", last]
            array = array_of_runs(group, name, shape, 1, values.dtype, dimensions)
            for run, rows in zip(runs, values, strict=True):
                array[run.index] = rows
