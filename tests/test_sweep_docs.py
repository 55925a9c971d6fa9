"""The sweep's examples run, small, and every command and program of its pages does; what they claim is looked at."""

import importlib.util
import re
import shlex

import numpy as np
import pytest
from PIL import Image
from pxr import Usd

import warp_rigid as wr
from tests.pages import ROOT, blocks, commands
from warp_rigid.commands import cli

PAGES = sorted((ROOT / "docs" / "sweeps").glob("*.md"))


def example(name):
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_stability_map_agrees_with_statics(tmp_path):
    result = example("stability_map").main(["--size", "2", "--heights", "4", "--out", str(tmp_path)])
    is_finite = [row for row in result.rows if row["shock_propagation"] != "one_pass"]
    # Statics: N d > 1 falls; at d = 0.04 both stand, at d = 0.4 both fall.
    assert [row["toppled"] for row in is_finite] == [row["height"] * row["offset"] > 1 for row in is_finite]
    assert not any(row["toppled"] for row in result.rows if row["shock_propagation"] == "one_pass")
    assert Image.open(tmp_path / "stability.png").size[0] > 500


def test_friction_makes_the_heap_steeper(tmp_path):
    arguments = ["--size", "2", "--grains", "8", "--duration", "1.0", "--out", str(tmp_path)]
    slope = example("angle_of_repose").main(arguments).column("slope").reshape(2, 3)
    assert slope[0].max() < slope[1].min()
    assert (tmp_path / "repose.png").stat().st_size > 1000


def test_cubes_form_a_steeper_heap_than_balls(tmp_path):
    """Columns of different solids in one batch."""
    arguments = ["--shapes", "--grains", "12", "--duration", "3.0", "--out", str(tmp_path)]
    result = example("angle_of_repose").main(arguments)
    slope = {shape: result.column("slope")[result.column("shape") == shape] for shape in ("cube", "ball")}
    assert (tmp_path / "repose_shapes.png").stat().st_size > 1000
    assert len(set(result.column("shape"))) == 5 and slope["cube"].min() > 1.5 * slope["ball"].max()


@pytest.mark.long
def test_best_drop_is_exported_alone_and_ends_as_measured(tmp_path):
    module = example("best_drop")
    result, best = module.main(["--size", "3", "--duration", "0.5", "--out", str(tmp_path)])
    assert best["upright"] <= result.column("upright").max()
    sim = result.replay(best)
    sim.step(120)
    assert module.upright(sim)[0] == pytest.approx(best["upright"], rel=1e-14)
    stage = Usd.Stage.Open(str(tmp_path / "best_drop.usdc"))
    assert len([prim for prim in stage.GetDefaultPrim().GetChildren() if prim.GetName().startswith("env_")]) == 1
    assert module.bowl().volume == pytest.approx(cap_shell_volume(0.3, 0.33), rel=0.02)


def cap_shell_volume(inner, outer):
    """Between two concentric spheres, within 45 degrees of straight down: a cone-bounded sector of the shell."""
    solid_angle = 2.0 * np.pi * (1.0 - np.cos(0.25 * np.pi))
    return solid_angle * (outer**3 - inner**3) / 3.0


def test_material_is_found_again(tmp_path):
    study = example("fit_material").main(["--size", "128", "--out", str(tmp_path)])
    # Guessing at random would miss by a quarter of each range on average.
    assert study.best_params["friction"] == pytest.approx(0.22, abs=0.04)
    assert study.best_params["restitution"] == pytest.approx(0.55, abs=0.04)


def test_material_of_a_pile_is_found_by_twins(tmp_path):
    """From a record with a noise of 1 mm, by two starts in four batches, and by equally many runs of a search."""
    module = example("fit_pile")
    found, error, study = module.main(["--starts", "2", "--rounds", "4", "--out", str(tmp_path)])
    assert len(study.trials) == 40 and error < study.best_value
    for name, value in module.TRUE.items():
        assert found[name] == pytest.approx(value, abs=0.05)
    assert (tmp_path / "fit_pile.png").stat().st_size > 1000


def test_elasticities_are_those_of_the_closed_form(tmp_path):
    """v^2 / (2 mu g) is exact but for v dt / 2, at most mu g dt / v = 3.8 % of it, by which elasticities differ."""
    module = example("sensitivity")
    elasticity = module.main(["--size", "3", "--out", str(tmp_path)])
    for measured, exact in zip(elasticity.T, module.CLOSED_FORM.values(), strict=True):
        assert measured == pytest.approx(exact, abs=0.04)
    assert (tmp_path / "sensitivity.png").stat().st_size > 1000


def test_a_network_trained_on_mixed_scenes_judges_balls_better(tmp_path):
    pytest.importorskip("torch", reason="an optional framework")
    errors = example("friction_from_motion").main(["--envs", "20", "--rounds", "300", "--out", str(tmp_path)])
    assert errors["mixed scenes"]["ball"] < 0.8 * errors["cubes of one size"]["ball"]
    assert (tmp_path / "friction_from_motion.png").stat().st_size > 1000


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the commands of the pages run, one after another."""
    return tmp_path_factory.mktemp("pages")


@pytest.mark.long
@pytest.mark.parametrize("command", commands(PAGES))
def test_commands_of_the_pages_run(command, folder, monkeypatch):
    """All of them, twice, but only for an instant; the examples have their own tests."""
    monkeypatch.chdir(folder)
    program, *arguments = shlex.split(command)
    if program == "python":
        assert (ROOT / arguments[0]).is_file()
        return
    assert program == "warp-rigid"
    if arguments[0] == "sweep":
        arguments += ["--duration", "0.02"]
    assert [cli.main(arguments) for _ in range(2)] == [0, 0]
    assert all((folder / part).stat().st_size > 0 for part in arguments if part.startswith("out/"))


@pytest.mark.parametrize("program", blocks("python", PAGES))
def test_programs_of_the_pages_run(program, tmp_path, monkeypatch):
    if "import torch" in program:
        pytest.importorskip("torch", reason="an optional framework")
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        exec(compile(program.replace("duration=2.0", "duration=0.02"), "page.py", "exec"), {"wr": wr})
    assert all((tmp_path / path).is_file() for path in re.findall(r'"(out/[^"]+)"', program))


def test_pages_name_every_metric_and_design():
    from warp_rigid.sweep.axes import DISTRIBUTIONS
    from warp_rigid.sweep.design import DESIGNS
    from warp_rigid.sweep.metrics import METRICS

    text = (ROOT / "docs" / "sweeps" / "index.md").read_text()
    assert all(f"`{name}`" in text for name in METRICS)
    assert all(name in text for name in (*DESIGNS, *DISTRIBUTIONS) if name != "uniform")
