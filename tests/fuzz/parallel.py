"""Simulators in several threads, one each or one for all: the bits of one after another, and no deadlock."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from hypothesis import strategies as st

import warp_rigid as wr
from tests.fuzz.harness import Target
from tests.oracles import ground_scene

PATIENCE = 60.0

ACTION = st.one_of(
    st.tuples(st.just("step"), st.integers(0, 20)),
    st.tuples(st.just("friction"), st.floats(0.0, 1.0)),
    st.tuples(st.just("mass"), st.floats(0.1, 5.0)),
    st.tuples(st.just("impulse"), st.floats(-1.0, 1.0)),
    st.tuples(st.just("shock_iterations"), st.integers(1, 3)),
    st.tuples(st.just("sleeping"), st.booleans()),
    st.tuples(st.sampled_from(["penetration", "contacts", "status", "reset", "save", "refused"]), st.none()),
)
PROGRAM = st.tuples(st.integers(1, 6), st.lists(ACTION, min_size=1, max_size=5))
"""Number of boxes, and what is done with them."""


def simulator(count: int) -> wr.Simulator:
    scene = ground_scene(friction=0.5)
    for k in range(count):
        scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0.02 * k, 0, 0.1 + 0.2 * k))
    return wr.Simulator(scene, num_envs=2, device="cpu", capacity={"pairs": 2, "contacts": 4})


def act(sim: wr.Simulator, name: str, value: float, file: Path) -> None:
    if name == "step":
        sim.step(int(value))
    elif name == "impulse":
        sim.apply_impulse((value, 0, 0), (0, 0, 0), 1)
    elif name == "mass":
        sim.set(name, value, bodies=[1])
    elif name == "save":
        sim.save(file)
    elif name == "refused":
        try:
            sim.set("friction", -1.0)
        except ValueError:
            return
        raise AssertionError("a negative friction was accepted")
    elif value is None:
        getattr(sim, name)()
    else:
        sim.set(name, value)


def run(program: tuple, file: Path) -> list[bytes]:
    count, actions = program
    sim = simulator(count)
    for name, value in actions:
        act(sim, name, value, file)
    return [sim.get(name).tobytes() for name in ("position", "orientation", "linear_velocity", "angular_velocity")]


def at_once(work, arguments: list) -> list:
    with ThreadPoolExecutor(len(arguments)) as pool:
        jobs = [pool.submit(work, *argument) for argument in arguments]
        return [job.result(PATIENCE) for job in jobs]


def try_own_simulators(case: list, folder: Path) -> None:
    arguments = [(program, folder / f"{k}.ckpt") for k, program in enumerate(case)]
    alone = [run(*argument) for argument in arguments]
    assert at_once(run, arguments) == alone


def try_one_simulator(case: list, folder: Path) -> None:
    """The order is open, but each call is whole: the numbers of steps add up, and the state is one of the simulator."""
    sim = simulator(case[0][0])

    def use(actions: list, file: Path) -> None:
        for name, value in actions:
            if name != "reset":
                act(sim, name, value, file)

    at_once(use, [(actions, folder / f"{k}.ckpt") for k, (_, actions) in enumerate(case)])
    steps = sum(value for _, actions in case for name, value in actions if name == "step")
    assert round(sim.time / sim.settings.dt) == steps
    sim.save(folder / "all.ckpt")
    again = wr.Simulator.load(folder / "all.ckpt")
    for one in (sim, again):
        one.step(2)
    assert sim.get("position").tobytes() == again.get("position").tobytes()


TARGETS = [
    Target("threads", st.lists(PROGRAM, min_size=2, max_size=2), try_own_simulators),
    Target("threads of one simulator", st.lists(PROGRAM, min_size=2, max_size=3), try_one_simulator),
]
