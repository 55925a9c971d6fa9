"""Estimate the friction and restitution of a thrown ball from its final position."""

import argparse
from pathlib import Path

import numpy as np

import warp_rigid as wr

TRUE = {"friction": 0.22, "restitution": 0.55}


def throw(friction: float = 0.5, restitution: float = 0.5) -> wr.Scene:
    """A ball of 0.2 m, thrown at 5 m/s from a height of 0.6 m, which slides during its first bounce.

    Args:
        friction: friction of ball and ground.
        restitution: restitution of ball and ground.
    """
    scene = wr.Scene()
    surface = {"friction": friction, "restitution": restitution}
    scene.add_static(wr.Plane(normal=(0, 0, 1), offset=0.0), name="ground", **surface)
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 0.6), linear_velocity=(5, 0, 0), name="ball", **surface)
    return scene


def main(arguments=None):
    """Simulate a final position with known material, and search for the material that reproduces it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=256, help="number of trials")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the results")
    options = parser.parse_args(arguments)

    common = {"duration": 0.55, "metrics": ["final_pose"]}
    target = np.array(wr.sweep(throw, {}, fixed=TRUE, **common).rows[0]["final_position"][3:])

    def miss(row):
        return float(np.linalg.norm(np.array(row["final_position"][3:]) - target))

    axes = {"friction": wr.Uniform(0.0, 0.4), "restitution": wr.Uniform(0.0, 1.0)}
    study = wr.search(throw, axes, miss, trials=options.size, batch=32, **common)
    found = study.best_params
    for name, value in TRUE.items():
        print(f"{name}: {found[name]:.3f} found, {value:.3f} used")
    print(f"final position error {1e3 * study.best_value:.1f} mm after {len(study.trials)} throws")

    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 4), layout="constrained")
    axes = figure.subplots()
    tried = np.array([[trial.params["friction"], trial.params["restitution"]] for trial in study.trials])
    points = axes.scatter(*tried.T, c=np.arange(len(tried)), s=10)
    axes.plot(*TRUE.values(), "r+", markersize=14)
    axes.set(xlabel="friction", ylabel="restitution", title="trials of the search; + marks the true material")
    figure.colorbar(points, label="trial")
    options.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out / "fit.png")
    return study


if __name__ == "__main__":
    main()
