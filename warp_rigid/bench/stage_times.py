"""What each stage of a step takes: the step recorded as one graph a stage instead of one in all."""

import time
from collections.abc import Callable
from typing import Any

import warp as wp

from warp_rigid.simulator import Simulator
from warp_rigid.stages import Stages

STAGES = (
    "raise_surfaces",
    "predict",
    "wake_changed",
    "find_pairs",
    "find_contacts",
    "build_graph",
    "accelerate",
    "carry_contacts",
    "collide",
    "solve_contacts",
    "propagate_shock",
    "push_out",
    "follow",
    "move",
    "fall_asleep",
    "remember",
)
"""Methods of `Stages` that are told apart; one that another calls counts for itself only."""


def stage_times(sim: Simulator, steps: int) -> dict[str, float]:
    """Seconds that each stage takes in one step of all environments, in the present state.

    The steps are undone. On the CPU these are seconds of the processor, which other programs do not stretch; on CUDA
    events are recorded between the graphs, and the host waits only at the end of each step.

    Args:
        sim: the simulator.
        steps: to average over, at least 1.

    Returns:
        Stages by name, in their order.
    """
    parts = _record(sim._stages)
    seconds = dict.fromkeys((name for name, _ in parts), 0.0)
    measure = _measure_on_cuda if sim.device.is_cuda else _measure_on_cpu
    sim._save()
    for _ in range(steps):
        for (name, _), taken in zip(parts, measure(parts, sim.device), strict=True):
            seconds[name] += taken / steps
    sim._pools.shortage()
    sim._pools.forget_shortage()
    sim._restore()
    return seconds


def _record(stages: Stages) -> list[tuple[str, Any]]:
    """The step as a list of graphs and the stages to which they belong."""
    parts: list[tuple[str, Any]] = []
    entered: list[str] = []

    def begin() -> None:
        wp.capture_begin(stages.device, force_module_load=False)

    def end() -> None:
        parts.append((entered[-1], wp.capture_end(stages.device)))

    def watched(name: str, stage: Callable) -> Callable:
        def run(*given: Any, **named: Any) -> None:
            if entered:
                end()
            entered.append(name)
            begin()
            stage(*given, **named)
            end()
            entered.pop()
            if entered:
                begin()

        return run

    for name in STAGES:
        setattr(stages, name, watched(name, getattr(stages, name)))
    try:
        stages.step()
    finally:
        for name in STAGES:
            delattr(stages, name)
    return parts


def _measure_on_cpu(parts: list[tuple[str, Any]], device: Any) -> list[float]:
    seconds = []
    for _, graph in parts:
        start = time.process_time()
        wp.capture_launch(graph)
        seconds.append(time.process_time() - start)
    return seconds


def _measure_on_cuda(parts: list[tuple[str, Any]], device: Any) -> list[float]:
    with wp.ScopedDevice(device):
        marks = [wp.Event(device, enable_timing=True) for _ in range(len(parts) + 1)]
        wp.record_event(marks[0])
        for (_, graph), mark in zip(parts, marks[1:], strict=True):
            wp.capture_launch(graph)
            wp.record_event(mark)
        return [1e-3 * wp.get_event_elapsed_time(a, b) for a, b in zip(marks, marks[1:], strict=False)]
