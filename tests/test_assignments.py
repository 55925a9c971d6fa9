"""The vocabulary of --set."""

import pytest

from warp_rigid.runs.assignments import parse_assignment, sort_assignments


def build(height: int = 10, friction: float = 0.5, skull: str | None = None):
    """Stands in for a scene's function."""


@pytest.mark.parametrize(
    ("text", "name", "values"),
    [
        ("height=3", "height", [3]),
        ("friction=0.1,0.5", "friction", [0.1, 0.5]),
        ("shock-propagation=off,two_pass", "shock_propagation", ["off", "two_pass"]),
        ("gravity=(0,0,-9.81)", "gravity", [(0, 0, -9.81)]),
        ("gravity=(0,0,-9.81), (0, 0, -1.62)", "gravity", [(0, 0, -9.81), (0, 0, -1.62)]),
        ("warm_starting=True,false", "warm_starting", [True, False]),
        ("skull=some/file.obj", "skull", ["some/file.obj"]),
        ("dt=1e-3", "dt", [0.001]),
    ],
)
def test_values_are_read(text, name, values):
    assert parse_assignment(text) == (name, values)


@pytest.mark.parametrize("text", ["height", "=3", "height=", "height=1,,2", "a b=1"])
def test_other_forms_are_refused(text):
    with pytest.raises(ValueError, match="--set: must be name=value"):
        parse_assignment(text)


def test_names_find_their_places():
    given = sort_assignments(["height=3", "dt=0.001", "restitution=0.2", "warm_starting=true,false", "mass=1,2"], build)
    assert given.scene == {"height": 3}
    assert given.settings == {"dt": 0.001}
    assert given.properties == {"restitution": 0.2}
    assert given.batched == {"warm_starting": [True, False], "mass": [1, 2]}
    assert given.num_envs == 2


def test_numbers_without_brackets_are_one_vector():
    assert sort_assignments(["gravity=0,0,-1.62"], build).properties == {"gravity": (0, 0, -1.62)}
    assert sort_assignments(["orientation[a]=0,0,0,1"], build).properties == {"orientation[a]": (0, 0, 0, 1)}
    field = sort_assignments(["field_acceleration=2,0,0"], build)
    assert field.properties == {"field_acceleration": (2, 0, 0)} and field.num_envs is None
    assert sort_assignments(["gravity=(0,0,-1),(0,0,-2)"], build).batched == {"gravity": [(0, 0, -1), (0, 0, -2)]}
    for text in ("gravity=-9.81", "gravity=0,-9.81", "gravity=(0,0,-1),2", "position=0,0,0,1", "force=x"):
        with pytest.raises(ValueError, match=f"--set {text.partition('=')[0]}: must be vectors of 3 numbers"):
            sort_assignments([text], build)


def test_activity_of_bodies_can_be_assigned():
    assert sort_assignments(["active[box_9]=false"], build).properties == {"active[box_9]": False}


def test_one_value_is_the_scenes_and_a_list_the_environments():
    assert sort_assignments(["friction=0.3"], build).scene == {"friction": 0.3}
    assert sort_assignments(["friction=0.3,0.4"], build).batched == {"friction": [0.3, 0.4]}


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["heihgt=3"], "--set heihgt: unknown name; did you mean height? All names: "),
        (["zzz=3"], "--set zzz: unknown name; all names: height, friction, skull, dt and those in help(Simulator.set)"),
        (["substeps=2"], "--set substeps: unknown name; set dt, the time step [s], or use run --substeps"),
        (["height=3", "height=4"], "--set height: given twice"),
        (["height=3,4"], "--set height: is a scene parameter and takes one value"),
        (["dt=0.01,0.02"], "--set dt: is shared by all environments"),
        (["mass=1,2", "friction=1,2,3"], "mass has 2, friction has 3"),
    ],
)
def test_contradictions_are_named(texts, message):
    with pytest.raises(ValueError) as error:
        sort_assignments(texts, build)
    assert message in str(error.value)
