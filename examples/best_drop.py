"""Drop a bunny into a bowl 512 times, and export the drop after which it sits most upright."""

import argparse
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh

import warp_rigid as wr
from warp_rigid.scenes.builders import meshes

UP = np.array([0.592, 0.797, -0.118])
"""Up direction of the bunny in its mesh frame, which has the principal axes."""


@lru_cache
def bowl(radius: float = 0.3, thickness: float = 0.03, segments: int = 48) -> wr.Mesh:
    """Bottom of a thick spherical shell centred at the origin, up to 45 degrees below the horizon [m]."""
    arc = np.linspace(-0.5 * np.pi, -0.25 * np.pi, 9)
    section = [
        r * np.stack([np.cos(a), np.sin(a)], axis=1) for r, a in ((radius + thickness, arc), (radius, arc[::-1]))
    ]
    shell = trimesh.creation.revolve(np.concatenate(section), sections=segments)
    return wr.Mesh.from_trimesh(shell, sdf_resolution=64)


def drop(seed: int = 0) -> wr.Scene:
    """A bunny above a bowl, with a random orientation and position.

    Args:
        seed: seed of the orientation and the position.
    """
    rng = np.random.default_rng(seed)
    scene = wr.Scene()
    scene.add_static(wr.Plane(normal=(0, 0, 1), offset=0.0), name="table")
    scene.add_static(bowl(), position=(0, 0, 0.33), friction=0.5, name="bowl")
    x, y = rng.uniform(-0.05, 0.05, 2)
    scene.add_body(
        meshes.bunny(size=0.14),
        position=(x, y, 0.2),
        orientation=rng.normal(size=4),
        angular_velocity=rng.uniform(-3, 3, 3),
        friction=0.5,
        restitution=0.2,
        name="bunny",
    )
    return scene


def upright(sim):
    """Cosine between the up direction of the bunny and the world z axis, (envs,)."""
    x, y, z, w = np.moveaxis(sim.get("orientation")[:, -1].astype(float), -1, 0)
    to_world_z = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    return to_world_z @ UP / np.linalg.norm(UP)


def main(arguments=None):
    """Sweep the seeds, select the most upright bunny at rest, simulate it again and export it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=512, help="number of drops")
    parser.add_argument("--duration", type=float, default=3.0, help="simulated seconds")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the results")
    options = parser.parse_args(arguments)

    result = wr.sweep(
        drop,
        {},
        repeats=options.size,
        duration=options.duration,
        metrics=[upright, "settle_time", "kinetic_energy"],
        output=options.out / "drops.parquet",
        resume=True,
    )
    resting = [row for row in result.rows if row["settle_time"] is not None]
    best = max(resting or result.rows, key=lambda row: row["upright"])
    print(f"seed {best['seed']}: upright {best['upright']:.3f}; {len(resting)} of {len(result)} have come to rest")

    recording = wr.record(result.replay(best), frames=round(60 * options.duration), fps=60)
    wr.export_usd(recording, options.out / "best_drop.usdc")

    from warp_rigid.render.film import film_from_usd
    from warp_rigid.render.images import save_picture

    save_picture(film_from_usd(options.out / "best_drop.usdc"), options.out / "best_drop.png")
    return result, best


if __name__ == "__main__":
    main()
