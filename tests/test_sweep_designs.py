"""Axes and designs of sweeps: notation, counts, draws and addresses."""

import math
import time

import numpy as np
import pytest

from warp_rigid.sweep.axes import Choice, Integers, LogUniform, Normal, Uniform, clean_axes, parse_axis
from warp_rigid.sweep.design import Run, make_points, shard_of, stable_hash


@pytest.mark.parametrize(
    ("text", "name", "values"),
    [
        ("friction=0.1:1.0:10", "friction", [0.1 + 0.1 * i for i in range(10)]),
        ("height=2:10:5", "height", [2, 4, 6, 8, 10]),
        ("height=2:3:3", "height", [2.0, 2.5, 3.0]),
        ("shock-propagation=off,two_pass", "shock_propagation", ["off", "two_pass"]),
        ("warm_starting=true,false", "warm_starting", [True, False]),
        ("gravity=(0,0,-9.81),(0,0,-1.62)", "gravity", [(0, 0, -9.81), (0, 0, -1.62)]),
        ("mass[box_*]=1,2", "mass[box_*]", [1, 2]),
        ("dt=0.01", "dt", [0.01]),
    ],
)
def test_lists_are_read(text, name, values):
    found, read = parse_axis(text)
    assert found == name and read == pytest.approx(values) if isinstance(values[0], float) else read == values
    assert all(type(a) is type(b) for a, b in zip(read, values, strict=True))


@pytest.mark.parametrize(
    ("text", "distribution"),
    [
        ("friction=0.1:1", Uniform(0.1, 1)),
        ("friction=uniform(0.1,1)", Uniform(0.1, 1)),
        ("mass=log_uniform(1,100)", LogUniform(1, 100)),
        ("mass=normal(5, 0.1)", Normal(5, 0.1)),
        ("height=integers(2,9)", Integers(2, 9)),
    ],
)
def test_distributions_are_read(text, distribution):
    assert parse_axis(text)[1] == distribution
    assert parse_axis("mode=choice(off,two_pass)")[1].values == ("off", "two_pass")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("friction", "--vary: must be name=value"),
        ("friction=0.1:1:0", "--vary friction: count: must be a whole number from 1"),
        ("friction=0.1:b:3", "--vary friction: must be low:high:count"),
        ("friction=1:2:3:4", "--vary friction: must be low:high:count"),
        ("friction=uniform(1,0)", "--vary friction: uniform: high: must be"),
        ("friction=uniform(1)", "--vary friction: invalid arguments of uniform"),
        ("friction=normal(0,0)", "deviation: must be"),
        ("mass=log_uniform(0,1)", "low: must be"),
    ],
)
def test_other_forms_are_refused(text, message):
    with pytest.raises(ValueError) as error:
        parse_axis(text)
    assert message in str(error.value)


def test_quantiles_have_closed_forms():
    assert Uniform(2, 4).at(0.25) == pytest.approx(2.5)
    assert LogUniform(1, 100).at(0.5) == pytest.approx(10)
    assert Normal(3, 2).at(0.5) == pytest.approx(3)
    # One standard deviation above the mean lies at Phi(1).
    assert Normal(3, 2).at(0.5 * (1 + math.erf(1 / math.sqrt(2)))) == pytest.approx(5)
    assert [Integers(1, 3).at(q) for q in (0.0, 0.34, 0.99)] == [1, 2, 3]
    assert [Choice("a", "b").at(q) for q in (0.0, 0.49, 0.5, 0.999)] == ["a", "a", "b", "b"]


def test_axes_become_plain_values():
    axes = clean_axes({"a": np.linspace(0, 1, 3), "b": "word", "c": np.array([[0, 1], [2, 3]]), "d": 5})
    assert axes == {"a": [0.0, 0.5, 1.0], "b": ["word"], "c": [(0, 1), (2, 3)], "d": [5]}
    for bad, message in (({"a": []}, "a: must have"), ({"a": [object()]}, "values must be"), ([1], "a mapping")):
        with pytest.raises(ValueError, match=message):
            clean_axes(bad)


def test_a_grid_has_every_combination_once():
    points = make_points({"a": [1, 2], "b": ["x", "y", "z"]}, repeats=2)
    assert len(points) == 12 and len({(p["a"], p["b"], repeat) for p, repeat in points}) == 12
    assert list(points[0][0]) == ["a", "b"]
    assert make_points({}) == [({}, 0)]


def test_a_zip_goes_side_by_side():
    assert make_points({"a": [1, 2], "b": [3, 4]}, "zip") == [({"a": 1, "b": 3}, 0), ({"a": 2, "b": 4}, 0)]
    with pytest.raises(ValueError, match="a has 1, b has 2"):
        make_points({"a": [1], "b": [3, 4]}, "zip")


def test_draws_repeat_by_their_seed_and_differ_between_repeats():
    axes = {"a": [1, 2], "b": Uniform(0, 1)}
    first, again, other = (make_points(axes, repeats=3, seed=seed) for seed in (5, 5, 6))
    assert first == again and first != other
    assert len({p["b"] for p, _ in first}) == 6


def test_a_grid_of_a_single_draw_is_refused():
    with pytest.raises(ValueError, match="axes: the design grid draws a once .* give the number of values"):
        make_points({"a": Uniform(0, 1)})
    assert len(make_points({"a": Uniform(0, 1)}, repeats=3)) == 3
    assert len(make_points({"a": Uniform(0, 1), "b": [1, 2]})) == 2


def test_designs_of_too_many_runs_are_refused_before_they_are_made():
    """10^12 points of a grid would fill the memory."""
    start = time.perf_counter()
    with pytest.raises(ValueError, match="must make at most 10000000 runs, got 1000000000000"):
        make_points({name: list(range(10_000)) for name in "abc"})
    with pytest.raises(ValueError, match="at most 10000000 runs, got 100000000000000"):
        make_points({"a": Uniform(0, 1)}, "random", samples=10**7, repeats=10**7)
    assert time.perf_counter() - start < 1.0


def test_axes_of_no_name_or_uneven_values_are_refused():
    with pytest.raises(ValueError, match="axes: names must be non-empty strings, got ''"):
        clean_axes({"": [1]})
    assert clean_axes({"a": [[1, 2], 3]}) == {"a": [(1, 2), 3]}, "what it is for decides whether it may be"
    with pytest.raises(ValueError, match=r"--vary a: invalid arguments of uniform, got '1\\n,2,3'"):
        parse_axis("a=uniform(1\n,2,3)")


def test_latin_hypercube_fills_every_stratum_once():
    points = make_points({"a": Uniform(0, 1), "b": Uniform(0, 2), "c": ["x", "y"]}, "lhs", samples=10, seed=1)
    for name, width in (("a", 0.1), ("b", 0.2)):
        assert sorted(int(p[name] / width) for p, _ in points) == list(range(10))
    assert sorted(p["c"] for p, _ in points) == ["x"] * 5 + ["y"] * 5


def test_random_points_fill_their_ranges():
    points = make_points({"a": Uniform(2, 4), "b": LogUniform(1, 100)}, "random", samples=4000)
    a, b = (np.array([p[name] for p, _ in points]) for name in "ab")
    # Four standard errors of the means of 4000 draws.
    assert abs(a.mean() - 3) < 4 * (2 / math.sqrt(12)) / math.sqrt(4000)
    assert abs(np.log10(b).mean() - 1) < 4 * (2 / math.sqrt(12)) / math.sqrt(4000)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"design": "star"}, "design: must be one of grid"),
        ({"design": "random"}, "samples: is required by the design random"),
        ({"design": "grid", "samples": 3}, "samples: applies to the designs"),
        ({"repeats": 0}, "repeats: must be"),
        ({"seed": -1}, "seed: must be"),
        ({"repeats": 10_000_000}, "must make at most 10000000 runs, got 20000000"),
    ],
)
def test_contradictions_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_points({"a": [1, 2]}, **arguments)


def test_addresses_tell_values_apart():
    assert stable_hash("a", {"x": 1, "y": 2}) == stable_hash("a", {"y": 2, "x": 1})
    assert len({stable_hash({"x": value}) for value in (1, 1.5, "1", True, None, (1,), 1.0000000000000002)}) == 7


def test_shards_are_disjoint_and_complete():
    runs = [Run(i, str(i), {}, 0) for i in range(10)]
    shards = [shard_of(runs, (i, 3)) for i in (1, 2, 3)]
    assert sorted(run.index for shard in shards for run in shard) == list(range(10))
    assert max(map(len, shards)) - min(map(len, shards)) == 1
    assert shard_of(runs, None) == runs
    for bad in ((0, 3), (4, 3), (1, 0)):
        with pytest.raises(ValueError, match="shard: must be"):
            shard_of(runs, bad)
