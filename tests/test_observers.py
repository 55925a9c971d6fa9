"""Observers and time series of sweeps: ready-made ones against closed forms, those of users, and what is lost."""

import numpy as np
import pytest
import zarr

import warp_rigid as wr
from warp_rigid.commands import cli
from warp_rigid.sweep import read, read_series
from warp_rigid.sweep.table import ResultFile

GRAVITY = 9.81


def drop(height: float = 0.2, restitution: float = 0.5, boxes: int = 0):
    """A ball above the ground, and boxes that rest some way off."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), restitution=1.0, name="ground")
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 0.1 + height), mass=2.0, restitution=restitution, name="ball")
    for i in range(boxes):
        scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(2 + i, 0, 0.1), name=f"box_{i}")
    return scene


def quick(axes, **more):
    return wr.sweep(drop, axes, **{"duration": 0.5, "fps": 20, "metrics": ["drift"], "device": "cpu", **more})


def test_ready_made_observers():
    names = ["peak_impulse[ball,ground]", "first_contact[ball]", "impacts[ball]", "energy[ball]", "rest_time[box_0]"]
    result = quick({"height": [0.1, 0.3], "boxes": [0, 1]}, observe=names)
    assert not result.failed
    for row in result.rows:
        speed = np.sqrt(2 * GRAVITY * row["height"])
        assert row["peak_impulse[ball,ground]"] == pytest.approx(2.0 * 1.5 * speed, abs=3 * 2.0 * GRAVITY / 240)
        assert row["first_contact[ball]"] == pytest.approx(speed / GRAVITY, abs=3 / 240)
        assert row["energy[ball]"] < 2.0 * GRAVITY * (row["height"] + 0.1)
        assert row["rest_time[box_0]"] == 0.0  # a box that rests from the start, or none
    # From 0.3 m the ball arrives after 0.247 s and, with half its speed, again after as long.
    assert [row["impacts[ball]"] for row in result.rows][2:] == [2, 2]


def test_rows_with_observers_do_not_depend_on_the_batch():
    options = {"observe": ["peak_impulse", "summed_impulse[ball]", "impacts", "energy", "position[ball]"]}
    axes = {"boxes": [0, 2], "height": [0.1, 0.2]}
    rows = [quick(axes, batch=size, **options).rows for size in (1, 3, "auto")]
    for other in rows[1:]:
        for row, same in zip(rows[0], other, strict=True):
            assert {key: row[key] for key in options["observe"]} == {key: same[key] for key in options["observe"]}


def height_on_device(sim):
    """The ball's height in every environment, from the device array of all bodies."""
    return sim.array("position").numpy()[sim.first_body[:-1] + 1, 2]


class Highest:
    """The largest height of the ball at any look."""

    def __init__(self, sim):
        self.height = np.zeros(sim.num_envs)

    def __call__(self, sim):
        self.height = np.maximum(self.height, height_on_device(sim))
        return self.height


def test_functions_and_classes_of_the_user():
    result = quick({"height": [0.1, 0.3]}, observe=[height_on_device, Highest], series=["height_on_device", "impacts"])
    series = result.series()
    assert series.column_names == ["run", "time", "height_on_device", "impacts"]
    height = series["height_on_device"].to_numpy().reshape(2, -1)
    assert height.shape == (2, 11) and series["time"].to_numpy()[:11] == pytest.approx(0.05 * np.arange(11))
    np.testing.assert_array_equal(series["run"].to_numpy(), np.repeat([0, 1], 11))
    np.testing.assert_allclose(height[:, 0], [0.2, 0.4], rtol=1e-6)
    time = 0.05 * np.arange(3)
    np.testing.assert_allclose(height[1, :3], 0.4 - 0.5 * GRAVITY * time**2, atol=GRAVITY * 0.1 / 240)
    for row, own in zip(result.rows, height, strict=True):
        assert row["height_on_device"] == own[-1] and row["Highest"] == own.max()


def height(sim):
    """Has the name of a parameter."""


def drift(sim):
    """Has the name of a metric."""


def status(sim):
    """Has the name of a standard column."""


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"observe": ["speed"]},
            "observe: must be functions, .py files, names, .* got 'speed'; all names: peak_impulse, ",
        ),
        ({"observe": ["peak_impulse[a,b,c]"]}, "observe: must be functions"),
        ({"observe": ["peak_impulse[a,a]"]}, "observe: must be functions"),
        ({"observe": ["peak_impulse[lid]"]}, "peak_impulse\\[lid\\]: no scene has the bodies lid"),
        ({"observe": ["energy", "energy"]}, "observe: energy is given twice"),
        ({"observe": 3}, "observe: must be functions, .* got 3"),
        ({"observe": ["peak_impulse[ball"]}, "observe: must be functions, .* got 'peak_impulse\\[ball'"),
        ({"observe": [height]}, "observer height: is also the name of a parameter"),
        ({"observe": [drift]}, "observer drift: is also the name of a metric"),
        ({"observe": [status]}, "observer status: is also the name of a standard column"),
        ({"metrics": [height]}, "metric height: is also the name of a parameter"),
        ({"metrics": 3}, "metrics: must be functions, .py files or names, got 3"),
        ({"series": 3}, "series: must be functions, .* got 3"),
        ({"workers": 2}, "workers: applies to cluster local only"),
        ({"series": ["position"]}, "series: must be functions"),
        ({"series": [height_on_device]}, "series: must be names, with their functions in observe"),
    ],
)
def test_bad_observers_are_named_before_any_run(options, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        quick({"height": [0.1]}, **options)


def wrong_shape(sim):
    return np.zeros(3)


def fails_late(sim):
    if sim.time > 0.2:
        raise RuntimeError("no more\nof this")
    return np.zeros(sim.num_envs)


def test_an_observer_that_fails_loses_nothing_else(caplog):
    result = quick({"height": [0.1, 0.3]}, observe=[fails_late, "impacts"], series=["fails_late", "energy"])
    assert [row["status"] for row in result.rows] == ["error"] * 2
    for row in result.rows:
        line = fails_late.__code__.co_firstlineno + 2
        assert row["reason"] == f"observer fails_late: tests/test_observers.py:{line}: RuntimeError: no more of this"
        assert row["fails_late"] is None and row["drift"] > 0.0 and row["impacts"] >= 1
    series = result.series().to_pandas()
    assert np.isfinite(series["energy"]).all()
    assert np.isfinite(series["fails_late"][series["time"] < 0.2]).all()
    assert series["fails_late"][series["time"] > 0.21].isna().all()
    result = quick({"height": [0.1, 0.3]}, observe=[wrong_shape])
    reason = "must return (2,) or (2, n) numbers, got shape (3,) of float64"
    line = wrong_shape.__code__.co_firstlineno
    for row in result.rows:
        assert row["reason"] == f"observer wrong_shape: tests/test_observers.py:{line}: {reason}"
        assert row["wrong_shape"] is None and row["drift"] > 0.0


def test_a_metric_and_an_observer_of_the_same_quantity_share_a_column():
    (row,) = quick(
        {"height": [0.1]}, metrics=["kinetic_energy"], observe=["kinetic_energy", "energy"], duration=0.1
    ).rows
    assert 0.0 < row["kinetic_energy"] < row["energy"]


def test_series_on_disk_survive_an_interruption(tmp_path, monkeypatch):
    """Rows and series of finished batches stay; the others are run again, and each look is there once."""
    axes = {"height": np.linspace(0.05, 0.3, 6)}
    options = {"series": ["kinetic_energy", "peak_impulse[ball]"], "batch": 2}
    whole = quick(axes, **options).series()
    path = tmp_path / "t.parquet"

    def interrupted(self, rows, add=ResultFile.add):
        if len(self.rows) >= 2:
            raise KeyboardInterrupt
        add(self, rows)

    with monkeypatch.context() as patch:
        patch.setattr(ResultFile, "add", interrupted)
        with pytest.raises(KeyboardInterrupt):
            quick(axes, output=path, **options)
    assert len(list((tmp_path / "t.series").glob("*.parquet"))) == 2
    result = quick(axes, output=path, resume=True, **options)
    assert result.series().equals(whole) and wr.sweep.read_series(tmp_path / "t.series").equals(whole)
    assert read(path).series().equals(whole)
    quick({"height": [0.1]}, output=path, overwrite=True, **options)
    assert set(read_series(tmp_path / "t.series")["run"].to_pylist()) == {0}
    quick({"height": [0.1]}, output=path, overwrite=True)
    with pytest.raises(ValueError, match="^series: "):
        read(path).series()


def test_series_in_zarr_are_those_in_parquet(tmp_path, monkeypatch):
    """Also with time steps that have other samples, with vectors, and after an interruption."""
    axes = {"height": np.linspace(0.05, 0.3, 5), "dt": [1 / 240, 1 / 100]}
    options = {"series": ["kinetic_energy", "position[ball]", "impacts"], "batch": 2}
    whole = quick(axes, **options).series().to_pandas()
    path, folder = tmp_path / "t.parquet", tmp_path / "s.zarr"
    options |= {"output": path, "series_output": folder}

    def interrupted(self, rows, add=ResultFile.add):
        if len(self.rows) >= 4:
            raise KeyboardInterrupt
        add(self, rows)

    with monkeypatch.context() as patch:
        patch.setattr(ResultFile, "add", interrupted)
        with pytest.raises(KeyboardInterrupt):
            quick(axes, **options)
    assert set(read_series(folder)["run"].to_pylist()) > {row["run"] for row in read(path).rows}
    result = quick(axes, resume=True, **options)
    for series in (result.series(), read_series(folder)):
        found = series.to_pandas()
        for name in ("run", "time", "kinetic_energy", "impacts"):
            np.testing.assert_array_equal(found[name], whole[name])
        np.testing.assert_array_equal(np.stack(found["position[ball]"]), np.stack(whole["position[ball]"]))
    root = zarr.open_group(folder, mode="r")
    assert root["position[ball]"].shape == (10, 11, 3) and root["time"].shape == (10, 11)
    assert not (tmp_path / "t.series").exists()
    more = {**axes, "height": np.linspace(0.05, 0.3, 9)}
    with pytest.raises(ValueError, match="s.zarr: already exists; resume=True .* overwrite=True"):
        quick(more, **options | {"output": tmp_path / "u.parquet"})
    with pytest.raises(ValueError, match="s.zarr: holds the series of a different sweep"):
        quick(axes, **options | {"output": None, "duration": 0.25, "resume": True})
    quick({"height": [0.1]}, overwrite=True, **options)
    assert read_series(folder).num_rows == 11


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"series": ["energy"], "series_output": "s.h5"}, "series_output: must end in .zarr, got s.h5"),
        ({"series_output": "s.zarr"}, "series_output: requires series"),
        ({"resume": True}, "resume: requires output, trajectories or series_output"),
        ({"overwrite": True, "series": ["energy"]}, "overwrite: requires output, trajectories or series_output"),
    ],
)
def test_bad_outputs_are_named(options, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        quick({"height": [0.1]}, **options)


def test_the_command_observes(tmp_path, capsys):
    scene, mine = tmp_path / "ball.py", tmp_path / "mine.py"
    scene.write_text(
        "import warp_rigid as wr\n\n\ndef scene(height: float = 1.0):\n    scene = wr.Scene()\n"
        "    scene.add_static(wr.Plane(), name='ground')\n"
        "    scene.add_body(wr.Sphere(0.1), position=(0, 0, height), name='ball')\n    return scene\n"
    )
    mine.write_text("import numpy as np\n\n\ndef twice(sim):\n    return 2.0 * sim.get('position')[:, 1, 2]\n")
    table = tmp_path / "t.parquet"
    command = [
        "sweep",
        str(scene),
        "--vary",
        "height=0.2,0.4",
        "--duration",
        "0.25",
        "--device",
        "cpu",
        "-o",
        str(table),
    ]
    observe = ["--observe", f"peak_impulse[ball,ground],{mine}", "--series", "energy", "--metrics", "drift"]
    zarr_folder = tmp_path / "s.zarr"
    assert cli.main([*command, *observe]) == 0
    out, err = capsys.readouterr()
    assert err.splitlines()[-1].startswith("time: ") and f"wrote {table}" in out
    assert cli.main([*command, *observe, "--overwrite", "--series-output", str(zarr_folder)]) == 0
    assert f"wrote {zarr_folder}" in capsys.readouterr().out
    rows = read(table).rows
    assert all(row["peak_impulse[ball,ground]"] > 0.0 and 0.1 < row["twice"] < 0.9 for row in rows)
    assert read_series(tmp_path / "t.series").num_rows == read_series(zarr_folder).num_rows == 4
