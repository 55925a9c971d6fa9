"""Settings, quantities that are set, and the command line."""

import functools
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

import warp_rigid as wr
from tests.fuzz.harness import NUMBERS, ODDITIES, Target, vectors
from warp_rigid import scenes
from warp_rigid.commands import cli
from warp_rigid.engine.quantities import WRITABLE
from warp_rigid.engine.settings import PER_ENVIRONMENT
from warp_rigid.runs import assignments, runner

VALUES = st.one_of(ODDITIES, NUMBERS, st.integers(-1, 20), vectors(3), st.lists(ODDITIES, max_size=3))
INDICES = st.one_of(st.none(), st.lists(st.integers(-1, 3), max_size=3), ODDITIES)


def try_settings(case: dict, folder: Path) -> None:
    wr.Settings(**case)


@functools.cache
def simulator() -> wr.Simulator:
    """One for all cases: what is refused must leave it as it was."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1))
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 0.3))
    return wr.Simulator(scene, num_envs=2, device="cpu")


def try_set(case: tuple, folder: Path) -> None:
    name, value, envs, bodies, point = case
    sim = simulator()
    before = [sim.get(key).tobytes() for key in WRITABLE]
    try:
        if name == "impulse":
            sim.apply_impulse(value, point, bodies, envs)
        else:
            sim.set(name, value, envs=envs, bodies=bodies)
    except ValueError:
        assert [sim.get(key).tobytes() for key in WRITABLE] == before
        raise
    if "iterations" in name:
        sim.set(name, np.minimum(sim.get(name), 20).tolist())
    sim.step(1)
    sim.status()
    sim.reset()


WORD = st.text("0123456789.,=()[]{}-+eE*_ jxtrunaif'\"\\\n\x00é", max_size=12)
NAME = st.sampled_from(
    ["friction", "angle", "dt", "gravity", "mass", "shock_propagation", "linear-velocity", "x", "", "seed"]
)
ASSIGNMENT = st.one_of(
    st.tuples(NAME, WORD).map("=".join),
    st.tuples(NAME, st.lists(NUMBERS, min_size=1, max_size=4)).map(lambda c: f"{c[0]}={','.join(map(str, c[1]))}"),
    st.tuples(NAME, st.lists(NUMBERS, min_size=1, max_size=4)).map(lambda c: f"{c[0]}={tuple(c[1])}"),
    st.tuples(NAME, st.sampled_from("([{-~"), st.integers(1, 20_000)).map(lambda c: f"{c[0]}={c[1] * c[2]}1"),
    st.tuples(NAME, st.integers(1, 6000)).map(lambda c: f"{c[0]}={'9' * c[1]}"),
    WORD,
)


def try_assignments(case: list[str], folder: Path) -> None:
    demo = scenes.get("incline")
    given = assignments.sort_assignments(case, demo.build)
    if (given.num_envs or 1) > 8:
        return
    plan = runner.plan_run(demo, case, frames=1, device="cpu")
    for name in PER_ENVIRONMENT:
        if "iterations" in name:
            plan.sim.set(name, np.minimum(plan.sim.get(name), 20).tolist())
    plan.sim.step(1)


NUMBER = st.one_of(st.integers(-2, 3).map(str), NUMBERS.map(str), WORD)
FLAG = st.one_of(
    st.tuples(
        st.sampled_from(["--fps", "--substeps", "--seed", "--device", "--checkpoint-every", "--memory-limit"]), NUMBER
    ),
    st.tuples(st.just("--envs"), st.one_of(st.integers(-2, 3).map(str), WORD, st.sampled_from(["9" * 30, "10000000"]))),
    st.tuples(st.just("--usd-envs"), NUMBER),
    st.tuples(st.just("--set"), ASSIGNMENT),
    st.tuples(st.sampled_from(["--resume", "--compare", "--json", "--no-such-flag", "stray"])),
)


def _is_work(flag: tuple) -> bool:
    """What is allowed, and takes long because it is much: many environments, many steps a frame."""
    try:
        number = float(flag[-1])
    except ValueError:
        return False
    few = {"--envs": 3, "--substeps": 50}.get(flag[0])
    return (few is not None and few < number < 5e6) or (flag[0] == "--fps" and 2e-4 < number < 10)


def try_command(case: list[tuple], folder: Path) -> None:
    """The whole command line, writing into the folder: exit status and one line say how it ended."""
    flags = [part for flag in case for part in flag]
    if any(_is_work(flag) for flag in case):
        return
    arguments = [
        "run",
        "incline",
        "--frames",
        "1",
        "--checkpoint",
        str(folder / "a.ckpt"),
        "--checkpoint-every",
        "1",
        *flags,
    ]
    if "--device" not in flags:
        arguments += ["--device", "cpu"]
    assert cli.main(arguments) in (0, 2, 3, 4)


TARGETS = [
    Target("settings", st.dictionaries(st.sampled_from(["dt", *PER_ENVIRONMENT]), VALUES, max_size=3), try_settings),
    Target(
        "quantities", st.tuples(st.sampled_from([*WRITABLE, "impulse"]), VALUES, INDICES, INDICES, vectors(3)), try_set
    ),
    Target("assignments", st.lists(ASSIGNMENT, min_size=1, max_size=2), try_assignments),
    Target("command line", st.lists(FLAG, max_size=3), try_command),
]
