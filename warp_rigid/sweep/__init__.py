"""Parameter sweeps: simulate a scene over a range of parameters, tabulate metrics and plot them.

import numpy as np
import warp_rigid as wr

axes = {"offset": np.linspace(0.05, 0.2, 16), "shock_propagation": ["one_pass", "two_pass"]}
result = wr.sweep("leaning_tower", axes)
result.plot("tower.png", x="offset", y="top_height")
"""

from warp_rigid.sweep.axes import Choice, Distribution, Integers, LogUniform, Normal, Uniform
from warp_rigid.sweep.execution import sweep
from warp_rigid.sweep.search import search
from warp_rigid.sweep.series import read_series
from warp_rigid.sweep.table import SweepResult, merge, read

# `warp_rigid.sweep` is this function, not the package: the functions that read its tables are found on it.
sweep.__dict__.update(read=read, merge=merge, read_series=read_series)

__all__ = [
    "Choice",
    "Distribution",
    "Integers",
    "LogUniform",
    "Normal",
    "SweepResult",
    "Uniform",
    "merge",
    "read",
    "read_series",
    "search",
    "sweep",
]
