"""The price of the checks of a step: its time with them and without them.

`python -m benchmarks.price_of_checks` measures on the CPU, `--device cuda:0` on a GPU. Without checks, non-finite
states are not searched, steps cannot be undone, and there are no health checks. The sums for the energy gained without
work and the tests in the prediction are parts of other kernels and remain; docs/safety.md states their time.
"""

import argparse
import contextlib
import time
from collections.abc import Iterator

import warp as wp

import warp_rigid as wr
from warp_rigid.engine import health_checks
from warp_rigid.engine.shard import Shard
from warp_rigid.engine.step import Stages
from warp_rigid.kernels.update import integrate
from warp_rigid.warp_start import start_warp

CASES = {"256 x 10, towers": (256, 64), "1 x 10, a tower": (1, 2048)}
"""Environments of box_stack, and steps of a measurement."""

HEIGHT = 8
ROUNDS = 15


def _save_nothing(shard: Shard, attempt: int) -> None:
    """Take the place of Shard.save."""


@contextlib.contextmanager
def without_checks() -> Iterator[None]:
    """Simulators made and stepped in this context do not check anything that can be left out."""
    per_body, save, every = Stages._per_body, Shard.save, health_checks.EVERY

    def but_not_finite(self: Stages, kernel: object, inputs: list, outputs: list) -> None:
        if kernel is not integrate.find_non_finite:
            per_body(self, kernel, inputs, outputs)

    Stages._per_body, Shard.save, health_checks.EVERY = but_not_finite, _save_nothing, 2**40
    try:
        yield
    finally:
        Stages._per_body, Shard.save, health_checks.EVERY = per_body, save, every


def seconds_of(sim: wr.Simulator, steps: int) -> float:
    """Time of a step [s]: on a CPU that of all its cores, on which other programs have less influence."""
    clock = time.perf_counter if sim.device.is_cuda else time.process_time
    wp.synchronize_device(sim.device)
    begin = clock()
    sim.step(steps)
    wp.synchronize_device(sim.device)
    return (clock() - begin) / steps


def measure(envs: int, steps: int, device: str, height: int = HEIGHT) -> tuple[float, float]:
    """Least time of a step with and without checks, measured by turns [s]."""
    scene = wr.scenes.load("box_stack", height=height)
    checked = wr.Simulator(scene, envs, device=device)
    with without_checks():
        unchecked = wr.Simulator(scene, envs, device=device)
    checked.step(256)  # pools grow, and the towers stand
    unchecked.step(256)
    both: list[tuple[float, float]] = []
    for _ in range(ROUNDS):
        with_checks = seconds_of(checked, steps)
        with without_checks():
            both.append((with_checks, seconds_of(unchecked, steps)))
    return min(first for first, _ in both), min(second for _, second in both)


def main() -> None:
    """Print a line for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    device = parser.parse_args().device
    start_warp()
    for name, (envs, steps) in CASES.items():
        checked, unchecked = measure(envs, steps, device)
        share = 100.0 * (checked / unchecked - 1.0)
        print(
            f"{name}: {1e3 * checked:.4g} ms with checks, {1e3 * unchecked:.4g} ms without, {share:.2f} %", flush=True
        )


if __name__ == "__main__":
    main()
