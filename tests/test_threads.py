"""Simulators and meshes in several threads: the same bits as one after another."""

import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import trimesh
import warp as wp

import warp_rigid as wr
from tests.test_trust import bits, heap
from warp_rigid import threads
from warp_rigid.scene.shapes import distance_grid


def run(size):
    """A heap of so many boxes whose pools grow, looked at and changed between the steps."""
    sim = wr.Simulator(heap(size), num_envs=2, device="cpu", capacity={"pairs": 8, "contacts": 8})
    for _ in range(3):
        sim.step(8)
        sim.penetration()
        sim.set("friction", 0.3, envs=[0])
        sim.apply_impulse((0.1, 0, 0), (0, 0, 0), 1)
    sim.set("sleeping", True)
    sim.step(8)
    sim.reset([1])
    sim.step(4)
    return bits(sim), sim.contacts().tobytes()


def at_once(work, arguments):
    """Results of a function for several arguments, each in a thread of its own."""
    start = threading.Barrier(len(arguments))

    def one(argument):
        start.wait(10)
        return work(argument)

    with ThreadPoolExecutor(len(arguments)) as pool:
        return [job.result(120) for job in [pool.submit(one, argument) for argument in arguments]]


@pytest.mark.long
def test_simulators_in_threads_give_the_same_bits():
    sizes = [9, 12, 18, 27]
    alone = [run(size) for size in sizes]
    assert at_once(run, sizes) == alone


def test_meshes_are_baked_beside_simulators(tmp_path, monkeypatch):
    """A grid that is computed while a step is recorded is not a part of that step."""
    monkeypatch.setenv("WARP_RIGID_CACHE", str(tmp_path))

    def bake(radius):
        ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
        mesh = wr.Mesh(ball.vertices, ball.faces, 24)
        return mesh.signed_distance(np.array([[0.0, 0.0, 2.0 * radius], [0.0, 0.0, 0.0]]))[0].tolist()

    def either(argument):
        return run(argument) if isinstance(argument, int) else bake(argument)

    arguments = [9, 0.3, 12, 0.5]
    alone = [either(argument) for argument in arguments]
    for file in tmp_path.iterdir():
        file.unlink()
    assert at_once(either, arguments) == alone


def test_one_simulator_can_be_used_by_several_threads():
    """Its calls are executed one after another."""
    shared, alone = (wr.Simulator(heap(12), device="cpu") for _ in range(2))

    def step(_):
        for _ in range(10):
            shared.step(2)
            shared.get("position")
            shared.contacts()

    at_once(step, [0, 1, 2])
    alone.step(60)
    assert bits(shared) == bits(alone) and shared.time == alone.time


def test_a_process_forked_while_a_step_is_recorded_can_simulate():
    expected = run(9)
    busy, done = threading.Event(), threading.Event()

    def hold():
        with threads.exclusive():
            busy.set()
            done.wait(60)

    holder = threading.Thread(target=hold)
    holder.start()
    busy.wait(10)
    child = os.fork()
    if child == 0:
        os._exit(0 if run(9) == expected else 1)
    try:
        deadline = time.monotonic() + 60
        while not (found := os.waitpid(child, os.WNOHANG))[0] and time.monotonic() < deadline:
            time.sleep(0.05)
        assert found == (child, 0)
    finally:
        done.set()
        holder.join()


def test_exclusive_use_waits_for_others_and_can_be_nested():
    gate, order = threads._Gate(), []
    shared, finish = threading.Event(), threading.Event()

    def share():
        with gate.shared(), gate.shared():
            shared.set()
            finish.wait(10)
            order.append("shared")

    def alone():
        with gate.shared(), gate.exclusive(), gate.shared(), gate.exclusive():
            order.append("exclusive")

    workers = [threading.Thread(target=share), threading.Thread(target=alone)]
    workers[0].start()
    shared.wait(10)
    workers[1].start()
    time.sleep(0.05)
    assert order == []
    finish.set()
    [worker.join(10) for worker in workers]
    assert order == ["shared", "exclusive"]
    with gate.exclusive():
        pass


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a GPU")
def test_simulators_on_streams_of_their_own_give_the_same_bits():
    def on_a_stream(size):
        with wp.ScopedStream(wp.Stream("cuda:0")):
            sim = wr.Simulator(heap(size), num_envs=4, device="cuda:0", capacity={"pairs": 8, "contacts": 8})
            for _ in range(6):
                sim.step(8)
            return bits(sim)

    sizes = [9, 12, 18, 27]
    assert at_once(on_a_stream, sizes) == [on_a_stream(size) for size in sizes]


def test_a_grid_cache_is_shared_by_threads(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_RIGID_CACHE", str(tmp_path))
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    grids = at_once(lambda _: distance_grid.grid_of_mesh(vertices, faces, 16, True).values.tobytes(), [0, 1, 2])
    assert len(set(grids)) == 1
