"""Roofline: the least time of each stage by memory, arithmetic and launches; `python -m benchmarks.roofline`.

Every scene is run until it has settled, or for a given time in which it still moves. Then the work of one step is
counted: rows from the live arrays, bytes per row from the declarations in `kernels/schema.py`, operations per visit
from the constants below. The floor of a stage is the largest of three times: its bytes at the memory's bandwidth, its
operations at the arithmetic's rate, and its launches one after another. Each array counts once per stage, because
repeated reads are assumed to hit a cache. Therefore no implementation with this data can be faster than the floor.
"""

import argparse
import contextlib
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from benchmarks import roofline_report
from warp_rigid import Settings, Simulator
from warp_rigid.bench.cases import BenchmarkCase, find_case
from warp_rigid.bench.measure import FPS, STAGE_STEPS, commit
from warp_rigid.engine.cores import shared_by, usable_cores
from warp_rigid.engine.simulator import choose_device
from warp_rigid.engine.stage_times import STAGES, walk
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.collide import approach as approaches
from warp_rigid.kernels.collide import convex_pairs, culling

MAIN = ("stack:10:4096", "pile_box:32:1024", "pile_torus:16:256", "pile_bunny:16:256")
"""The four main scenes: name, bodies, environments."""

MOVING = ("pile_box:32:1024@0.5", "pile_torus:16:256@0.5", "pile_bunny:16:256@0.5", "pile_box:4096:1@1.2")
"""Scenes in motion, with the time at which the work is counted [s]."""

SUBSTEPS, SETTLE = 4, 240
"""Steps and frames of 1/60 s before the work is counted."""

OPERATIONS = {
    "predict": 400,  # role, world inertia R I R^T, accelerations, swept box
    "test of boxes": 12,
    "reach of a pair": 150,  # relative pose, travel, and whether it has moved since the last search
    "cluster": 60,  # centre into the other frame, its box
    "sample": 40,  # the same
    "distance": 120,  # cell, eight values, gradient
    "contact": 700,  # position, tangents, inverse masses, coefficients, impulses of the last step
    "graph": 40,  # of a contact: which body supports which
    "impact": 60,  # of a contact: normal velocity
    "visit": 220,  # normal impulse, friction in its cone, both bodies' velocities
    "search": 150,  # of a contact, in the line search
    "overlap": 120,  # of a contact, in the push-out
    "course": 60,  # of a pair, in continuous collision detection
}
"""Additions, multiplications, divisions and roots of one visit, in float32."""

MOVE = 1000
"""The same for a body's rotation, in float64."""


@dataclass(frozen=True)
class Limits:
    """Peak rates of a device.

    Attributes:
        bandwidth: of its memory [bytes/s].
        single: operations per second in float32.
        double: operations per second in float64.
        launch: time between two empty kernels of a graph [s].
    """

    bandwidth: float
    single: float
    double: float
    launch: float


LIMITS = {"cuda": Limits(4.4e12, 67e12, 34e12, 0.75e-6), "cpu": Limits(25e9, 60e9, 60e9, 0.15e-6)}
"""One H200 (4.0 to 4.8 TB/s), and one core of a server's processor."""


@dataclass
class Work:
    """Memory traffic and arithmetic of a stage in one step.

    Attributes:
        read: bytes read, each array once.
        written: bytes written.
        single: operations in float32.
        double: operations in float64.
        launches: number of kernels, copies and fills.
    """

    read: float = 0.0
    written: float = 0.0
    single: float = 0.0
    double: float = 0.0
    launches: int = 0

    def floor(self, limits: Limits) -> tuple[float, str]:
        """The least time [s], and its cause."""
        return max(
            ((self.read + self.written) / limits.bandwidth, "memory"),
            (self.single / limits.single + self.double / limits.double, "arithmetic"),
            (self.launches * limits.launch, "launches"),
        )


@dataclass
class Counts:
    """Amount of work in one step of all environments, as found in the live arrays.

    Attributes:
        envs: environments.
        rows: bodies, static ones included.
        small: bodies of an environment that are tested against each other.
        wide: bodies of an environment that are tested against every body.
        pairs: pairs whose bounding boxes overlap.
        searched: pairs whose contacts were searched again.
        clusters: tested clusters of samples.
        near: clusters that passed the test.
        samples: tested samples of near clusters.
        close: samples that passed the test, for which a distance is computed.
        touching: pairs with contacts.
        contacts: number of contacts.
        levels: highest level of any environment.
        sweeps: visits of contacts in sweeps; the smallest number that results in the same state.
        unsettled: contacts of environments that need shock propagation after the sweeps.
        unsettled_rows: bodies of those environments.
        gridded: whether the broad phase uses the hash grid.
        pool_clusters: clusters in the pool of shapes, which all environments share.
        pool_samples: samples in that pool.
        pool_nodes: nodes of distance grids in that pool.
    """

    envs: int
    rows: int
    small: int
    wide: int
    pairs: int
    searched: int
    clusters: int
    near: int
    samples: int
    close: int
    touching: int
    contacts: int
    levels: int
    sweeps: int
    unsettled: int
    unsettled_rows: int
    gridded: bool
    pool_clusters: int
    pool_samples: int
    pool_nodes: int


@dataclass
class Found:
    """Counts and measured times of one scene, by stage, in seconds per step."""

    scene: str
    device: str
    commit: str
    counts: Counts
    work: dict[str, Work]
    measured: dict[str, float]
    working_set: int
    limits: Limits
    floors: dict[str, tuple[float, str]] = field(init=False)

    def __post_init__(self) -> None:
        """Derive the floors."""
        self.floors = {name: work.floor(self.limits) for name, work in self.work.items()}


wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.kernel
def count_samples(
    dt: float,
    shapes: schema.Shapes,
    bodies: schema.Bodies,
    state: schema.State,
    motions: schema.Motions,
    pairs: schema.Pairs,
    counted: wp.array2d[int],
):
    """One thread per searched pair: its clusters, near clusters, their samples, and the close ones."""
    pair = wp.tid()
    if pairs.patch_count[pair] < 0:
        return
    a = pairs.body_a[pair]
    b = pairs.body_b[pair]
    size = wp.min(shapes.shapes[bodies.shape[a]].size, shapes.shapes[bodies.shape[b]].size)
    reach = approaches.contact_reach(a, b, size, dt, state, motions)
    side = int(0)
    while side < 2:
        own = wp.where(side == 0, a, b)
        approach = approaches.approach_of(own, a + b - own, reach, bodies, state)
        approach = convex_pairs.cut_by_axis(approach, pairs.axis[pair], side, shapes)
        own_shape = shapes.shapes[approach.own_shape]
        counted[pair, 0] += own_shape.cluster_end - own_shape.cluster_start
        for cluster in range(own_shape.cluster_start, own_shape.cluster_end):
            if culling.cluster_is_near(cluster, approach, 1, shapes) == 1:
                counted[pair, 1] += 1
                for s in range(shapes.clusters[cluster].sample_start, shapes.clusters[cluster].sample_end):
                    counted[pair, 2] += 1
                    if culling.sample_is_near(s, approach, shapes):
                        counted[pair, 3] += 1
        side += 1


def measure(text: str, device: Any, settle: int = SETTLE, steps: int = STAGE_STEPS) -> Found:
    """Settle a scene and compare the measured time of each stage with its floor.

    Args:
        text: name, bodies and environments, such as "stack:10:4096", and optionally the time at which the work is
            counted [s], as in "pile_box:32:1024@0.5".
        device: the Warp device.
        settle: frames before the work is counted, where no time is given.
        steps: number of steps over which the times are averaged.

    Raises:
        ValueError: There is no such scene.
    """
    scene, _, seconds = text.partition("@")
    name, _, envs = scene.rpartition(":")
    case = find_case(name)
    sim = settled(case, int(envs), device, round(FPS * float(seconds)) if seconds else settle)
    counts = count(sim)
    launches = count_launches(sim)
    work = {stage: work_of(stage, counts) for stage in STAGES if stage in launches}
    for stage, found in work.items():
        found.launches = launches[stage]
    limits = LIMITS["cuda" if sim.device.is_cuda else "cpu"]
    named = sim.device.name if sim.device.is_cuda else "one core of a CPU"
    return Found(text, named, commit(), counts, work, sim.stage_times(steps), sim.memory, limits)


def settled(case: BenchmarkCase, envs: int, device: Any, frames: int) -> Simulator:
    """A simulator of a case in one shard, after some frames."""
    with shared_by(usable_cores()):  # one core, so one shard
        sim = Simulator(case.build(), envs, Settings(dt=1.0 / (FPS * SUBSTEPS)), device=device)
    case.scatter(sim)
    sim.step(frames * SUBSTEPS)
    return sim


def count(sim: Simulator) -> Counts:
    """Count the work of the next step without changing the state."""
    (shard,) = sim.internals.shards
    shard.save(attempt=0)
    stages, pools = shard.stages, shard.pools
    pools.pairs.patch_count.fill_(-1)
    stages.replay()
    pairs = int(pools.pairs.start.numpy()[-1])
    searched = int((pools.pairs.patch_count.numpy()[:pairs] >= 0).sum())
    start = pools.pairs.contact_start.numpy()[: pairs + 1]
    first_pair = pools.pairs.start.numpy()[:: sim.num_bodies]
    contacts = np.diff(start[first_pair])
    converged = pools.graph.converged.numpy() == 1
    shard.undo(attempt=0)
    stages.predict(sim.settings.dt)
    counted = wp.zeros((max(pairs, 1), 4), dtype=int, device=sim.device)
    inputs = [
        sim.settings.dt,
        sim.internals.model.shapes,
        sim.internals.model.bodies,
        sim.internals.state,
        stages.motions,
        pools.pairs,
    ]
    wp.launch(count_samples, dim=pairs, inputs=inputs, outputs=[counted], device=sim.device)
    clusters, near, tested, close = (int(total) for total in counted.numpy().sum(axis=0))
    groups = sim.internals.model.size_groups[sim.scene]
    return Counts(
        envs=sim.num_envs,
        rows=sim.num_envs * sim.num_bodies,
        small=len(groups.small),
        wide=len(groups.oversized),
        pairs=pairs,
        searched=searched,
        clusters=clusters,
        near=near,
        samples=tested,
        close=close,
        touching=int((np.diff(start) > 0).sum()),
        contacts=int(contacts.sum()),
        levels=sim.counts()["levels"],
        sweeps=int((sweeps_needed(sim) * contacts).sum()),
        unsettled=int(contacts[~converged].sum()),
        unsettled_rows=int((~converged).sum()) * sim.num_bodies,
        gridded=stages.grid.buckets > 0,
        pool_clusters=sim.internals.model.shapes.clusters.shape[0],
        pool_samples=sim.internals.model.shapes.samples.shape[0],
        pool_nodes=sim.internals.model.shapes.grid_value.shape[0],
    )


def sweeps_needed(sim: Simulator) -> np.ndarray:
    """The fewest contact iterations with which each environment's step ends in the same bits, (envs,)."""
    given = sim.get("contact_iterations")
    wanted = _velocities_after(sim, given)
    needed = given.copy()
    for fewer in range(int(given.max()) - 1, -1, -1):
        tried = np.minimum(given, fewer)
        same = (_velocities_after(sim, tried) == wanted).all(axis=(1, 2))
        needed[same & (needed == fewer + 1)] = fewer
    sim.set("contact_iterations", given)
    return needed


def _velocities_after(sim: Simulator, iterations: np.ndarray) -> np.ndarray:
    sim.set("contact_iterations", iterations)
    (shard,) = sim.internals.shards
    shard.save(attempt=0)
    shard.stages.replay()
    found = np.concatenate([sim.get("linear_velocity"), sim.get("angular_velocity")], axis=-1)
    shard.undo(attempt=0)
    return found


def count_launches(sim: Simulator) -> dict[str, int]:
    """Number of kernels, sums, copies and fills that each stage of a step launches."""
    found: dict[str, int] = {}
    running: list[str | None] = [None]
    (shard,) = sim.internals.shards
    shard.save(attempt=0)
    with _counted_launches(lambda: found.update({running[-1]: found.get(running[-1], 0) + 1})):

        def switch(name: str | None) -> None:
            running.append(name)
            if name is not None:
                found.setdefault(name, 0)

        walk(shard.stages, switch)
    shard.undo(attempt=0)
    return {stage: found[stage] for stage in STAGES if stage in found}


@contextlib.contextmanager
def _counted_launches(note: Callable[[], None]) -> Iterator[None]:
    """Call `note` at every kernel launch and every prefix sum."""

    def noting(function: Callable) -> Callable:
        def run(*given: Any, **named: Any) -> Any:
            note()
            return function(*given, **named)

        return run

    launch, scan = wp.launch, wp.utils.array_scan
    wp.launch, wp.utils.array_scan = noting(launch), noting(scan)
    try:
        yield
    finally:
        wp.launch, wp.utils.array_scan = launch, scan


def row(struct: Any, symbol: str, *only: str) -> int:
    """Bytes of one row of a layout: of all its arrays over `symbol`, or of those named.

    Raises:
        KeyError: The layout has no array of a given name.
    """
    total = 0
    if unknown := set(only) - set(declare.LAYOUTS[struct.key]):
        raise KeyError(f"{struct.key} has no {', '.join(sorted(unknown))}")
    for name, declared in declare.LAYOUTS[struct.key].items():
        first, *others = (term.strip() for term in declared.shape.split(","))
        if first.partition(" ")[0] == symbol and (not only or name in only):
            total += wp.types.type_size_in_bytes(declared.dtype) * int(np.prod([int(term) for term in others]))
    return total


def part(record: Any, *only: str) -> int:
    """Bytes of the named fields of a record, or of all fields."""
    fields = declare.RECORDS[record.key]
    return sum(wp.types.type_size_in_bytes(fields[name].dtype) for name in only or fields)


VELOCITY = part(schema.SolverBodyRecord, "linear", "inverse_mass", "angular")
MASS = part(schema.SolverBodyRecord, "inverse_inertia_xx", "inverse_inertia_yz")
IMPULSE = part(schema.ImpulseRecord, "impulse", "angular_impulse")
CONTACT, LOAD, ENTRY = part(schema.ContactRecord), part(schema.ImpulseRecord), part(schema.OrderRecord)


def work_of(stage: str, c: Counts) -> Work:
    """Least work of a stage by the counts, without launches."""
    return _WORK[stage](c) if stage in _WORK else Work()


def _predict(c: Counts) -> Work:
    read = row(schema.State, "bodies") + row(schema.Bodies, "bodies")
    return Work(c.rows * read, c.rows * row(schema.Motions, "bodies"), c.rows * OPERATIONS["predict"])


def _find_pairs(c: Counts) -> Work:
    tests = c.pairs if c.gridded else c.envs * (c.small * (c.small - 1) // 2 + c.small * c.wide)
    read = c.rows * (row(schema.Motions, "bodies", "lower", "upper", "role") + row(schema.History, "bodies"))
    written = c.rows * row(schema.Pairs, "bodies") + c.pairs * row(schema.Pairs, "pairs", "body_a", "body_b", "dormant")
    return Work(read, written, 2 * tests * OPERATIONS["test of boxes"])


def _find_contacts(c: Counts) -> Work:
    searched = ("searched", "searched_orientation", "searched_position", "contact_start")
    pool = min(c.clusters, c.pool_clusters) * part(schema.ClusterRecord)
    pool += min(c.samples + c.contacts, c.pool_samples) * part(schema.SampleRecord)
    pool += min(8 * (c.near + c.close + c.contacts), c.pool_nodes) * 4
    read = c.rows * (row(schema.State, "bodies") + row(schema.Motions, "bodies"))
    read += c.pairs * (row(schema.History, "pairs") + row(schema.Pairs, "pairs", "body_a", "body_b", "dormant"))
    read += c.contacts * row(schema.History, "contacts", "key", "impulse", "angular_impulse") + pool
    written = c.contacts * (CONTACT + IMPULSE + row(schema.Contacts, "contacts", "key", "position"))
    written += c.pairs * row(schema.Pairs, "pairs", *searched, "contact_count") + 4 * c.contacts
    operations = {"reach of a pair": c.pairs, "cluster": c.clusters, "sample": c.samples, "contact": c.contacts}
    operations["distance"] = c.near + c.close + c.contacts
    return Work(read, written, sum(visits * OPERATIONS[name] for name, visits in operations.items()))


def _build_graph(c: Counts) -> Work:
    read = c.pairs * row(schema.Pairs, "pairs", "body_a", "body_b", "contact_start") + c.contacts * CONTACT
    read += c.rows * (VELOCITY + row(schema.Motions, "bodies", "acceleration"))
    written = c.rows * row(schema.Graph, "bodies", "level", "depth", "island", "colors")
    written += c.pairs * row(schema.Graph, "pairs", "supports", "color") + c.touching * ENTRY
    return Work(read, written, c.contacts * OPERATIONS["graph"])


def _accelerate(c: Counts) -> Work:
    read = VELOCITY + row(schema.Motions, "bodies", "acceleration", "spin_acceleration", "role")
    return Work(c.rows * read, c.rows * VELOCITY, 12 * c.rows)


def _collide(c: Counts) -> Work:
    read = c.touching * ENTRY + c.contacts * CONTACT + c.rows * (VELOCITY + MASS)
    return Work(read, 0.0, c.contacts * OPERATIONS["impact"])


def _solve_contacts(c: Counts) -> Work:
    read = c.touching * ENTRY + c.contacts * (CONTACT + IMPULSE) + c.rows * (VELOCITY + MASS)
    return Work(read, c.contacts * IMPULSE + c.rows * VELOCITY, (c.contacts + c.sweeps) * OPERATIONS["visit"])


def _propagate_shock(c: Counts) -> Work:
    entries = c.touching * c.unsettled / max(c.contacts, 1) * ENTRY
    solver_body = part(schema.SolverBodyRecord)
    single = c.unsettled * (2 * OPERATIONS["visit"] + OPERATIONS["search"])
    read = entries + c.unsettled * (CONTACT + LOAD) + c.unsettled_rows * solver_body
    return Work(read, c.unsettled * LOAD + c.unsettled_rows * solver_body, single)


def _push_out(c: Counts) -> Work:
    read = c.contacts * (CONTACT + row(schema.Contacts, "contacts", "key")) + c.rows * VELOCITY
    return Work(
        read, c.contacts * part(schema.ImpulseRecord, "impact_impulse", "target"), c.contacts * OPERATIONS["overlap"]
    )


def _follow(c: Counts) -> Work:
    read = c.rows * (row(schema.State, "bodies", "position", "orientation") + VELOCITY)
    read += c.rows * row(schema.Motions, "bodies", "center", "radius", "max_travel")
    read += c.pairs * row(schema.Pairs, "pairs", "body_a", "body_b")
    own = ("time_of_impact", "course", "shared_spin")
    kept = row(schema.Motions, "bodies", *own, *(f"next_{name}" for name in own), "first_impact", "changed", "joined")
    return Work(read, c.rows * kept, c.pairs * OPERATIONS["course"])


def _move(c: Counts) -> Work:
    state = row(schema.State, "bodies")
    read = state + part(schema.SolverBodyRecord) + row(schema.Bodies, "bodies", "motion", "inertia", "center_of_mass")
    return Work(c.rows * read, c.rows * state, 0.0, c.envs * c.small * MOVE)


def _remember(c: Counts) -> Work:
    moved = c.rows * row(schema.History, "bodies") + c.pairs * row(schema.History, "pairs")
    moved += c.contacts * row(schema.History, "contacts")
    return Work(moved, moved)


_WORK: dict[str, Callable[[Counts], Work]] = {
    "predict": _predict,
    "find_pairs": _find_pairs,
    "find_contacts": _find_contacts,
    "build_graph": _build_graph,
    "integrate_velocities": _accelerate,
    "solve_impacts": _collide,
    "solve_contacts": _solve_contacts,
    "propagate_shock": _propagate_shock,
    "push_out": _push_out,
    "detect_continuous_collisions": _follow,
    "integrate_positions": _move,
    "store_history": _remember,
}


def main(arguments: list[str] | None = None) -> None:
    """Measure scenes, print their tables, and write the requested files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", help="name:bodies:environments, or name:bodies:environments@seconds")
    parser.add_argument("--device")
    parser.add_argument("--settle", type=int, default=SETTLE, help="frames before the work is counted, without @")
    parser.add_argument("--write", help="output file for the tables (.md)")
    parser.add_argument("--json", help="output file for the figures (.json)")
    given = parser.parse_args(arguments)
    device = choose_device(given.device)
    found = []
    for text in given.scenes or (*MAIN, *MOVING):
        found.append(measure(text, device, given.settle))
        print(roofline_report.markdown(found[-1]), flush=True)
    for path, text in (
        (given.write, roofline_report.page(found)),
        (given.json, json.dumps([asdict(f) for f in found], indent=1)),
    ):
        if path:
            Path(path).write_text(text)


if __name__ == "__main__":
    main()
