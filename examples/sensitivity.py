"""Sensitivity of a stopping distance to five parameters, by twins that differ in one parameter, and its closed form.

A box slides on level ground and stops after v^2 / (2 mu g): the elasticity d(ln distance) / d(ln parameter) is 2 for
the speed, -1 for friction and gravity, and 0 for mass and size.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.stats import qmc

import warp_rigid as wr

RANGES = {"speed": (1.0, 3.0), "friction": (0.25, 0.6), "g": (5.0, 15.0), "mass": (0.5, 50.0), "half": (0.05, 0.2)}
CLOSED_FORM = {"speed": 2.0, "friction": -1.0, "g": -1.0, "mass": 0.0, "half": 0.0}
CHANGE = 0.02
"""Half of the relative difference between twins."""


def slide(speed: float = 2.0, friction: float = 0.4, g: float = 9.81, mass: float = 1.0, half: float = 0.1) -> wr.Scene:
    """A cube that slides on level ground.

    Args:
        speed: at the start [m/s].
        friction: of cube and ground.
        g: gravity [m/s^2].
        mass: of the cube [kg].
        half: half of its width [m].
    """
    scene = wr.Scene(gravity=(0, 0, -g))
    scene.add_static(wr.Plane(), friction=friction, name="ground")
    velocity = (speed, 0, 0)
    scene.add_body(
        wr.Box((half,) * 3), position=(0, 0, half), linear_velocity=velocity, mass=mass, friction=friction, name="cube"
    )
    return scene


def distance(sim):
    """Distance that the cube slid, (envs,) [m]."""
    return sim.get("position")[:, 1, 0]


def main(arguments=None):
    """Simulate twins around random points in one batch, and plot the elasticities."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=16, help="number of points")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the results")
    options = parser.parse_args(arguments)

    points = qmc.scale(
        qmc.LatinHypercube(len(RANGES), seed=0).random(options.size), *zip(*RANGES.values(), strict=True)
    )
    # (points, changed parameter, twin, parameter)
    twins = np.tile(points[:, None, None], (1, len(RANGES), 2, 1))
    for i in range(len(RANGES)):
        twins[:, i, :, i] *= (1.0 - CHANGE, 1.0 + CHANGE)
    axes = dict(zip(RANGES, twins.reshape(-1, len(RANGES)).T, strict=True))
    result = wr.sweep(slide, axes, design="zip", duration=2.5, fps=1, metrics=[distance])
    low, high = np.log(result.column("distance")).reshape(options.size, len(RANGES), 2).transpose(2, 0, 1)
    elasticity = (high - low) / np.log((1.0 + CHANGE) / (1.0 - CHANGE))

    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 3), layout="constrained")
    panel = figure.subplots()
    for i, (name, exact) in enumerate(CLOSED_FORM.items()):
        panel.plot(np.linspace(i - 0.2, i + 0.2, options.size), elasticity[:, i], ".")
        panel.plot((i - 0.35, i + 0.35), (exact, exact), "r--", linewidth=1)
        error = np.abs(elasticity[:, i] - exact).max()
        print(f"{name}: elasticity {elasticity[:, i].mean():.3f}, closed form {exact:g}, largest error {error:.3f}")
    panel.set_xticks(range(len(RANGES)), RANGES)
    panel.set(ylabel="d ln(distance) / d ln(parameter)")
    options.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out / "sensitivity.png")
    return elasticity


if __name__ == "__main__":
    main()
