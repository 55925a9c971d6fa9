"""The scenes on the simulator: every variant shows what it must show."""

from functools import cache

import pytest

from warp_rigid import scenes
from warp_rigid.runs.runner import execute, plan_run

SMALL = {
    "bunny_pile": ["bodies=4"],
    "bridge": ["planks=20"],
    "ragdolls": ["dolls=2"],
    "domino_spiral": ["dominoes=30"],
    "wrecking_ball": ["rows=5"],
    "showcase": ["bodies=40"],
    "terrain": ["bodies=6"],
    "carpet": ["bodies=8"],
    "planet": ["bodies=32"],
    "rings_on_poles": ["rings=2"],
    "bone_pile": ["bones=5"],
    "demolition": ["rows=5", "columns=6"],
}
"""What makes the larger scenes quick enough here."""

FPS = 20.0
"""Frames per second: in each frame the deepest overlap is measured, which costs more than its steps."""


@cache
def run(name, device, *assignments):
    """Run all of a demo's variants side by side."""
    return execute(plan_run(scenes.get(name), compare=True, device=device, assignments=assignments, fps=FPS))


def surprises(result):
    """What differs from what the demo expects, in words."""
    found = []
    for verdict in result.summary["verdicts"]:
        rows = zip(result.summary["labels"], verdict["values"], verdict["passed"], verdict["expected"], strict=True)
        for label, value, passed, expected in rows:
            if expected is not None and passed != expected:
                found.append(f"{label}: {verdict['name']} = {value:g}, '{verdict['limit']}' is {passed}")
    return found


MARKS = {"nut_and_bolt": pytest.mark.long}


@pytest.mark.long
@pytest.mark.parametrize("name", [pytest.param(name, marks=MARKS.get(name, ())) for name in scenes.names()])
def test_every_variant_shows_what_it_must(name, device):
    result = run(name, device, *SMALL.get(name, ()))
    assert result.summary["failed"] == result.summary["out_of_bounds"] == []
    assert any(expected for verdict in result.verdicts for expected in verdict.expected.values())
    assert surprises(result) == []


def long(*values):
    """A case of the long tests."""
    return pytest.param(*values, marks=pytest.mark.long)


@pytest.mark.parametrize(
    ("name", "assignment"),
    [
        long("box_stack", "height=5"),
        long("box_stack", "height=14"),
        ("leaning_tower", "offset=0.095"),
        ("leaning_tower", "offset=0.105"),
        ("incline", "friction=0.3"),
        long("plank_launch", "drop=1"),
        long("seesaw", "large_mass=20"),
        long("bunny_pile", "seed=3"),
        ("balance_bird", "droop=-0.05"),
        ("domino_spiral", "lean=4.5"),
        long("nut_and_bolt", "friction=0.2"),
        long("wrecking_ball", "pyramids=1"),
    ],
)
def test_parameters_change_the_outcome_as_they_should(name, assignment, device):
    assert surprises(run(name, device, *SMALL.get(name, ()), assignment)) == []


def test_a_row_of_fallen_dominoes_holds_with_shock_propagation(device):
    result = run("domino_spiral", device, *SMALL["domino_spiral"])
    (deepest,) = (v for v in result.summary["verdicts"] if v["name"] == "deepest")
    assert deepest["values"][result.summary["labels"].index("two_pass")] < 0.005
