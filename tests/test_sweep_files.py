"""Tables on disk: nothing is lost, nothing is mixed, and others can read them."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas
import polars
import pyarrow
import pyarrow.parquet
import pytest
import zarr

import warp_rigid as wr
from tests.test_sweep import ball, quick, values
from warp_rigid.sweep import batch_run as batch_module
from warp_rigid.sweep import execution, merge, read, read_series
from warp_rigid.sweep import table as table_module
from warp_rigid.sweep.table import SweepResult, write

ROOT = Path(__file__).resolve().parents[1]
AXES = {"height": [0.1, 0.5, 0.9], "friction": [0.2, 0.8]}


@pytest.fixture
def runs_done(monkeypatch):
    """How many runs each batch had."""
    sizes, inner = [], batch_module._run
    monkeypatch.setattr(
        batch_module, "_run", lambda job, made, *rest: sizes.append(len(made.runs)) or inner(job, made, *rest)
    )
    return sizes


def test_tables_are_read_by_all(tmp_path):
    axes = {"height": [1.0, 2.0], "gravity": [(0, 0, -1), (0, 0, -2)], "warm_starting": [True, False]}
    result = quick(axes, metrics=["drift", "final_pose", "settle_time"], output=tmp_path / "t.parquet")
    back = read(tmp_path / "t.parquet")
    assert back.about == json.loads(json.dumps(result.about)) and back.names == result.names
    for frame in (pandas.read_parquet(tmp_path / "t.parquet"), result.to_pandas()):
        assert len(frame) == 8 and frame["settle_time"].isna().all()
        assert frame["warm_starting"].tolist() == [True, False] * 4
        assert frame["final_position"][3].tolist() == result.rows[3]["final_position"]
    frame = polars.read_parquet(tmp_path / "t.parquet")
    assert frame["drift"].to_list() == result.column("drift").tolist()
    assert frame["gravity"].to_list() == [list(row["gravity"]) for row in result.rows]
    assert back.replay(back.rows[0], ball, "cpu").get("position")[0, 1].tolist() == [0, 0, 1]


def test_what_made_the_table_is_told_beside_it(tmp_path, monkeypatch):
    """The commit is that of git, which is asked here without a limit on its time."""
    asked = []
    monkeypatch.setattr(execution, "_commit", execution._commit.__wrapped__)
    monkeypatch.setattr(execution, "git", lambda *arguments: asked.append(arguments) or "0123-dirty")
    quick(AXES, output=tmp_path / "t.parquet", seed=4, command=["warp-rigid", "sweep"], fixed={"mass": 2.0})
    about = json.loads((tmp_path / "t.parquet.json").read_text())
    assert about["version"] == wr.__version__ and set(about["versions"]) == {"python", "warp", "numpy"}
    assert about["design"]["axes"] == AXES and about["design"]["seed"] == 4
    assert about["command"] == ["warp-rigid", "sweep"] and about["fixed"] == {"mass": 2.0}
    assert about["commit"] == "0123-dirty"
    commands = (["git", *asked[0]], ["git", "rev-parse", "HEAD"])
    told = [subprocess.run(each, cwd=ROOT, capture_output=True, text=True).stdout.strip() for each in commands]
    assert told[0].removesuffix("-dirty") == told[1]
    assert about["state"] == "finished" and about["runs"] == 6


def test_resuming_runs_what_is_missing_and_what_failed(tmp_path, runs_done):
    path = tmp_path / "t.parquet"
    whole = values(quick(AXES))
    runs_done.clear()
    first = quick(AXES, shard=(1, 3))
    broken = [first.rows[0] | {"status": "error", "reason": "lost", "drift": None}, first.rows[1]]
    about = first.about | {"shard": None}
    write(SweepResult(broken, about), path)
    runs_done.clear()
    assert values(quick(AXES, output=path, resume=True)) == whole
    assert sum(runs_done) == 5
    runs_done.clear()
    assert values(quick(AXES, output=path, resume=True)) == whole and runs_done == []
    # A larger design keeps the rows of the smaller one and numbers them anew.
    wider = quick({"height": [0.05, 0.1, 0.5, 0.9], "friction": [0.2, 0.8]}, output=path, resume=True)
    assert sum(runs_done) == 2 and wider.column("run").tolist() == list(range(8))
    assert [row["drift"] for row in wider.rows[2:]] == [row["drift"] for row in whole]


def test_other_sweeps_are_not_mixed(tmp_path, runs_done):
    path = tmp_path / "t.parquet"
    quick(AXES, output=path)
    before, _ = path.read_bytes(), runs_done.clear()
    for options, message in (
        ({}, "already exists; resume=True .* overwrite=True"),
        ({"resume": True, "duration": 0.2}, "holds a different sweep: duration is 0.1 there, 0.2 here"),
        ({"resume": True, "fixed": {"mass": 2.0}}, "holds a different sweep: fixed"),
        ({"resume": True, "metrics": ["drift"]}, "holds a different sweep: metrics"),
    ):
        with pytest.raises(ValueError, match=message):
            quick(AXES, output=path, **options)
    with pytest.raises(ValueError, match="holds 4 runs of a different design"):
        quick({"height": [0.1], "friction": [0.2, 0.8]}, output=path, resume=True)
    (tmp_path / "no.parquet").write_text("nothing")
    with pytest.raises(ValueError, match="not a table of a sweep"):
        quick(AXES, output=tmp_path / "no.parquet", resume=True)
    assert path.read_bytes() == before and runs_done == []
    assert len(quick({"height": [0.1]}, output=path, overwrite=True)) == 1


def test_a_name_with_no_room_for_that_of_the_metadata_is_refused_before_any_run(tmp_path, runs_done):
    """A name has at most 255 bytes; the metadata lie in NAME.json."""
    longest = 255 - len(".parquet.json")
    with pytest.raises(OSError, match=r"File name too long: .*\.parquet\.json"):
        quick(AXES, output=tmp_path / ("a" * (longest + 1) + ".parquet"))
    assert runs_done == [] and list(tmp_path.iterdir()) == []
    quick({"height": [0.1]}, output=tmp_path / ("a" * longest + ".parquet"))
    assert len(list(tmp_path.iterdir())) == 2


def test_an_error_in_the_caller_keeps_what_is_done(tmp_path):
    def stop(done, total):
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        quick(AXES, output=tmp_path / "t.parquet", batch=2, on_progress=stop)
    kept = read(tmp_path / "t.parquet")
    assert len(kept) == 4 and kept.about["state"] == "interrupted"


def test_series_are_read_where_a_killed_process_left_half_a_file(tmp_path):
    rows = pyarrow.table({"run": [1, 0], "time": [0.0, 0.0], "drift": [2.0, 3.0]})
    pyarrow.parquet.write_table(rows, tmp_path / "a.parquet")
    (tmp_path / ".b.0123456789abcdef.parquet").write_bytes(b"PAR1")
    assert read_series(tmp_path)["drift"].to_pylist() == [3.0, 2.0]


@pytest.mark.long
def test_killed_processes_leave_a_table_to_resume(tmp_path):
    """Killed while it runs: the file is readable, and in the end equals an undisturbed one."""
    (tmp_path / "script.py").write_text(
        "import sys, time\nimport warp_rigid as wr\nfrom tests.test_sweep import ball\n"
        "heights = [0.1 + 0.01 * i for i in range(40)]\n"
        "wr.sweep(ball, {'height': heights}, duration=1.0, device='cpu', batch=1, output=sys.argv[1], resume=True,\n"
        "         on_progress=lambda *_: time.sleep(0.1))\n"
    )
    path = tmp_path / "t.parquet"
    command = [sys.executable, str(tmp_path / "script.py"), str(path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    until = time.monotonic() + 60.0
    while process.poll() is None and time.monotonic() < until:
        if path.exists() and pyarrow.parquet.read_metadata(path).num_rows >= 3:
            break
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, process.stderr.read().decode()
    table = read(path)
    assert 3 <= len(table) < 40 and not table.failed
    axes = {"height": [0.1 + 0.01 * i for i in range(40)]}
    result = wr.sweep(ball, axes, duration=1.0, device="cpu", output=path, resume=True)
    assert values(result) == values(wr.sweep(ball, axes, duration=1.0, device="cpu"))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["script.py", "t.parquet", "t.parquet.json"]


def test_shards_merge_to_the_whole(tmp_path):
    paths = [tmp_path / f"{i}.parquet" for i in (1, 2, 3)]
    for i, path in enumerate(paths, 1):
        quick(AXES, shard=(i, 3), output=path)
    merged = merge(paths)
    assert values(merged) == values(quick(AXES)) and merged.about["runs"] == 6
    assert len(merge(paths[:2])) == 4
    quick({"height": [0.1]}, output=tmp_path / "other.parquet")
    with pytest.raises(ValueError, match="other.parquet: holds a shard of a different design"):
        merge([paths[0], tmp_path / "other.parquet"])
    with pytest.raises(FileNotFoundError):
        merge([tmp_path / "none.parquet"])
    # Of two rows of one run the finished one counts, whichever file comes first.
    lost = read(paths[0])
    lost.rows[0] |= {"status": "error", "reason": "lost"}
    lost.to_parquet(tmp_path / "lost.parquet")
    for files in ([tmp_path / "lost.parquet", *paths], [*paths, tmp_path / "lost.parquet"]):
        assert not merge(files).failed


def test_trajectories_lie_beside_the_rows(tmp_path):
    path = tmp_path / "t.zarr"
    axes = {"height": [1.0, 2.0], "count": [1, 2]}
    options = {"metrics": ["final_pose"], "trajectories": path, "output": tmp_path / "t.parquet", "fps": 60}
    with pytest.raises(KeyboardInterrupt):
        quick(axes, batch=1, on_progress=lambda done, _: done < 2 or _stop(), **options)
    result = quick(axes, resume=True, **options)
    folder = zarr.open_group(path, mode="r")
    assert len(list(folder.group_keys())) == 2
    for row in result.rows:
        group = folder[row["trajectory"]]
        poses = group["position"][row["run"]]
        assert poses[-1].ravel().tolist() == row["final_position"] and poses.shape == (7, row["count"] + 1, 3)
        assert poses[0, 1].tolist() == [0, 0, row["height"]]
        np.testing.assert_allclose(group["time"][:], np.arange(7) / 60)
        others = [other["run"] for other in result.rows if other["trajectory"] != row["trajectory"]]
        assert np.isnan(group["position"][others[0]]).all()


def _stop():
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"about": []}, "metadata: must be a JSON object"),
        ({"scene": 7}, "scene: must be str in the metadata, got 7"),
        ({"axes": ["height", 1]}, "axes: must be list in the metadata"),
        ({"parameters": ["width"]}, "width: is an axis without a column"),
        ({"without": "run"}, "run: must be int in every row, got None"),
        ({"without": "status"}, "status: must be str in every row, got None"),
    ],
)
def test_what_is_no_table_of_a_sweep_is_refused(tmp_path, change, message):
    result = quick({"height": [1.0]})
    rows = [{name: value for name, value in row.items() if name != change.get("without")} for row in result.rows]
    table = pyarrow.Table.from_pylist(rows)
    about = change.get("about", {**result.about, **change})
    path = tmp_path / "t.parquet"
    told = {table_module.METADATA: json.dumps(about, default=str).encode()}
    pyarrow.parquet.write_table(table.replace_schema_metadata(told), path)
    with pytest.raises(ValueError, match=f"^{path}: not a table of a sweep: {message}"):
        read(path)


def test_a_table_of_another_ending_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"^path: must end in .parquet, got .*t.csv; for CSV use to_pandas"):
        SweepResult([{"run": 0}], {}).to_parquet(tmp_path / "t.csv")
    assert not any(tmp_path.iterdir())


def test_vectors_are_read_as_they_were_written(tmp_path):
    """And drawn: a file has lists for them, which do not count as values."""
    written = quick({"gravity": [(0.0, 0.0, -9.81), (0.0, 0.0, -3.0)]})
    written.to_parquet(tmp_path / "t.parquet")
    again = read(tmp_path / "t.parquet")
    assert [row["gravity"] for row in again.rows] == [row["gravity"] for row in written.rows]
    for result in (written, again):
        result.plot(tmp_path / "t.png", kind="line")
    assert (tmp_path / "t.png").stat().st_size > 1000


def test_a_damaged_table_or_one_of_endless_rows_is_refused(tmp_path, monkeypatch):
    """Of pages that are damaged pyarrow tells by an OSError of several lines, without the file."""
    path = tmp_path / "t.parquet"
    quick({"height": [1.0, 2.0]}, output=path)
    content = bytearray(path.read_bytes())
    content[4:40] = bytes(36)
    (tmp_path / "bad.parquet").write_bytes(content)
    with pytest.raises(ValueError, match="bad.parquet: not a table of a sweep") as error:
        read(tmp_path / "bad.parquet")
    assert "\n" not in str(error.value)
    monkeypatch.setattr(table_module, "MAX_RUNS", 1)
    monkeypatch.setattr(pyarrow.parquet, "read_table", lambda _: pytest.fail("was read"))
    with pytest.raises(ValueError, match="must have at most 1 rows, got 2"):
        read(path)


def test_tables_that_tell_too_little_are_not_merged(tmp_path):
    row = quick({"height": [1.0]}).rows[0]
    write(SweepResult([row], {"axes": ["height"]}), tmp_path / "t.parquet")
    for use in (lambda: merge([tmp_path / "t.parquet"]), lambda: read(tmp_path / "t.parquet").replay(row, ball)):
        with pytest.raises(
            ValueError, match="^(design_id: must be str in the metadata|scene: must be that of the rows)"
        ):
            use()


SCENE_FILE = """
import pathlib
import warp_rigid as wr

pathlib.Path({mark!r}).touch()


def scene(height=1.0):
    made = wr.Scene()
    made.add_body(wr.Sphere(0.1), position=(0, 0, height))
    return made
"""


def test_a_table_read_from_a_file_runs_no_scene_file(tmp_path):
    """The path in the metadata is data; a scene file runs only if the caller names it."""
    mark, source = tmp_path / "was_run", tmp_path / "source.py"
    source.write_text(SCENE_FILE.format(mark=str(mark)))
    made = wr.sweep(source, {"height": [1.0, 2.0]}, duration=0.01, device="cpu", output=tmp_path / "t.parquet")
    assert made.replay(made.rows[1], device="cpu").get("position")[0, 0, 2] == 2.0, "the caller named it"
    mark.unlink()
    back = read(tmp_path / "t.parquet")
    with pytest.raises(ValueError, match="^scene: must be given: a file named in a table is not run"):
        back.replay(back.rows[1], device="cpu")
    assert not mark.exists()
    assert back.replay(back.rows[1], source, "cpu").get("position")[0, 0, 2] == 2.0
    assert mark.exists()


@pytest.mark.parametrize("named", ["source.py", "source.usda", 7, ["incline"], None])
def test_whatever_a_table_names_is_not_opened(tmp_path, named):
    row = quick({"height": [1.0]}).rows[0]
    write(SweepResult([row], {"axes": ["height"], "source": named}), tmp_path / "t.parquet")
    with pytest.raises(ValueError, match="^(scene: must be given|.*: not a table of a sweep: source)"):
        read(tmp_path / "t.parquet").replay(row)


def test_large_tables_are_quick(tmp_path):
    """100,000 rows; the bound is generous, for machines that are busy."""
    row = quick({"height": [1.0]}).rows[0]
    rows = [row | {"run": i, "id": f"{i:016x}", "height": 1e-5 * i} for i in range(100_000)]
    start = time.perf_counter()
    write(SweepResult(rows, {"axes": ["height"]}), tmp_path / "large.parquet")
    back = read(tmp_path / "large.parquet")
    assert time.perf_counter() - start < 20.0
    assert back.rows[-1] == rows[-1] and len(back) == 100_000
