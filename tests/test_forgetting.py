"""What a step remembers: a reset, a new life of a body and a saved file give the bits of a fresh start.

Random scenes hold every kind of state. That nothing else is remembered is shown with arrays that are overwritten
between the steps, for every array that is declared.
"""

import os

import numpy as np
import pytest

import warp_rigid as wr
from tests.oracles import random_quaternion, stages_of
from tests.random_scenes import POOL, act, first_difference, heap, random_scene, random_settings, random_shape, shown_by
from warp_rigid.kernels import declare
from warp_rigid.kernels.declare import LAYOUTS, Lifetime

SCENES = int(os.environ.get("FORGETTING_SCENES", "12"))
"""Random scenes of the long tests; `make fuzz` takes 200."""

FEW = pytest.param((1, 2, 6), marks=pytest.mark.short, id="few")
"""Scenes with joints of every kind, drives, paths, a belt, waves, fields and sleep."""
MANY = [
    pytest.param(range(first, min(first + 50, SCENES)), marks=pytest.mark.long, id=f"from {first}")
    for first in range(0, SCENES, 50)
]
NOTHING, ONES = 0x00, 0xFF
"""Bytes of which an overwritten array consists: zeros; or NaN, and -1 as an integer."""


def started(seed, device, **more):
    """A simulator of a random scene with watches, and the generator for what happens to it."""
    rng = np.random.default_rng(seed)
    sim = wr.Simulator(random_scene(rng), settings=random_settings(rng), device=device, **more)
    sim.watch([None, len(sim.scene.bodies) - 3])
    return sim, rng


def live(sim, rng, rounds=8, steps=8):
    """Steps, with an act of a user before each round of them."""
    for step in range(rounds):
        act(sim, step, rng)
        sim.step(steps)


@pytest.mark.parametrize("seeds", [FEW, *MANY])
def test_a_reset_gives_the_bits_of_a_fresh_start(seeds, device):
    """Of all environments, then of one of two, while the other one goes on."""
    for seed in seeds:
        sim, rng = started(seed, device, num_envs=2)
        fresh = shown_by(sim, 40)
        live(sim, rng)
        sim.reset()
        assert len(sim.contacts()) == 0 and sim.time == 0.0
        assert (seed, first_difference(shown_by(sim, 40), fresh)) == (seed, None)
        live(sim, rng)
        sim.reset()
        alone = shown_by(sim, 40, envs=[1])
        live(sim, rng)
        sim.reset(envs=[1])
        assert (seed, first_difference(shown_by(sim, 40, envs=[1]), alone)) == (seed, None)


@pytest.mark.parametrize("seeds", [FEW, *MANY])
def test_a_loaded_simulator_gives_the_bits_of_the_saved_one(seeds, device, tmp_path):
    """Beside it, and from the start after a reset."""
    for seed in seeds:
        sim, rng = started(seed, device)
        sim._world.watches = None  # not stored
        fresh = shown_by(sim, 20)
        live(sim, rng)
        sim.save(tmp_path / "saved.ckpt")
        loaded = wr.Simulator.load(tmp_path / "saved.ckpt", device)
        assert (seed, first_difference(shown_by(loaded, 30), shown_by(sim, 30))) == (seed, None)
        loaded.reset()
        assert (seed, first_difference(shown_by(loaded, 20), fresh)) == (seed, None)


def spawn_all(sim, seed):
    """Spawn the whole pool: beside and above each other."""
    rng = np.random.default_rng(seed)
    for k in range(3):
        place = (*rng.uniform(-0.2, 0.2, 2), 0.15 + 0.2 * k)
        sim.spawn(POOL, place, random_quaternion(rng), rng.normal(0, 1, 3), rng.normal(0, 5, 3))


@pytest.mark.parametrize("seeds", [FEW, *MANY])
def test_a_spawned_body_has_no_former_life(seeds, device):
    """As in a simulator whose bodies have never been active; the second life begins at once, or some steps later."""
    for seed in seeds:
        rng = np.random.default_rng(seed)
        scene = wr.Scene()
        scene.add_static(wr.Plane(), friction=rng.uniform(0.1, 0.9), restitution=0.3)
        scene.add_static(wr.Box((0.2, 0.2, 0.1)), position=(0.1, 0, 0.05), friction=0.5)
        scene.add_pool(random_shape(rng), 3, POOL, friction=0.5, restitution=rng.choice([0.0, 0.6]))
        settings, pause = random_settings(rng), int(rng.integers(2)) * 5
        sim, fresh = (wr.Simulator(scene, settings=settings, device=device) for _ in range(2))
        spawn_all(sim, seed)
        live(sim, rng, steps=12)
        sim.despawn([2, 3, 4])
        sim.step(pause)
        fresh.step(8 * 12 + pause)
        for one in (sim, fresh):
            spawn_all(one, seed + 1)
        shown, expected = ({k: v for k, v in shown_by(one, 40).items() if "warn" not in k} for one in (sim, fresh))
        assert (seed, first_difference(shown, expected)) == (seed, None)


def instances_of(owner, found=None):
    """All structs of declared arrays that an object of the package holds, at any depth."""
    found = {} if found is None else found
    if id(owner) in found:
        return found
    key = getattr(getattr(owner, "_cls", None), "key", None)
    if key in LAYOUTS:
        found[id(owner)] = owner
    elif isinstance(owner, dict | list | tuple):
        found[id(owner)] = None
        for one in owner.values() if isinstance(owner, dict) else owner:
            instances_of(one, found)
    elif type(owner).__module__.startswith("warp_rigid.engine"):
        found[id(owner)] = None
        for one in vars(owner).values():
            instances_of(one, found)
    return found


def structs_of(shard):
    """The structs of declared arrays of a shard."""
    return [one for one in instances_of(shard).values() if one is not None]


def overwrite(array, byte):
    """Fill an array on a CPU, which shares its memory with NumPy."""
    host = array.numpy()
    host.view(np.uint8).fill(byte) if host.flags.c_contiguous else host.fill(byte)


def overwrite_scratch(sim, byte, reused):
    """Overwrite what steps write before they read it; with `reused` also what they can compute again."""
    for shard in sim._world.shards:
        for struct in structs_of(shard):
            for _, _, array in declare.arrays_of(struct, Lifetime.STEP):
                overwrite(array, byte)
            if reused:
                for _, field, array in declare.arrays_of(struct, Lifetime.REUSED):
                    if field.start is None:
                        overwrite(array, byte)
                declare.compute_again(struct)
        if shard.stages.kept is not None:  # a history that a step merges before it replaces the last one
            for _, _, array in declare.arrays_of(shard.stages.kept, Lifetime.REMEMBERED):
                overwrite(array, byte)


def constants_of(sim):
    """What no step may change, as bytes by name; the heights of moving ground are in the pool of shapes."""
    moving = sim._world.layout.sizes["vertices"] > 0
    return {
        f"{struct._cls.key}.{name}": array.numpy().tobytes()
        for shard in sim._world.shards
        for struct in structs_of(shard)
        for name, _, array in declare.arrays_of(struct, Lifetime.SCENE, Lifetime.SETTING)
        if not (moving and struct._cls.key == "Shapes" and name in ("grid_value", "samples"))
    }


def assert_nothing_else_is_remembered(make, steps):
    """The same bits with overwritten arrays; and arrays that no step writes."""
    shown = shown_by(make(), steps)
    for byte in (NOTHING, ONES):
        for reused in (False, True):
            sim = make()
            found, constants = {}, None
            for step in range(steps):
                one = shown_by(sim)
                found |= {name.replace("step 0", f"step {step}"): value for name, value in one.items()}
                constants = constants or constants_of(sim)
                overwrite_scratch(sim, byte, reused)
            assert (byte, reused, first_difference(found, shown)) == (byte, reused, None)
            changed = [name for name, value in constants_of(sim).items() if value != constants[name]]
            assert changed == []


@pytest.mark.parametrize("seeds", [FEW, *MANY])
def test_steps_remember_nothing_but_what_is_declared(seeds):
    for seed in seeds:

        def make(seed=seed):
            sim, rng = started(seed, "cpu")
            act(sim, 0, rng)
            return sim

        assert_nothing_else_is_remembered(make, 24)


@pytest.mark.long
def test_steps_of_a_heap_remember_nothing_but_what_is_declared():
    """Its pairs are found with the grid, and solved in rounds."""
    scene = heap(np.random.default_rng(0))
    settings = wr.Settings(sleeping=True)
    assert_nothing_else_is_remembered(lambda: wr.Simulator(scene, settings=settings, device="cpu"), 8)


def test_every_declared_array_is_found():
    """The tests above overwrite, or compare, each of them; what steps leave is what a reset and `undo` know."""
    found = {}
    for seed in range(6):
        sim, _ = started(seed, "cpu")
        sim.step()
        for shard in sim._world.shards:
            found |= {struct._cls.key: struct for struct in structs_of(shard)}
            kept = {array.ptr for array, _ in shard._kept}
            for struct in structs_of(shard):
                if struct is shard.stages.kept or (struct._cls.key == "SleepState" and not shard.sleeping):
                    continue
                for name, _, array in declare.arrays_of(struct, Lifetime.REMEMBERED):
                    assert array.ptr in kept, f"{struct._cls.key}.{name}"
    assert set(found) == set(LAYOUTS)


def test_a_reset_forgets_a_load_that_was_noted(device):
    """Loads are noted in every step, and reported in the next health check: not that of another life."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1), mass=2e-3)
    scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.3), mass=1e3)
    sim = wr.Simulator(scene, device=device)
    sim.step(32)
    assert stages_of(sim).envs.overloaded.numpy()[0] > 0
    sim.reset()
    sim.set("active", False, bodies=[2])
    sim.step(64)
    assert len(sim.warnings()) == 0
