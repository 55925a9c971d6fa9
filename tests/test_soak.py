"""A short soak: memory, speed and resting bodies stay as they are while a pile changes."""

from benchmarks.soak import pile, soak


def test_a_pile_that_changes_leaves_no_trace(device):
    """The long run is `python -m benchmarks.soak`; this one sees a leak of a few kilobytes a round."""
    found = soak(steps=4000, count=20, envs=2, device=device)
    assert found.failed == 0
    assert found.drift < 1e-3
    assert found.device_growth == 0.0
    assert found.memory_growth < 0.01
    # Another process may take the core for a while: only a plain trend would fail.
    assert found.slowdown < 2.0


def test_the_pile_is_what_it_says():
    names = [body.name for body in pile(100).bodies]
    assert (names.count("loose"), names.count("wall"), names.count("resting")) == (100, 4, 3)
