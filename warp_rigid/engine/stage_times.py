"""Time of each stage of a step, from a recorded step with marks between its stages."""

import time
from collections.abc import Callable
from typing import Any

import warp as wp

from warp_rigid.engine.step import STAGES, Stages, ignore_stage
from warp_rigid.engine.world import World

Measure = Callable[[], list[tuple[str, float]]]
"""Does a step, and returns the stages in their order with the time of each [s]."""


def stage_times(world: World, steps: int) -> dict[str, float]:
    """Seconds that each stage takes in one step; see Simulator.stage_times.

    On the CPU each stage is recorded as a separate graph; on CUDA the step is one graph that contains events.
    """
    seconds: dict[str, float] = {}
    for shard in world.shards:
        measure = _record_on_cuda(shard.stages) if world.device.is_cuda else _record_on_cpu(shard.stages)
        shard.save(attempt=0)
        for name, _ in measure():
            seconds.setdefault(name, 0.0)
        for _ in range(steps):
            for name, taken in measure():
                seconds[name] += taken / steps
        shard.undo(attempt=0)
    return seconds


def walk(stages: Stages, switch: Callable[[str | None], None]) -> None:
    """Do a step; `switch` is called with the name of each stage that begins or continues, and with None at the end.

    A stage that another one calls counts for itself only.
    """
    stages.on_stage = switch
    try:
        stages.step()
    finally:
        stages.on_stage = ignore_stage


def _record_on_cpu(stages: Stages) -> Measure:
    parts: list[tuple[str, Any]] = []
    running: list[str] = []

    def switch(name: str | None) -> None:
        if running:
            parts.append((running.pop(), wp.capture_end(stages.device)))
        if name is not None:
            running.append(name)
            wp.capture_begin(stages.device, force_module_load=False)

    def measure() -> list[tuple[str, float]]:
        measured = []
        for name, graph in parts:
            start = time.process_time()
            wp.capture_launch(graph)
            measured.append((name, time.process_time() - start))
        return measured

    walk(stages, switch)
    return measure


def _record_on_cuda(stages: Stages) -> Measure:
    # No step goes through a stage more than three times.
    most = 6 * len(STAGES)
    events = [wp.Event(stages.device, enable_timing=True) for _ in range(most)]
    names: list[str | None] = []

    def switch(name: str | None) -> None:
        stages.device.stream.record_event(events[len(names)])
        names.append(name)

    with wp.ScopedCapture(stages.device, force_module_load=False) as capture:
        walk(stages, switch)

    def measure() -> list[tuple[str, float]]:
        wp.capture_launch(capture.graph)
        spans = zip(names, events, events[1:], strict=False)
        return [(name, 1e-3 * wp.get_event_elapsed_time(a, b)) for name, a, b in spans if name is not None]

    return measure
