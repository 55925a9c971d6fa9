"""Friction estimated from motion by a network that was trained on a randomised batch of mixed scenes (PyTorch).

Solids slide, roll or tip over on level ground, with another friction in each environment. A network sees their
positions at eight times, with a noise of 1 mm. It is trained once on cubes of one size, and once on a batch that mixes
solids, sizes, masses and numbers of bodies. Both are tested on solids of sizes that neither has seen.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
import warp as wp

import warp_rigid as wr

FRICTION = (0.1, 0.8)
NOISE = 1e-3
"""Standard deviation of the observed positions [m]."""

LOOKS, STEPS = 8, 12
"""Number of observations, and steps between them."""


def solids(size: float) -> dict[str, list[tuple[wr.Shape, float]]]:
    """Bodies of each scene, with the heights of their centres [m]."""
    flat = wr.Box((size, size, 0.5 * size))
    return {
        "cube": [(wr.Box((size,) * 3), size)],
        "puck": [(wr.Cylinder(size, 0.6 * size), 0.6 * size)],
        "two boxes": [(flat, 0.5 * size), (flat, 1.5 * size)],
        "upright box": [(wr.Box((0.5 * size, size, size)), size)],
        "ball": [(wr.Sphere(size), size)],
    }


def scene_of(bodies: list[tuple[wr.Shape, float]]) -> wr.Scene:
    """Bodies in a column on level ground, which move sideways together."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), friction=1.0)
    for shape, height in bodies:
        scene.add_body(shape, position=(0, 0, height), linear_velocity=(1.5, 0, 0), mass=1.0)
    return scene


def observed(scenes: list[wr.Scene], num_envs: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Simulate environments of random friction, mass and speed.

    Returns:
        The displacements of the dynamic bodies at the looks, (envs, bodies, 3 LOOKS), NaN for bodies that an
        environment lacks, and the friction (envs,).
    """
    sim = wr.Simulator(scenes, num_envs=num_envs)
    rng = np.random.default_rng(seed)
    friction, speed = rng.uniform(*FRICTION, (sim.num_envs, 1)), rng.uniform(1.0, 2.0, (sim.num_envs, 1, 1))
    sim.set("friction", friction)
    sim.set("linear_velocity", sim.get("linear_velocity") * speed / 1.5)
    sim.set("mass", rng.uniform(0.5, 5.0, (sim.num_envs, 1)), bodies=[1])

    position = wp.to_torch(sim.array("position"))  # the memory of the simulator: it changes with every step
    exists = torch.from_numpy(sim.exists).to(position.device)
    padded = torch.full((*exists.shape, 3), torch.nan, device=position.device)
    torch.manual_seed(seed)
    looks = []
    for _ in range(LOOKS + 1):
        padded[exists] = position + NOISE * torch.randn_like(position)
        looks.append(padded[:, 1:].clone())
        sim.step(STEPS)
    moved = torch.cat([look - looks[0] for look in looks[1:]], dim=-1)
    return moved, torch.tensor(friction[:, 0], dtype=torch.float32, device=position.device)


class Estimator(torch.nn.Module):
    """A network for each body, the mean over the bodies of an environment, and a network for the mean."""

    def __init__(self, width: int = 64):
        """Make the layers."""
        super().__init__()
        self.body = torch.nn.Sequential(
            torch.nn.Linear(3 * LOOKS, width), torch.nn.ReLU(), torch.nn.Linear(width, width), torch.nn.ReLU()
        )
        self.head = torch.nn.Sequential(torch.nn.Linear(width, width), torch.nn.ReLU(), torch.nn.Linear(width, 1))

    def forward(self, moved: torch.Tensor) -> torch.Tensor:
        """Friction of each environment, (envs,)."""
        present = ~torch.isnan(moved[..., :1])
        found = torch.where(present, self.body(torch.nan_to_num(moved)), 0.0)
        return self.head(found.sum(dim=1) / present.sum(dim=1))[:, 0]


def trained(moved: torch.Tensor, friction: torch.Tensor, rounds: int) -> Estimator:
    """An estimator with the least squared error on a batch."""
    torch.manual_seed(0)
    estimator = Estimator().to(moved.device)
    optimizer = torch.optim.Adam(estimator.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, rounds)
    for _ in range(rounds):
        optimizer.zero_grad()
        torch.nn.functional.mse_loss(estimator(moved), friction).backward()
        optimizer.step()
        schedule.step()
    return estimator.eval()


def main(arguments=None):
    """Train both networks, test them on the same environments, and plot their errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--envs", type=int, default=150, help="training environments of each mixed scene")
    parser.add_argument("--rounds", type=int, default=1500, help="rounds of training")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the results")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)  # the layers are too small to be shared by threads

    names = list(solids(1.0))
    mixed = [scene_of(bodies) for size in (0.08, 0.1, 0.14) for bodies in solids(size).values()]
    cubes = [scene_of(solids(0.1)["cube"])]
    unseen = [scene_of(bodies) for size in (0.09, 0.12) for bodies in solids(size).values()]
    tested, friction = observed(unseen, 20, seed=2)
    batches = {
        "cubes of one size": observed(cubes, options.envs * len(mixed), seed=1),
        "mixed scenes": observed(mixed, options.envs, seed=1),
    }

    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3), layout="constrained")
    panel = figure.subplots()
    errors = {}
    for k, (name, batch) in enumerate(batches.items()):
        error = (trained(*batch, options.rounds)(tested).detach() - friction).abs().cpu().numpy()
        # Environment e has scene e modulo the number of scenes, and these have the solids in turn.
        errors[name] = dict(zip(names, error.reshape(-1, len(names)).mean(axis=0).tolist(), strict=True))
        print(f"trained on {name}: " + ", ".join(f"{solid} {mean:.3f}" for solid, mean in errors[name].items()))
        panel.bar(np.arange(len(names)) + 0.4 * (k - 0.5), errors[name].values(), 0.38, label=f"trained on {name}")
    panel.set_xticks(range(len(names)), names)
    panel.set(ylabel="mean error of the friction")
    panel.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out / "friction_from_motion.png")
    return errors


if __name__ == "__main__":
    main()
