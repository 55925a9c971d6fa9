"""Friction and restitution from the recorded motion of a pile, by finite differences of twins and by Optuna.

The simulation is deterministic, so two environments that differ only in a parameter differ only because of it. The
differences give the derivative of all recorded positions, and Gauss-Newton steps follow it.
"""

import argparse
from pathlib import Path

import numpy as np

import warp_rigid as wr

TRUE = {"friction": 0.3, "restitution": 0.4}
LOW, HIGH = np.array([0.05, 0.05]), np.array([0.8, 0.8])
CHANGE = 0.005
"""Half of the difference between twins."""
NOISE = 1e-3
"""Standard deviation of the recorded positions [m]."""
BODIES = 5
SAMPLING = {"duration": 0.5, "fps": 20, "metrics": ["drift"]}


def pile(friction: float = 0.5, restitution: float = 0.5) -> wr.Scene:
    """Balls that are thrown onto each other.

    Args:
        friction: of balls and ground.
        restitution: of balls and ground.
    """
    scene = wr.Scene()
    surface = {"friction": friction, "restitution": restitution}
    scene.add_static(wr.Plane(), name="ground", **surface)
    for i in range(BODIES):
        place = (0.12 * (i % 2), 0.05 * i, 0.15 + 0.16 * i)
        velocity = (4.0 - 2.0 * i, 1.0, 0)
        scene.add_body(wr.Sphere(0.1), position=place, linear_velocity=velocity, mass=1.0, name=f"ball_{i}", **surface)
    return scene


def positions(sim):
    """Positions of all balls, (envs, 3 balls) [m]."""
    return sim.get("position")[:, 1:].reshape(sim.num_envs, -1)


def motion(values):
    """Simulate the pile for parameters (runs, 2) in one batch; all sampled positions (runs, numbers) [m]."""
    axes = dict(zip(TRUE, values.T.tolist(), strict=True))
    result = wr.sweep(pile, axes, design="zip", observe=[positions], series=["positions"], **SAMPLING)
    return np.stack(result.series()["positions"].to_numpy(zero_copy_only=False)).reshape(len(values), -1)


def fit(recorded, starts, rounds):
    """Gauss-Newton steps from several starts at once, with the damping of Levenberg and Marquardt.

    Args:
        recorded: positions (numbers,) [m].
        starts: parameters (starts, 2).
        rounds: number of batches; each simulates every start and its four twins.

    Returns:
        For each round the parameters (starts, 2) and their root-mean-square error (starts,) [m].
    """
    steps = np.array([[0, 0], [-CHANGE, 0], [CHANGE, 0], [0, -CHANGE], [0, CHANGE]])
    best, least = np.array(starts), np.full(len(starts), np.inf)
    slope, rest = np.zeros((len(starts), recorded.size, 2)), np.zeros((len(starts), recorded.size))
    tried, damping, history = best.copy(), np.full(len(starts), 1e-3), []
    for _ in range(rounds):
        moved = motion((tried[:, None] + steps).reshape(-1, 2)).reshape(len(starts), len(steps), -1)
        error = np.sqrt(((moved[:, 0] - recorded) ** 2).mean(axis=1))
        for k in range(len(starts)):
            better = error[k] < least[k]
            damping[k] *= 0.2 if better else 10.0
            if better:
                best[k], least[k], rest[k] = tried[k], error[k], recorded - moved[k, 0]
                slope[k] = ((moved[k, [2, 4]] - moved[k, [1, 3]]) / (2.0 * CHANGE)).T
            square = slope[k].T @ slope[k]
            step = np.linalg.solve(square + damping[k] * np.diag(np.diag(square) + 1e-9), slope[k].T @ rest[k])
            tried[k] = np.clip(best[k] + step, LOW, HIGH)
        history.append((best.copy(), least.copy()))
    return history


def main(arguments=None):
    """Record a pile of known material with noise, and find the material by both methods with equally many runs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=6, help="number of starts of the finite differences")
    parser.add_argument("--rounds", type=int, default=8, help="number of batches")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the results")
    options = parser.parse_args(arguments)

    rng = np.random.default_rng(0)
    (exact,) = motion(np.array([list(TRUE.values())]))
    recorded = exact + rng.normal(scale=NOISE, size=exact.shape)
    samples = recorded.reshape(-1, 3 * BODIES)

    class Error:
        """Root-mean-square error of the positions so far."""

        def __init__(self, sim):
            self.squares = []

        def __call__(self, sim):
            self.squares.append(((positions(sim) - samples[len(self.squares)]) ** 2).mean(axis=1))
            return np.sqrt(np.mean(self.squares, axis=0))

    history = fit(recorded, rng.uniform(LOW, HIGH, (options.starts, 2)), options.rounds)
    batch = 5 * options.starts
    axes = {name: wr.Uniform(*ends) for name, ends in zip(TRUE, zip(LOW, HIGH, strict=True), strict=True)}
    study = wr.search(pile, axes, "Error", trials=batch * options.rounds, batch=batch, observe=[Error], **SAMPLING)
    best, least = history[-1]
    found = dict(zip(TRUE, best[least.argmin()], strict=True))
    for name, value in TRUE.items():
        print(f"{name}: {value:g} used, {found[name]:.4f} by twins, {study.best_params[name]:.4f} by Optuna")
    print(
        f"error: {1e3 * least.min():.2f} mm by twins, {1e3 * study.best_value:.2f} mm by Optuna, "
        f"noise {1e3 * NOISE:g} mm"
    )
    plot(options.out, batch, [error.min() for _, error in history], [trial.value for trial in study.trials])
    return found, float(least.min()), study


def plot(folder, batch, twins, trials):
    """Plot the smallest error so far of both methods against the number of runs."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 3), layout="constrained")
    panel = figure.subplots()
    runs = batch * np.arange(1, len(twins) + 1)
    searched = np.minimum.accumulate([np.inf if value is None else value for value in trials])
    panel.semilogy(runs, 1e3 * np.array(twins), "o-", label="finite differences of twins")
    panel.semilogy(runs, 1e3 * searched[runs - 1], "s-", label="Optuna")
    panel.axhline(1e3 * NOISE, color="r", linestyle="--", linewidth=1, label="noise of the record")
    panel.set(xlabel="runs", ylabel="error [mm]")
    panel.legend()
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "fit_pile.png")


if __name__ == "__main__":
    main()
