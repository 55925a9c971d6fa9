"""The command line: what it writes where, and its exit status."""

import json
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pxr import Usd

import warp_rigid
from warp_rigid import progress_bar, scenes
from warp_rigid.commands import cli
from warp_rigid.commands import run as run_module
from warp_rigid.runs import runner
from warp_rigid.scenes import incline

ROOT = Path(__file__).resolve().parents[1]

SCENE = """
import warp_rigid as wr

def scene(speed=0.0):
    made = wr.Scene()
    made.add_static(wr.Plane(), name="ground")
    made.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1), linear_velocity=(speed, 0, 0))
    return made
"""


@pytest.fixture
def scene_file(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(SCENE)
    return str(path)


def run(capsys, *arguments):
    """Exit status, stdout and stderr of a command line."""
    status = cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_run_tells_its_figures_as_one_json_object(capsys, scene_file):
    status, out, _ = run(capsys, "run", scene_file, "--envs", 3, "--frames", 4, "--json")
    summary = json.loads(out)
    assert status == 0
    assert (summary["scene"], summary["envs"], summary["bodies"]) == ("mine", 3, 2)
    assert (summary["frames"], summary["fps"]) == (4, 60.0)
    assert summary["time"] == pytest.approx(4 / 60)
    assert summary["settings"]["dt"] == pytest.approx(1 / 240)
    assert summary["contacts"] >= 3 * 3
    assert len(summary["penetration"]) == len(summary["deepest_penetration"]) == 3
    assert summary["env_frames_per_second"] > 0
    assert summary["failed"] == summary["verdicts"] == summary["files"] == []


@pytest.mark.long
def test_all_of_stdout_is_the_object(scene_file):
    """Warp's own greeting and progress must not get into it; only a fresh process shows that."""
    command = [sys.executable, "-m", "warp_rigid", "run", scene_file, "--frames", "1", "--json"]
    done = subprocess.run([*command, "--device", "cpu"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["scene"] == "mine"
    assert done.stderr == ""


def test_run_writes_what_is_asked(capsys, scene_file, tmp_path):
    paths = {
        flag: tmp_path / "out" / name
        for flag, name in (
            ("-o", "film.usdc"),
            ("--picture", "last.png"),
            ("--film", "film.gif"),
            ("--contact-sheet", "sheet.png"),
        )
    }
    flags = [part for pair in paths.items() for part in pair]
    status, out, _ = run(capsys, "run", scene_file, "--frames", 3, "--envs", 2, *flags)
    assert status == 0
    stage = Usd.Stage.Open(str(paths["-o"]))
    assert stage.GetEndTimeCode() == 3 and stage.GetPrimAtPath("/World/env_0001")
    for flag in ("--picture", "--film", "--contact-sheet"):
        assert Image.open(paths[flag]).size[0] > 100
    assert all(f"wrote {path}" in out.replace("\n", "") for path in paths.values())


def test_film_holds_the_chosen_environments(capsys, scene_file, tmp_path):
    def envs(*flags):
        arguments = ("run", scene_file, "--frames", 1, "--envs", 20, "-o", tmp_path / "f.usdc")
        status, _, err = run(capsys, *arguments, *flags)
        assert status == 0
        stage = Usd.Stage.Open(str(tmp_path / "f.usdc"))
        names = [prim.GetName() for prim in stage.GetDefaultPrim().GetChildren()]
        return [int(name[4:]) for name in names if name.startswith("env_")], err

    assert envs("--usd-envs", "5,19")[0] == [5, 19]
    assert envs("--usd-envs", "all")[0] == list(range(20))
    first, messages = envs()
    assert first == list(range(16)) and "recording the first 16 environments" in messages


def test_compare_prints_variants_and_expectations(capsys):
    status, out, _ = run(capsys, "run", "incline", "--compare", "--frames", 2)
    assert status == 0
    assert all(name in out for name in scenes.get("incline").variants)


@pytest.mark.parametrize("option", [("--set", "friction=1"), ("--envs", "2"), ("--seed", "1"), ("--compare",)])
def test_options_of_a_simulation_do_not_apply_to_an_animation(capsys, tmp_path, monkeypatch, option):
    from warp_rigid.viewer.playback import FilmViewer

    monkeypatch.setattr(FilmViewer, "__init__", lambda *_: pytest.fail("it is shown"))
    warp_rigid.record(warp_rigid.Simulator(scenes.load("incline"), device="cpu"), frames=1).save(tmp_path / "a.npz")
    status, _, err = run(capsys, "view", str(tmp_path / "a.npz"), *option)
    assert status == 2 and "do not apply to an animation" in err and err.count("\n") == 1


@pytest.mark.parametrize("expected, status", [(True, 0), (False, 6)])
def test_an_unexpected_verdict_has_its_own_status(capsys, monkeypatch, expected, status):
    """The block of the incline starts at rest: it has not slid, whatever the scene expects."""

    class Slides(incline.InclineOutcome):
        def verdicts(self, sim):
            return [replace(super().verdicts(sim)[0], expected={"default": expected})]

    demo = replace(scenes.get("incline"), outcome=Slides, duration=1 / 60)
    monkeypatch.setattr("warp_rigid.runs.runner.find_scene", lambda name: demo)
    found, out, _ = run(capsys, "run", "incline")
    assert found == status and ("NOT AS EXPECTED" in out) == (status == 6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "box_stak"], "scene: must be"),
        (["run"], "Missing argument"),
        (["nothing"], "No such command"),
        (["run", "box_stack", "--frames", "many"], "Invalid value for '--frames'"),
        (["run", "box_stack", "--device", "cuda:99"], "device: must be one of"),
        (["run", "box_stack", "--set", "heigth=3"], "did you mean height?"),
        (["run", "box_stack", "--set", "height=0"], "height: must be"),
        (["run", "box_stack", "--fps", "7"], "fps: a frame must be a whole number of steps"),
        (["run", "box_stack", "-o", "film.mp4"], "-o: must end in"),
        (["run", "box_stack", "-o", ""], "-o: must not be empty"),
        (["run", "box_stack", "--film="], "--film: must not be empty"),
        (["sweep", "box_stack", "--vary", "height=2,3", "--output", ""], "--output: must not be empty"),
        (["inspect", ""], "argument: must not be empty"),
        (["run", "box_stack", "--picture", "film.bmp"], "film.bmp: must end in .png"),
        (["run", "box_stack", "--film", "film.avi"], "film.avi: must end in .gif or .mp4"),
        (["run", "box_stack", "--html", "page.htm"], "page.htm: must end in .html"),
        (["run", "box_stack", "--color", "mass"], "--color: must be one of body, environment, level, speed, asleep"),
        (["run", "box_stack", "--checkpoint", "a.ckpt"], "--checkpoint: requires --checkpoint-every or --resume"),
        (["run", "box_stack", "--usd-profile", "scene"], "--usd-contacts: require -o with a USD file"),
        (["run", "box_stack", "-o", "a.glb", "--usd-contacts"], "--usd-contacts: require -o with a USD file"),
        (["view", "box_stak"], "scene: must be"),
        (["view", "missing.py"], "missing.py: no such file"),
        (["view", "missing.npz"], "missing.npz"),
        (["view", "missing.usdc"], "missing.usdc: no such file"),
        (["view", "box_stack", "--set", "heigth=3"], "did you mean height?"),
        (["run", "box_stack", "--film", "a.gif", "--usd-envs", "x"], "--usd-envs: must be numbers"),
        (["run", "missing.py"], "missing.py: no such file"),
        (["inspect", "missing.obj"], "missing.obj: no such file"),
        (["inspect", "cube"], "cube: no such file and no built-in mesh; all names: bunny, torus, "),
        (
            ["view", str(ROOT / "scenes" / "marble_run.usda")],
            "must be an animation written by export_usd; warp-rigid run",
        ),
        (["inspect", "bunny", "--slice", "z=0"], "--slice: requires -o"),
        (["inspect", "bunny", "--slice", "w=0", "-o", "a.png"], "--slice: must be x=, y= or z="),
        (["inspect", "bunny", "--slice", "z=9", "-o", "a.png"], "--slice: z must be from"),
        (["inspect", "bunny", "--sdf-resolution", "1"], "sdf_resolution: must be"),
    ],
)
def test_bad_input_is_one_line_and_status_2(capsys, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    status, out, err = run(capsys, *arguments)
    assert status == 2 and out == ""
    lines = [line for line in err.splitlines() if "simulating on" not in line]
    assert len(lines) == 1 and message in lines[0]
    assert list(tmp_path.iterdir()) == []


def test_unwritable_place_is_one_line(capsys, scene_file, tmp_path):
    target = tmp_path / "mine.py" / "film.usdc"
    status, _, err = run(capsys, "run", scene_file, "--frames", 1, "-o", target)
    assert status == 2 and str(tmp_path / "mine.py") in err.splitlines()[-1]


@pytest.mark.parametrize(
    "flags",
    [
        ("-o", "{blocked}/film.usdc"),
        ("--picture", "{blocked}/last.png"),
        ("--film", "{folder}.gif"),
        ("--html", "{blocked}/deep/page.html"),
        ("--checkpoint-every", "2", "--checkpoint", "{blocked}/a.ckpt"),
        ("--picture", "{folder}/a.png", "--contact-sheet", "{folder}/a.png"),
        ("-o", "{folder}/a.usdc", "--usd-envs", "1"),
        ("-o", "{folder}/a.usdc", "--usd-envs", "-1"),
        ("-o", "{folder}/a.usdc", "--usd-envs", "0,0"),
    ],
)
def test_outputs_and_lists_are_checked_before_the_run(capsys, scene_file, tmp_path, monkeypatch, flags):
    monkeypatch.setattr(runner, "execute", lambda *_, **__: pytest.fail("it ran"))
    (tmp_path / "places.gif").mkdir()
    places = {"blocked": scene_file, "folder": tmp_path / "places"}
    status, out, err = run(capsys, "run", scene_file, *(flag.format(**places) for flag in flags))
    assert status == 2 and out == "" and len(without_device(err)) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.py", "places.gif"]


@pytest.mark.parametrize("command", ["sweep", "bench"])
def test_other_outputs_are_checked_before_the_run(capsys, scene_file, monkeypatch, command):
    from warp_rigid.bench import measure
    from warp_rigid.sweep import batch_run

    for module, name in ((measure, "measure"), (batch_run, "_run")):
        monkeypatch.setattr(module, name, lambda *_: pytest.fail("it ran"))
    given = {
        "sweep": (scene_file, "--vary", "speed=1,2", "--plot", f"{scene_file}/a.png"),
        "bench": ("stack:2", "--json-lines", f"{scene_file}/a.jsonl"),
    }
    status, _, err = run(capsys, command, *given[command])
    assert status == 2 and len(without_device(err)) == 1 and "cannot be written" in err


def without_device(err: str) -> list[str]:
    return [line for line in err.splitlines() if "simulating on" not in line]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def scene():\n    return 5\n", "mine.py:1: scene() must return a Scene, got 5"),
        ("def scene():\n    x = 3 +\n", "mine.py:2: SyntaxError: invalid syntax"),
        ("import warp_rigid as wr\ndef scene():\n    return wr.Box((-1, 1, 1))\n", "mine.py:3: half_extents: must be"),
        ("import not_there\n", "mine.py:1: ModuleNotFoundError: No module named 'not_there'"),
        ("def scene():\n    return inner()\ndef inner():\n    return {}['a']\n", "mine.py:4: KeyError: 'a'"),
        ("import warp_rigid as wr\ndef scene():\n    return wr.Mesh.from_file('no.obj')\n", "mine.py:3: no.obj"),
        ("scene = 3\n", "mine.py: has no function scene()"),
    ],
)
@pytest.mark.parametrize("command", ["run", "sweep", "view"])
def test_errors_of_a_scene_file_name_the_line(capsys, scene_file, text, message, command):
    Path(scene_file).write_text(text)
    status, out, err = run(capsys, command, scene_file)
    assert status == 2 and out == ""
    lines = without_device(err)
    assert len(lines) == 1 and message in lines[0] and "pip install" not in lines[0]


def test_an_interrupted_run_tells_what_it_kept(capsys, scene_file, tmp_path, monkeypatch):
    step, film, kept = runner.step_frame, tmp_path / "a.usdc", tmp_path / "a.ckpt"

    def run_interrupted(*flags):
        count = iter(range(5))
        monkeypatch.setattr(runner, "step_frame", lambda *a: step(*a) if next(count, None) is not None else stop())
        status, _, err = run(capsys, "run", scene_file, "--frames", 9, *flags)
        monkeypatch.setattr(runner, "step_frame", step)
        assert status == 130
        return err.splitlines()[-1]

    def stop():
        raise KeyboardInterrupt

    assert run_interrupted() == (
        "interrupted: after 5 of 9 frames; nothing was kept; to be able to continue, use --checkpoint-every N"
    )
    assert f"kept {film} with 6 frames" in run_interrupted("-o", film)
    assert Usd.Stage.Open(str(film)).GetEndTimeCode() == 5
    line = run_interrupted("--checkpoint-every", 2, "--checkpoint", kept, "--json")
    assert f"kept {kept} of frame 4; to continue: warp-rigid run" in line
    command = shlex.split(line.partition("to continue: ")[2])
    status, out, _ = run(capsys, *command[1:])
    assert status == 0 and json.loads(out)["frames"] == 9


def test_progress_without_a_terminal_is_a_line_now_and_then(capsys, scene_file, monkeypatch, tmp_path):
    assert "%" not in run(capsys, "run", scene_file, "--frames", 4)[2]
    monkeypatch.setattr(progress_bar, "LINE_PERIOD", 0.0)
    lines = [line for line in run(capsys, "run", scene_file, "--frames", 4)[2].splitlines() if "%" in line]
    assert [line.partition(" after")[0] for line in lines] == ["mine: 25 %", "mine: 50 %", "mine: 75 %"]
    film = tmp_path / "a.gif"
    told = run(capsys, "run", scene_file, "--frames", 6, "--film", film)[2].splitlines()
    assert [line.partition(" after")[0] for line in told if line.startswith("drawing")] == [
        f"drawing {film}: 33 %",
        f"drawing {film}: 67 %",
    ]


def test_non_finite_state_is_status_4(capsys, scene_file):
    arguments = ("--frames", 3, "--set", "linear_velocity=(0,0,0),(3e38,0,0)")
    status, out, err = run(capsys, "run", scene_file, *arguments)
    assert status == 4
    assert "environment 1: non-finite since step" in out
    assert "1 environment(s) failed, first 1: non-finite" in err


def test_capacity_is_status_3(capsys):
    assert run_module._status([{"env": 2, "status": "capacity", "step": 7, "body": 1}]) == 3
    assert "first 2: capacity since step 7" in capsys.readouterr().err


def test_missing_library_is_named_with_its_remedy(capsys, scene_file, monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    status, _, err = run(capsys, "run", scene_file, "--picture", "a.png")
    assert status == 2 and "pip install 'warp-rigid[picture]'" in err


def test_scenes_are_listed(capsys):
    status, out, _ = run(capsys, "scenes")
    assert status == 0 and all(name in out for name in scenes.names())
    status, out, _ = run(capsys, "scenes", "--json")
    listed = json.loads(out)
    assert status == 0 and list(listed) == scenes.names()
    assert listed["box_stack"]["parameters"] == {"height": 10}
    assert "off" in listed["box_stack"]["variants"]


def test_version_and_help(capsys):
    assert run(capsys, "--version")[:2] == (0, f"warp-rigid {warp_rigid.__version__}\n")
    for arguments in ([], ["--help"], ["run", "--help"]):
        status, out, _ = run(capsys, *arguments)
        assert status == 0 and "Usage: warp-rigid" in out


def test_inspect_knows_a_box(capsys, tmp_path):
    """Figures of a box have closed forms: 0.2 x 0.4 x 0.6 m."""
    lines = [f"v {x} {y} {z}" for x in (-0.1, 0.1) for y in (-0.2, 0.2) for z in (-0.3, 0.3)]
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines += [f"f {a} {b} {c} {d}" for a, b, c, d in quads]
    (tmp_path / "box.obj").write_text("\n".join(lines))
    arguments = ("inspect", tmp_path / "box.obj", "--sdf-resolution", 24, "--json")
    status, out, _ = run(capsys, *arguments)
    figures = json.loads(out)
    assert status == 0 and figures["watertight"] and figures["repairs"] == []
    assert (figures["vertices"], figures["triangles"]) == (8, 12)
    np.testing.assert_allclose(figures["upper"], [0.1, 0.2, 0.3], rtol=1e-6)
    volume = 0.2 * 0.4 * 0.6
    assert figures["volume"] == pytest.approx(volume, rel=1e-6)
    squares = np.array([0.2, 0.4, 0.6]) ** 2
    moments = sorted(volume / 12 * (squares.sum() - squares))
    np.testing.assert_allclose(figures["principal_inertia"], moments, rtol=1e-6)
    np.testing.assert_allclose(figures["center_of_mass"], 0.0, atol=1e-9)
    assert figures["cell"] == pytest.approx(0.6 / 24, rel=1e-6)
    # Rounding of edges by linear interpolation: less than a cell, and much less on average.
    assert figures["distance_error_largest"] < figures["cell"]
    assert figures["distance_error_mean"] < 0.1 * figures["cell"]
    assert figures["wrong_signs"] == 0


def test_inspect_tells_of_holes_and_draws_a_slice(capsys, tmp_path):
    lines = ["v 0 0 0", "v 1 0 0", "v 0 1 0", "v 0 0 1", "f 1 3 2", "f 1 2 4", "f 1 4 3"]
    (tmp_path / "open.obj").write_text("\n".join(lines))
    picture = tmp_path / "out" / "slice.png"
    status, out, _ = run(
        capsys, "inspect", tmp_path / "open.obj", "--sdf-resolution", 16, "-o", picture,
        "--slice", "z=0.2",
    )  # fmt: skip
    assert status == 0 and "open" in out.splitlines()[0]
    told = " ".join(out.split())
    assert "from the triangles, so walls may be thinner than a cell" in told
    assert Image.open(picture).size[0] > 400


def test_inspect_tells_of_a_cap_that_crosses_the_surface(capsys, tmp_path):
    """A pyramid without its base, the tip of a second one in it: the lower one sticks out of the base's cap."""
    base = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
    sides = [(1, 2), (2, 3), (3, 4), (4, 1)]
    inner = [f"v {0.4 * x} {0.4 * y} 0.2" for x, y, _ in base]
    lines = [*(f"v {x} {y} {z}" for x, y, z in base), "v 0 0 1", *(f"f {a} {b} 5" for a, b in sides)]
    lines += [*inner, "v 0 0 -0.5", *(f"f {b + 5} {a + 5} 10" for a, b in sides), "f 6 7 8", "f 6 8 9"]
    (tmp_path / "crossed.obj").write_text("\n".join(lines))
    status, out, _ = run(capsys, "inspect", tmp_path / "crossed.obj", "--sdf-resolution", 16)
    told = " ".join(out.split())
    assert status == 0 and "from the grid only, as the mesh has holes, and with their caps it crosses itself" in told
    assert "repair the mesh or raise --sdf-resolution" in told


def test_ready_made_meshes_have_names(capsys):
    status, out, _ = run(capsys, "inspect", "tetrahedron", "--sdf-resolution", 16)
    assert status == 0 and "4 vertices, 4 triangles, watertight" in out
    assert "from the triangles, so walls may be thinner than a cell" in " ".join(out.split())
