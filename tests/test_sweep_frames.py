"""Results as tables of pyarrow, pandas and polars, and as datasets of xarray, with units and coordinates."""

import itertools
import sys

import numpy as np
import pytest

import warp_rigid as wr

AXES = {"friction": [0.2, 0.4, 0.6], "rolling_friction": [0.0, 0.01], "collision_first": [True, False]}
OPTIONS = {"duration": 0.05, "device": "cpu", "metrics": ["drift", "final_pose", "settle_time"]}


@pytest.fixture(scope="module")
def grid():
    return wr.sweep("incline", AXES, repeats=2, **OPTIONS)


def test_pandas_and_polars_have_every_row_and_the_units(grid):
    frame, other = grid.to_pandas(), grid.to_polars()
    for name in ("run", "friction", "drift", "status"):
        assert frame[name].tolist() == other[name].to_list() == grid.column(name).tolist()
    assert frame.attrs["units"] == grid.units
    assert grid.units["rolling_friction"] == "m" and grid.units["drift"] == "m" and "friction" not in grid.units
    assert grid.to_arrow().field("drift").metadata == {b"unit": b"m"}


MEASURED = """
import warp_rigid as wr

def scene(speed=1.0):
    made = wr.Scene()
    made.add_static(wr.Plane(), surface_velocity=(speed, 0, 0), name="belt")
    made.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1), name="box")
    return made

def outcome(sim):
    x = sim.get("position", bodies=["box"])[:, 0, 0]
    return {"way": (x, "m"), "loss": (x, x > 0, "%"), "gap": (x, "mm"), "count": x > 0}
"""


def test_outcomes_of_scene_files_keep_their_units_in_si(tmp_path):
    """Values of an outcome are in SI units, also those that are shown in mm and %."""
    (tmp_path / "belt.py").write_text(MEASURED)
    axes = {"surface_velocity[belt]": [(0.5, 0, 0), (1, 0, 0)]}
    options = OPTIONS | {"metrics": ["outcome", "final_pose"]}
    found = wr.sweep(tmp_path / "belt.py", axes, output=tmp_path / "t.parquet", **options)
    expected = {"outcome_way": "m", "outcome_gap": "m", "surface_velocity[belt]": "m/s", "final_position": "m"}
    for result in (found, wr.sweep.read(tmp_path / "t.parquet")):
        assert result.units == expected | {"wall_time": "s"}
    assert found.plot(x="run", y="outcome_way").axes[0].get_ylabel() == "outcome_way [m]"


def test_a_grid_has_a_dimension_for_each_axis(grid):
    xarray = pytest.importorskip("xarray", reason="an optional package")
    found = grid.to_xarray()
    assert isinstance(found, xarray.Dataset)
    assert found["drift"].dims == ("friction", "rolling_friction", "collision_first", "repeat")
    assert found["drift"].shape == (3, 2, 2, 2)
    for row in grid.rows:
        place = {name: row[name] for name in AXES} | {"repeat": row["run"] % 2}
        assert found["drift"].sel(place).item() == row["drift"]
        np.testing.assert_array_equal(found["final_position"].sel(place), row["final_position"])
    assert found["drift"].attrs["units"] == "m" and found["rolling_friction"].attrs["units"] == "m"


def test_a_table_from_a_file_has_the_same_dimensions(grid, tmp_path):
    pytest.importorskip("xarray", reason="an optional package")
    grid.to_parquet(tmp_path / "t.parquet")
    assert wr.sweep.read(tmp_path / "t.parquet").to_xarray().identical(grid.to_xarray())


def test_missing_runs_of_a_grid_are_nan(grid):
    pytest.importorskip("xarray", reason="an optional package")
    part = wr.SweepResult(grid.rows[:5], grid.about).to_xarray()
    assert int(np.isfinite(part["drift"]).sum()) == 5
    assert part["status"].shape == (3, 2, 2, 2) and int(part["status"].notnull().sum()) == 5


@pytest.mark.parametrize(
    ("axes", "options"),
    [
        ({"friction": [0.2, 0.4], "rolling_friction": [0.0, 0.01]}, {"design": "zip"}),
        ({"friction": wr.Uniform(0.2, 0.4)}, {"design": "random", "samples": 2}),
        ({"gravity": [(0, 0, -9.81), (0, 0, -1.6)]}, {}),
    ],
)
def test_other_designs_have_the_runs_as_dimension(axes, options):
    pytest.importorskip("xarray", reason="an optional package")
    result = wr.sweep("incline", axes, **options, **OPTIONS)
    found = result.to_xarray()
    assert found["drift"].dims == ("run",) and found["run"].values.tolist() == [0, 1]
    for name, (place, row) in itertools.product(axes, enumerate(result.rows)):
        np.testing.assert_array_equal(found.coords[name][place], row[name])


def test_a_recording_has_time_environments_and_bodies():
    pytest.importorskip("xarray", reason="an optional package")
    sim = wr.Simulator(wr.scenes.load("incline"), num_envs=3, device="cpu")
    recording = wr.record(sim, frames=4, envs=[0, 2], velocities=True)
    found = recording.to_xarray()
    assert found["position"].dims == ("time", "env", "body", "axis")
    np.testing.assert_array_equal(found["position"].sel(env=2, axis="z"), recording.position[:, 1, :, 2])
    np.testing.assert_array_equal(found["orientation"].sel(component="w"), recording.orientation[..., 3])
    assert found["body"].values.tolist() == list(recording.names)
    units = {name: found[name].attrs.get("units") for name in ("time", "position", "linear_velocity")}
    assert units == {"time": "s", "position": "m", "linear_velocity": "m/s"}


@pytest.mark.parametrize(
    ("module", "call"),
    [
        ("pandas", lambda result: result.to_pandas()),
        ("polars", lambda result: result.to_polars()),
        ("xarray", lambda result: result.to_xarray()),
        ("pyarrow", lambda result: result.to_arrow()),
        ("matplotlib", lambda result: result.plot()),
    ],
)
def test_a_missing_package_is_one_line_that_names_the_extra(module, call, grid, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ModuleNotFoundError) as error:
        call(grid)
    assert str(error.value).startswith(f"{module} is not installed; install it with: pip install 'warp-rigid[")
