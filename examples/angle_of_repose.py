"""Angle of repose as a function of friction: a column of cubes collapses, and the slope of the heap is measured."""

import argparse
from pathlib import Path

import numpy as np

import warp_rigid as wr

HALF = 0.05


def column(friction: float = 0.5, grains: int = 48, seed: int = 0) -> wr.Scene:
    """Randomly oriented cubes of 0.1 m in layers of four, offset between layers so that the cubes do not stack.

    Args:
        friction: friction of cubes and ground.
        grains: number of cubes.
        seed: seed of their orientations.
    """
    rng = np.random.default_rng(seed)
    scene = wr.Scene()
    scene.add_static(wr.Plane(normal=(0, 0, 1), offset=0.0), friction=friction, name="ground")
    pitch = 2.0 * np.sqrt(3.0) * HALF
    for i in range(grains):
        layer, place = divmod(i, 4)
        center = np.array([place % 2 + 0.5 * (layer % 2), place // 2 + 0.5 * (layer // 2 % 2), layer + 0.5])
        center[:2] += rng.uniform(-0.06, 0.06, 2)
        orientation = rng.normal(size=4)
        scene.add_body(
            wr.Box((HALF,) * 3), position=pitch * center, orientation=orientation, friction=friction, name=f"grain_{i}"
        )
    return scene


def slope(sim):
    """Slope of the heap [degree], (envs,): that of a cone with the same mean height and mean distance from the axis.

    In a cone of height h and radius r the mean height is h / 4 and the mean distance from the axis r / 2.
    """
    center = sim.get("center_of_mass")[:, 1:].astype(float)
    from_axis = center[..., :2] - center[..., :2].mean(axis=1, keepdims=True)
    distance = np.linalg.norm(from_axis, axis=-1).mean(axis=1)
    return np.degrees(np.arctan(2.0 * center[..., 2].mean(axis=1) / distance))


def main(arguments=None):
    """Sweep the friction with three heaps per value, and plot the slope against friction."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=10, help="number of friction values")
    parser.add_argument("--grains", type=int, default=48, help="cubes per heap")
    parser.add_argument("--duration", type=float, default=3.0, help="simulated seconds")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the results")
    options = parser.parse_args(arguments)

    result = wr.sweep(
        column,
        {"friction": np.linspace(0.0, 1.0, options.size)},
        fixed={"grains": options.grains},
        repeats=3,
        duration=options.duration,
        metrics=[slope, "deepest_overlap", "kinetic_energy"],
        output=options.out / "repose.parquet",
        resume=True,
    )
    result.plot(options.out / "repose.png", x="friction", y="slope")
    for row in result.rows:
        print(f"friction {row['friction']:.2f}, seed {row['seed']}: {row['slope']:.1f} degrees")
    return result


if __name__ == "__main__":
    main()
