"""Run a program of this folder on a problem, and write its results: `python run.py PROGRAM PROBLEM RESULT`."""

import json
import sys
from importlib import import_module

import numpy as np
from problem import PeerProblem

NOT_INSTALLED = 3
"""Exit status if the engine is missing."""


def main(program: str, path: str, result: str) -> None:
    """Run `program.run(problem)`, which returns figures and final positions, orientations and linear velocities."""
    problem = PeerProblem(path)
    try:
        figures, *states = import_module(program).run(problem)
    except ModuleNotFoundError as error:
        print(f"{error.name} is not installed", file=sys.stderr)
        sys.exit(NOT_INSTALLED)
    named = dict(zip(("position", "orientation", "linear_velocity"), map(np.asarray, states), strict=True))
    np.savez(result, figures=json.dumps({"engine": problem.engine, **figures}), **named)


if __name__ == "__main__":
    main(*sys.argv[1:])
