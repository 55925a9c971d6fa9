"""Angle of repose as a function of friction, or of shape: a column collapses, and the slope of the heap is measured."""

import argparse
from pathlib import Path

import numpy as np

import warp_rigid as wr

HALF = 0.05

SHAPES = {
    "cube": wr.Box((HALF,) * 3),
    "plate": wr.Box((1.4 * HALF, 1.4 * HALF, 0.5 * HALF)),
    "rod": wr.Capsule(0.6 * HALF, 0.9 * HALF),
    "drum": wr.Cylinder(HALF, HALF),
    "ball": wr.Sphere(1.2 * HALF),
}
"""Solids of about the same size."""


def column(friction: float = 0.5, grains: int = 48, shape: str = "cube", seed: int = 0) -> wr.Scene:
    """Randomly oriented solids in layers of four, offset between layers so that they do not stack.

    Args:
        friction: friction of solids and ground.
        grains: number of solids.
        shape: one of SHAPES.
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
        solid = SHAPES[shape]
        scene.add_body(solid, position=pitch * center, orientation=orientation, friction=friction, name=f"grain_{i}")
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
    """Sweep the friction, or the shape, with three heaps per value, and plot the slope against it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=10, help="number of friction values")
    parser.add_argument("--grains", type=int, default=48, help="solids per heap")
    parser.add_argument("--shapes", action="store_true", help="vary the shape instead of the friction")
    parser.add_argument("--duration", type=float, default=3.0, help="simulated seconds")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the results")
    options = parser.parse_args(arguments)

    name = "repose_shapes" if options.shapes else "repose"
    result = wr.sweep(
        column,
        {"shape": list(SHAPES)} if options.shapes else {"friction": np.linspace(0.0, 1.0, options.size)},
        fixed={"grains": options.grains},
        repeats=3,
        duration=options.duration,
        metrics=[slope, "deepest_overlap", "kinetic_energy"],
        output=options.out / f"{name}.parquet",
        resume=True,
    )
    (axis,) = result.axes
    result.plot(options.out / f"{name}.png", x=axis, y="slope")
    for row in result.rows:
        print(f"{axis} {row[axis]}, seed {row['seed']}: {row['slope']:.1f} degrees")
    return result


if __name__ == "__main__":
    main()
