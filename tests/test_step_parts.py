"""One crowded environment on several cores: not a bit depends on their number, nor on threads that come late.

A machine may have one core: how many the simulator believes to have is set here. One worker is the oracle, since then
no thread is started, and the step is one graph.
"""

import pytest
import warp as wp

from tests.test_threads import at_once
from tests.test_trust import bits, heap
from warp_rigid.engine import batch, step_parts
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.kernels.common.sharing import Sharing, claim, finish, rows_of

wp.set_module_options({"enable_backward": False})

BOXES = 150
STEPS = 50


@pytest.fixture
def on_workers(monkeypatch):
    """A function that makes simulators of one environment whose shared parts so many workers execute, all of them."""
    monkeypatch.setattr(step_parts, "WORTH_SHARING", 0.0)
    monkeypatch.setattr(step_parts, "BODIES_A_WORKER", 1)

    def make(count, scene=None, **arguments):
        monkeypatch.setattr(batch, "usable_cores", lambda: count)
        return Simulator(scene or heap(BOXES), device="cpu", **arguments)

    return make


def outcome(sim, steps=STEPS):
    """Everything that steps of a simulator leave: state, contacts, and what the solver did."""
    solved = []
    for _ in range(steps // 10):
        sim.step(10)
        solved.append({name: values.tolist() for name, values in sim.stats().items()})
    return bits(sim), sim.contacts().tobytes(), solved


ALONE = {}


def alone(on_workers, sleeping=False):
    """The outcome with one worker, simulated once for all tests."""
    if sleeping not in ALONE:
        sim = on_workers(1, settings=Settings(sleeping=sleeping))
        assert not shared_parts(sim)
        ALONE[sleeping] = outcome(sim)
    return ALONE[sleeping]


def shared_parts(sim):
    (shard,) = sim._world.shards
    return [part for part in shard.stages.parts._parts if isinstance(part, step_parts.SharedPart)]


@pytest.mark.parametrize("sleeping", [False, True], ids=["", "sleeping"])
def test_no_bit_depends_on_the_number_of_workers(on_workers, sleeping):
    expected = alone(on_workers, sleeping)
    assert any(step["islands_rounds"] != [0] for step in expected[2]), "nothing is solved in rounds"
    for count in (3,) if sleeping else (8,):
        sim = on_workers(count, settings=Settings(sleeping=sleeping))
        assert shared_parts(sim) and outcome(sim) == expected


@pytest.mark.parametrize("late", [False, True], ids=["never", "late"])
def test_threads_that_never_start_or_start_late_are_not_needed(on_workers, monkeypatch, late):
    def spread(work, parts, threads):
        assert len(parts) == threads == 3
        for part in parts if late else parts[:1]:
            work(part)

    expected = alone(on_workers)
    monkeypatch.setattr(step_parts, "spread", spread)
    assert outcome(on_workers(3)) == expected


def test_simulators_in_threads_share_the_cores(on_workers):
    expected = alone(on_workers)
    sims = [on_workers(2), on_workers(3)]
    assert at_once(outcome, sims) == [expected, expected]


def test_a_short_part_is_not_shared(on_workers, monkeypatch):
    """It is executed on the current thread, from the second step on."""
    sim = on_workers(2)
    monkeypatch.setattr(step_parts, "WORTH_SHARING", 1.0e9)
    sim.step(2)
    threads_of_parts = []

    def spread(work, parts, threads):
        threads_of_parts.append(threads)
        work(parts[0])

    monkeypatch.setattr(step_parts, "spread", spread)
    sim.step(2)
    assert set(threads_of_parts) == {1}


def test_only_a_single_crowded_environment_has_shared_parts(on_workers):
    assert not shared_parts(on_workers(2, heap(60)))
    assert len(list(on_workers(2, num_envs=2)._world.shards)) == 2


@wp.kernel
def count_visits(sharing: Sharing, visits: wp.array[int]):
    """Count how often each row is processed."""
    own = claim(wp.tid(), sharing)
    rows = rows_of(own, visits.shape[0], sharing)
    for k in range(rows.first, rows.end, rows.stride):
        visits[k] += 1
    finish(own, sharing)


@pytest.fixture
def two_launches():
    """A recorded shared part of two launches over 1000 rows, and the visits of each."""
    cpu = wp.get_device("cpu")
    wp.load_module(device=cpu)
    parts, visits = step_parts.StepParts(cpu, 3), [wp.zeros(1000, dtype=int, device=cpu) for _ in range(2)]
    with parts.recorded(), parts.shared():
        for counts in visits:
            sharing = parts.sharing(1)
            wp.launch(count_visits, sharing.count, [sharing], [counts], device=cpu)
    return parts, [counts.numpy() for counts in visits]


def test_every_row_is_processed_once(two_launches):
    parts, visits = two_launches
    for turn in range(1, 200):
        parts.replay()
        assert (visits[0] == turn).all() and (visits[1] == turn).all()


def test_a_worker_does_not_wait_for_ever_for_another_one(two_launches):
    """The other one has claimed the first chunk: all others are processed, and the next launch after that chunk."""
    parts, visits = two_launches
    tickets = parts._tickets
    opening, shared = parts._parts[:2]
    opening()
    tickets.claimed.numpy()[0] = 1
    wp.capture_launch(shared._graph)
    left = -(-1000 // (3 * step_parts.CHUNKS_A_WORKER))
    assert visits[0].tolist() == left * [0] + (1000 - left) * [1] and not visits[1].any() and shared._is_open()
    tickets.finished.numpy()[0] += 1
    wp.capture_launch(shared._graph)
    assert visits[0].sum() == 1000 - left and (visits[1] == 1).all() and not shared._is_open()
