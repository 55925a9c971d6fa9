"""Parallel execution on the cores: results, exceptions and Ctrl-C."""

import signal
import threading
import time

import pytest

from warp_rigid.engine.cores import spread


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_have_the_order_of_the_parts(threads):
    assert spread(lambda part: part * part, range(20), threads) == [part * part for part in range(20)]


def test_an_exception_of_a_part_reaches_the_caller_when_all_threads_are_idle():
    running = set()

    def work(part):
        running.add(part)
        time.sleep(0.05 * part)
        running.discard(part)
        if part == 1:
            raise ValueError("part 1")

    with pytest.raises(ValueError, match="part 1"):
        spread(work, range(4), 4)
    assert not running


@pytest.mark.parametrize("interruptions", [1, 2, 4])
def test_no_part_runs_after_an_interruption(interruptions):
    """Parts use memory that the caller frees, so Ctrl-C must not leave one behind, however often it is pressed."""
    running = set()

    def work(part):
        running.add(part)
        time.sleep(0.1 if threading.current_thread() is threading.main_thread() else 1.0)
        running.discard(part)

    press = (threading.main_thread().ident, signal.SIGINT)
    timers = [threading.Timer(0.2 * (count + 1), signal.pthread_kill, press) for count in range(interruptions)]
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # the runner of tests may ignore it
    try:
        for timer in timers:
            timer.start()
        with pytest.raises(KeyboardInterrupt):
            spread(work, [0, 1, 2], 3)
    finally:
        signal.signal(signal.SIGINT, before)
    assert not running
