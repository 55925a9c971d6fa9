"""`warp-rigid sweep` and `warp-rigid merge`."""

import json

import pytest

from warp_rigid.commands import cli
from warp_rigid.sweep import read

SCENE = """
import warp_rigid as wr


def scene(height=1.0):
    made = wr.Scene()
    made.add_static(wr.Plane())
    made.add_body(wr.Sphere(0.1), position=(0, 0, height), mass=1e-3)
    return made
"""


@pytest.fixture
def run(capsys, tmp_path, monkeypatch):
    """Run a command line in an empty folder that holds a scene; returns status, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ball.py").write_text(SCENE)

    def do(*arguments):
        status = cli.main([str(argument) for argument in arguments])
        out = capsys.readouterr()
        return status, out.out, out.err

    return do


SMALL = ("--duration", "0.1", "--device", "cpu")


def test_a_sweep_writes_its_table_and_picture(run, tmp_path):
    arguments = (
        "--vary",
        "height=1:2:3",
        "--vary",
        "restitution=0,0.5",
        "--set",
        "friction=0.2",
        "-o",
        "out/t.parquet",
    )
    status, out, err = run("sweep", "ball.py", *arguments, "--plot", "out/t.png", *SMALL)
    assert status == 0 and "6 runs, 0 failed" in out and "drift: " in out and "wrote out/t.png" in out
    assert "toppled: yes in 0 of 6 runs" in out
    assert "6 runs in 1 batch of at most 6; at most" in err
    table = read("out/t.parquet")
    assert table.column("height").tolist() == [1, 1, 1.5, 1.5, 2, 2] and table.about["fixed"] == {"friction": 0.2}
    assert (tmp_path / "out" / "t.png").stat().st_size > 1000
    assert table.about["command"][:5] == ["warp-rigid", "sweep", "ball.py", "--vary", "height=1:2:3"]


def test_resume_and_json(run):
    first = ("sweep", "ball.py", "--vary", "height=1,2", "-o", "t.parquet", "--batch", "1", *SMALL)
    assert run(*first)[0] == 0
    assert run(*first)[0] == 2
    status, out, err = run(*first, "--resume", "--json", "--metrics", ",".join(read("t.parquet").about["metrics"]))
    told = json.loads(out)
    assert status == 0 and told["runs"] == 2 and len(told["rows"]) == 2 and "2 of 2 runs are already finished" in err
    assert run(*first, "--overwrite")[0] == 0


def test_failed_runs_are_status_5(run):
    bad = ("--vary", "force=(0,0,0),(3e38,0,0)")
    status, out, err = run("sweep", "ball.py", *bad, "-o", "t.parquet", *SMALL)
    assert status == 5 and "2 runs, 1 failed" in out and "first run 1: non-finite: non-finite since step" in err
    assert read("t.parquet").rows[1]["status"] == "non-finite"


def test_shards_are_merged(run):
    common = ("sweep", "ball.py", "--vary", "height=1:2", "--design", "lhs", "--samples", "5", "--seed", "3", *SMALL)
    for i in (1, 2):
        assert run(*common, "--shard", f"{i}/2", "-o", f"{i}.parquet")[0] == 0
    status, out, err = run("merge", "1.parquet", "-o", "part.parquet")
    assert status == 5 and "2 of 5 runs are missing from the tables" in err
    status, out, err = run("merge", "1.parquet", "2.parquet", "-o", "all.parquet", "--plot", "all.svg", "--json")
    assert status == 0 and json.loads(out)["runs"] == 5
    assert read("all.parquet").column("run").tolist() == [0, 1, 2, 3, 4]
    status, _, err = run("merge", "1.parquet", "-o", "ball.py")
    assert status == 2 and "-o: must end in .parquet" in err
    assert run("merge", "1.parquet", "-o", "all.parquet")[0] == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--vary", "height"], "--vary: must be name=value"),
        (["--vary", "height=1", "--vary", "height=2"], "--vary height: given twice"),
        (["--vary", "heigth=1"], "did you mean height"),
        (["--vary", "height=1", "--set", "friction=1,2"], "--set friction: takes one value; use --vary"),
        (["--vary", "height=1", "--set", "height=2"], "height: must be either fixed or an axis"),
        (["--vary", "height=1", "--shard", "3/2"], "--shard: must be I/N"),
        (["--vary", "height=1", "--batch", "many"], "batch: must be a whole number"),
        (["--vary", "height=1", "--plot", "a.bmp"], "plot: must end in"),
        (["--vary", "height=1", "--plot", "a.png", "--plot-x", "width"], "--plot-x: must be an axis (height)"),
        (["--vary", "height=1", "--plot", "a.png", "--plot-y", "speed"], "--plot-y: must be a metric"),
        (["--vary", "height=1", "--metrics", "none.py"], "none.py: no such file"),
        (["--vary", "height=1", "--cluster", "none.py"], "none.py: no such file"),
    ],
)
def test_bad_input_is_one_line_and_status_2(run, tmp_path, arguments, message):
    status, out, err = run("sweep", "ball.py", *arguments, "-o", "t.parquet", *SMALL)
    lines = [line for line in err.splitlines() if "simulating on" not in line]
    assert status == 2 and out == "" and len(lines) == 1 and message in lines[0]
    assert [file.name for file in tmp_path.iterdir()] == ["ball.py"]
