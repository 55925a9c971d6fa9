"""Messages about unknown names: the nearest names first, then where all names are, on one line."""

import re

import pytest

import warp_rigid as wr
from warp_rigid.bench.cases import find_case
from warp_rigid.engine import quantities
from warp_rigid.runs.assignments import sort_assignments
from warp_rigid.runs.runner import find_scene
from warp_rigid.sweep.metrics import check_metrics, check_observers
from warp_rigid.sweep.table import SweepResult
from warp_rigid.validation import suite


@pytest.fixture(scope="module")
def sim():
    scene = wr.Scene()
    scene.add_body(wr.Sphere(0.1))
    return wr.Simulator(scene, device="cpu")


@pytest.mark.parametrize(
    ("call", "nearest", "where"),
    [
        (lambda sim: sim.get("velocty"), "linear_velocity", "help(Simulator.get)"),
        (lambda sim: sim.set("frictoin", 0.5), "friction", "help(Simulator.set)"),
        (lambda sim: sim.array("postion"), "position", "position, orientation, "),
        (lambda sim: wr.scenes.load("box_stak"), "box_stack", "warp-rigid scenes"),
        (lambda sim: find_scene("box_stak"), "box_stack", "warp-rigid scenes"),
        (lambda sim: find_case("pile_boks:3"), "pile_box", "stack, pile_box, "),
        (lambda sim: check_metrics(["drft"]), "drift", "top_height, "),
        (lambda sim: check_observers(["peak_impuls[ball]"]), "peak_impulse", "peak_impulse, "),
        (lambda sim: check_observers(["velocty[ball]"]), "linear_velocity", "peak_impulse, "),
        (lambda sim: SweepResult([{"heigth": 1.0, "run": 0}], {}).column("height"), "heigth", "result.names"),
        (lambda sim: suite.choose(suite.all_cases(), ["V1000"]), "V100", "V01 to V110"),
        (
            lambda sim: sort_assignments(["contact_iteration=3"], lambda height: None),
            "contact_iterations",
            "height, dt",
        ),
        (lambda sim: sort_assignments(["mas[ball]=3"], lambda height: None), "mass", "help(Simulator.set)"),
    ],
)
def test_unknown_names_are_followed_by_the_nearest(sim, call, nearest, where):
    with pytest.raises(ValueError, match=r"did you mean [\w ]*\?") as refusal:
        call(sim)
    message = str(refusal.value)
    guesses, _, place = message.partition("did you mean ")[2].partition("? All names: ")
    assert nearest in guesses.split(" or ") and place.startswith(where)
    assert "\n" not in message and len(message) < 400


def test_a_colour_given_with_a_body_is_told_where_it_belongs():
    with pytest.raises(TypeError, match=r"'color'; set it with scene.looks\[index\] = Look\(\(red, green, blue\)\)$"):
        wr.Scene().add_body(wr.Sphere(0.1), color=(1, 0, 0))


def test_a_known_observer_with_wrong_bodies_is_not_suggested():
    with pytest.raises(ValueError, match=r"got 'peak_impulse\[a,b,c\]'$"):
        check_observers(["peak_impulse[a,b,c]"])


@pytest.mark.parametrize(("method", "names"), [("get", quantities.READABLE), ("set", quantities.SETTABLE)])
def test_the_help_has_all_names(method, names):
    text = wr.Simulator.set.__doc__ + (wr.Simulator.get.__doc__ if method == "get" else "")
    assert set(names) <= set(re.findall(r'"(\w+)"', text))
