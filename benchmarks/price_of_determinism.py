"""Cost of a deterministic order; `python -m benchmarks.price_of_determinism --devices cpu cuda:0`.

The simulator lists pairs by a count, a prefix sum and a second search; a search that appends to a list with an atomic
counter would be sufficient without determinism. Its line search adds each island's terms as integer multiples of a
fraction of the largest term, which it has to find first; without determinism floats could be added. Both methods are
timed here on the same boxes, outside the simulator.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import warp as wp

import warp_rigid as wr
from warp_rigid.bench.cases import BenchmarkCase
from warp_rigid.commands.terminal import start_warp
from warp_rigid.engine.hash_grid import TRY_ALL_UP_TO

wp.set_module_options({"enable_backward": False})

COUNT, WRITE, APPEND = (wp.constant(k) for k in range(3))

SIZES = ((4096, 10), (1, 100_000))
"""Numbers of environments and of bodies in each."""

PITCH, REACH = 0.2, 0.101
"""Distance of neighbouring boxes, and half the width of each one's bounding box [m]."""

FINE = wp.constant(wp.float64(2.0**40))

WARP, MANY = 32, 4096
"""Threads per sum in a small and in a large environment on a GPU."""

REPEATS, ROUNDS = 5, 5
"""Repetitions within a graph, and launches of the graph, of which the fastest counts."""


class Boxes(NamedTuple):
    """Bounding boxes of many environments, and a list for their pairs."""

    per_env: int
    lower: wp.array
    upper: wp.array
    count: wp.array
    start: wp.array
    pairs: wp.array
    grid: Any


@wp.func
def visit(
    i: int,
    j: int,
    found: int,
    mode: int,
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    start: wp.array[int],
    pairs: wp.array[wp.vec2i],
):
    """Count, write or append a pair if its boxes overlap. Returns the new count."""
    a = lower[i]
    b = upper[i]
    c = lower[j]
    d = upper[j]
    if not (a[0] <= d[0] and c[0] <= b[0] and a[1] <= d[1] and c[1] <= b[1] and a[2] <= d[2] and c[2] <= b[2]):
        return found
    if mode == WRITE:
        pairs[start[i] + found] = wp.vec2i(i, j)
    if mode == APPEND:
        pairs[wp.atomic_add(start, 0, 1)] = wp.vec2i(i, j)
    return found + 1


@wp.kernel
def try_all(
    mode: int,
    per_env: int,
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    count: wp.array[int],
    start: wp.array[int],
    pairs: wp.array[wp.vec2i],
):
    """One thread per body: all later bodies of its environment."""
    i = wp.tid()
    found = int(0)
    if mode != WRITE or start[i + 1] > start[i]:
        for j in range(i + 1, (i / per_env + 1) * per_env):
            found = visit(i, j, found, mode, lower, upper, start, pairs)
    if mode == COUNT:
        count[i] = found


@wp.kernel
def search_grid(
    mode: int,
    grid: wp.uint64,
    reach: float,
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    count: wp.array[int],
    start: wp.array[int],
    pairs: wp.array[wp.vec2i],
):
    """One thread per body: its neighbours in the hash grid."""
    i = wp.tid()
    found = int(0)
    if mode != WRITE or start[i + 1] > start[i]:
        j = int(0)
        for j in wp.hash_grid_query(grid, 0.5 * (lower[i] + upper[i]), reach):
            if j > i:
                found = visit(i, j, found, mode, lower, upper, start, pairs)
    if mode == COUNT:
        count[i] = found


@wp.kernel
def find_largest(lanes: int, begin: wp.array[int], part: wp.array[wp.vec2], largest: wp.array[float]):
    """`lanes` threads per environment: the largest term, which does not depend on the order."""
    env = wp.tid() / lanes
    found = float(1.0e-30)
    for k in range(begin[env] + wp.tid() % lanes, begin[env + 1], lanes):
        found = wp.max(found, wp.max(wp.abs(part[k][0]), wp.abs(part[k][1])))
    wp.atomic_max(largest, env, found)


@wp.kernel
def add_multiples(
    lanes: int,
    begin: wp.array[int],
    part: wp.array[wp.vec2],
    largest: wp.array[float],
    total: wp.array2d[wp.int64],
):
    """`lanes` threads per environment: the sum of the terms as integer multiples of 2^-40 of the largest."""
    env = wp.tid() / lanes
    scale = FINE / wp.float64(largest[env])
    first = wp.int64(0)
    second = wp.int64(0)
    for k in range(begin[env] + wp.tid() % lanes, begin[env + 1], lanes):
        first += wp.int64(scale * wp.float64(part[k][0]))
        second += wp.int64(scale * wp.float64(part[k][1]))
    wp.atomic_add(total, env, 0, first)
    wp.atomic_add(total, env, 1, second)


@wp.kernel
def add_floats(lanes: int, begin: wp.array[int], part: wp.array[wp.vec2], total: wp.array[wp.vec2]):
    """`lanes` threads per environment: the sum of the terms as floats."""
    env = wp.tid() / lanes
    found = wp.vec2(0.0, 0.0)
    for k in range(begin[env] + wp.tid() % lanes, begin[env + 1], lanes):
        found += part[k]
    wp.atomic_add(total, env, found)


def lattice(envs: int, per_env: int, device: Any) -> Boxes:
    """Boxes that touch their neighbours: towers, or a block if there are many in an environment."""
    side = 1 if per_env <= TRY_ALL_UP_TO else round(per_env ** (1 / 3))
    k = np.arange(per_env)
    center = np.tile(PITCH * np.stack([k % side, k // side % side, k // side**2], axis=1), (envs, 1)).astype(np.float32)
    count = envs * per_env
    grid = None
    if per_env > TRY_ALL_UP_TO:
        cells = 1 << int(np.ceil(np.log2((8 * per_env) ** (1 / 3))))
        grid = wp.HashGrid(cells, cells, cells, device=device)
        grid.build(wp.array(center, dtype=wp.vec3, device=device), 2.0 * REACH)
    return Boxes(
        per_env,
        wp.array(center - REACH, dtype=wp.vec3, device=device),
        wp.array(center + REACH, dtype=wp.vec3, device=device),
        wp.zeros(count + 1, dtype=int, device=device),
        wp.zeros(count + 1, dtype=int, device=device),
        wp.zeros(14 * count, dtype=wp.vec2i, device=device),
        grid,
    )


def search(boxes: Boxes, mode: Any) -> None:
    """Search for pairs once."""
    device = boxes.lower.device
    own = [boxes.grid.id, 3.5 * REACH] if boxes.grid else [boxes.per_env]
    wp.launch(
        search_grid if boxes.grid else try_all,
        dim=boxes.lower.shape[0],
        inputs=[mode, *own, boxes.lower, boxes.upper],
        outputs=[boxes.count, boxes.start, boxes.pairs],
        device=device,
    )


def list_in_order(boxes: Boxes) -> None:
    """List pairs by a count, a prefix sum and a second search."""
    search(boxes, COUNT)
    wp.utils.array_scan(boxes.count, boxes.start, inclusive=False)
    search(boxes, WRITE)


def append(boxes: Boxes) -> None:
    """Append pairs to the list in the order in which threads run."""
    boxes.start[:1].zero_()
    search(boxes, APPEND)


def seconds(work: Callable[[], None], device: Any) -> float:
    """Shortest time of a function on a device."""
    clock = time.process_time if device.is_cpu else time.perf_counter
    with wp.ScopedCapture(device, force_module_load=False) as capture:
        for _ in range(REPEATS):
            work()
    taken = []
    for _ in range(ROUNDS):
        wp.synchronize_device(device)
        begin = clock()
        wp.capture_launch(capture.graph)
        wp.synchronize_device(device)
        taken.append((clock() - begin) / REPEATS)
    return min(taken)


class Price(NamedTuple):
    """Time of both methods [s], and the number of results of the free order that changed between two runs."""

    what: str
    in_order: float
    free: float
    results: int
    changed: int


def price_of_lists(boxes: Boxes) -> Price:
    """Time of the list of pairs; the free order lists the same pairs at other indices."""
    device = boxes.lower.device
    lists = []
    for work in (list_in_order, list_in_order, append, append):
        boxes.pairs.fill_(wp.vec2i(-1, -1))
        work(boxes)
        rows = boxes.pairs.numpy().astype(np.int64)
        lists.append(rows[:, 0] * len(rows) + rows[:, 1])
    assert (lists[0] == lists[1]).all()
    assert all((np.sort(one) == np.sort(lists[0])).all() for one in lists[2:])
    times = [seconds(lambda work=work: work(boxes), device) for work in (list_in_order, append)]
    return Price("list of pairs", *times, int((lists[0] >= 0).sum()), int((lists[2] != lists[3]).sum()))


def price_of_sums(boxes: Boxes, envs: int) -> Price:
    """Time of sums over the pairs of each environment; the free order rounds differently."""
    device = boxes.lower.device
    list_in_order(boxes)
    begin = boxes.start.numpy()[:: boxes.per_env].copy()
    values = np.random.default_rng(0).normal(size=(begin[-1], 2)).astype(np.float32)
    lanes = 1 if device.is_cpu else WARP if boxes.per_env <= TRY_ALL_UP_TO else MANY
    part = wp.array(values, dtype=wp.vec2, device=device)
    shared = {"dim": envs * lanes, "inputs": [lanes, wp.array(begin, dtype=int, device=device), part], "device": device}
    largest = wp.zeros(envs, dtype=float, device=device)
    multiples, floats = wp.zeros((envs, 2), dtype=wp.int64, device=device), wp.zeros(envs, wp.vec2, device=device)

    def in_order() -> None:
        largest.zero_()
        multiples.zero_()
        wp.launch(find_largest, **shared, outputs=[largest])
        wp.launch(add_multiples, **shared, outputs=[largest, multiples])

    def freely() -> None:
        floats.zero_()
        wp.launch(add_floats, **shared, outputs=[floats])

    totals = []
    for work, total in ((in_order, multiples), (in_order, multiples), (freely, floats), (freely, floats)):
        work()
        totals.append(total.numpy().astype(np.float64))
    assert (totals[0] == totals[1]).all()
    exact = np.add.reduceat(values.astype(np.float64), begin[:-1])
    fine = largest.numpy()[:, None] / 2.0**40
    assert (np.abs(fine * totals[0] - exact) <= fine * np.diff(begin)[:, None]).all()
    np.testing.assert_allclose(totals[2], exact, atol=1e-5 * np.abs(values).sum() / envs)
    times = [seconds(work, device) for work in (in_order, freely)]
    return Price("sums of the line search", *times, envs, int((totals[2] != totals[3]).any(axis=1).sum()))


def prices(envs: int, per_env: int, device: Any) -> list[Price]:
    """Both measurements at one size."""
    boxes = lattice(envs, per_env, device)
    return [price_of_lists(boxes), price_of_sums(boxes, envs)]


def step_seconds(envs: int, device: Any, steps: int = 40) -> float:
    """Time of a complete step of stacks of ten boxes [s]."""
    sim = wr.Simulator(BenchmarkCase("stack", 10).build(), num_envs=envs, device=device)
    clock = time.process_time if sim.device.is_cpu else time.perf_counter
    sim.step(steps)
    begin = clock()
    sim.step(steps)
    return (clock() - begin) / steps


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--devices", nargs="+", default=["cpu"])
    given = parser.parse_args()
    start_warp()
    print(f"{'device':8} {'environments x bodies':>22}  {'':24} {'in order':>10} {'free':>10} {'changed':>16}")
    for name in given.devices:
        device = wp.get_device(name)
        for envs, per_env in SIZES:
            for price in prices(envs, per_env, device):
                changed = f"{price.changed} of {price.results}"
                print(
                    f"{name:8} {f'{envs} x {per_env}':>22}  {price.what:24} "
                    f"{1e3 * price.in_order:7.3f} ms {1e3 * price.free:7.3f} ms {changed:>16}"
                )
        whole = 1e3 * step_seconds(SIZES[0][0], device)
        print(f"{name:8} {f'{SIZES[0][0]} x 10':>22}  {'complete step':24} {whole:7.3f} ms")


if __name__ == "__main__":
    main()
