"""Every command and every program of the README and of docs/ runs; only sizes are cut. Pictures come from commands."""

import ast
import inspect
import re
import textwrap
import tomllib

import pytest
import warp as wp

import warp_rigid
from tests.pages import (
    DOCS,
    ROOT,
    arguments_of,
    blocks,
    close_viewers_at_once,
    commands,
    draw_small_pictures,
    write_scene_files,
)
from tests.robot_tools import robot_files
from warp_rigid import scenes
from warp_rigid.commands import cli
from warp_rigid.engine import hash_grid, heaps, step
from warp_rigid.engine.step import Stages
from warp_rigid.kernels.joints import joint_stages
from warp_rigid.scene import fields
from warp_rigid.validation import suite

PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
MEASURES = {("overlap", "deepest_overlap")}
"""Kernels that are no part of a step."""

MOST_BYTES = {".png": 120_000, ".webp": 500_000}
MOST_BYTES_OF_ALL = 9_000_000


OTHERS = [page for page in PAGES if page.parent.name != "sweeps" and page.name != "bench.md"]
"""Not those that tests/test_sweep_docs.py and tests/test_bench.py run."""

COMMANDS = commands(OTHERS)
TESTED = ("warp-rigid doctor", "warp-rigid warmup")
"""By tests/test_doctor.py."""
PROGRAMS = blocks("python", OTHERS)
OWN_COMMANDS = [command for command in COMMANDS if command.startswith("warp-rigid ") and command not in TESTED]


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    draw_small_pictures(monkeypatch.setattr)


@pytest.mark.parametrize("command", OWN_COMMANDS)
def test_command_runs(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    write_scene_files(OTHERS, tmp_path)
    arguments = arguments_of(command)
    if any(part.startswith("robots/") for part in arguments):
        (tmp_path / "robots").mkdir()
        for name, file in robot_files().items():
            (tmp_path / "robots" / name).symlink_to(file)
    if arguments[0] == "view":
        close_viewers_at_once(monkeypatch.setattr)
    for film in (part for part in arguments if arguments[0] == "view" and part.startswith("out/")):
        assert cli.main(["run", "seesaw", "-o", film, "--frames", "2", "--device", "cpu"]) == 0
    for _ in range(2 if arguments[0] in ("sweep", "merge") else 1):  # these refuse to replace a table by accident
        assert cli.main(arguments) == 0
    written = [part for part in arguments if part.startswith("out/")]
    assert all((tmp_path / path).stat().st_size > 0 for path in written)


@pytest.mark.parametrize("program", PROGRAMS)
def test_program_runs(program, tmp_path, monkeypatch):
    for framework in re.findall(r"^import (torch|jax|gymnasium)\b", program, flags=re.MULTILINE):
        pytest.importorskip(framework, reason="an optional framework")
    monkeypatch.chdir(tmp_path)
    for _ in range(2 if "wr.sweep(" in program else 1):
        exec(compile(program, "program.py", "exec"), {})
    assert all((tmp_path / path).is_file() for path in re.findall(r'"(out/[^"]+)"', program))


def test_scene_files_of_the_pages_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in write_scene_files(PAGES, tmp_path):
        assert cli.main(["run", name, "--frames", "2", "--device", "cpu", "--picture", "out/a.png"]) == 0


def test_make_targets_and_files_exist():
    makefile = (ROOT / "Makefile").read_text()
    for command in COMMANDS:
        if command.startswith("make "):
            assert f"\n{command.split()[1]}:" in makefile
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text()):
            assert "://" in target or (page.parent / target).is_file(), (page, target)
    text = "\n".join(page.read_text() for page in PAGES)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    asked = {extra for group in re.findall(r"'\.\[([\w,]+)\]'", text) for extra in group.split(",")}
    assert asked and asked <= set(extras)


def test_files_named_in_the_pages_on_the_code_exist():
    files = [
        f"/{path.relative_to(ROOT)}"
        for top in ("kernels", "warp_rigid", "tests")
        for path in (ROOT / top).rglob("*.py")
    ]
    for page in ("architecture", "life_of_a_contact"):
        named = re.findall(r"`([\w/]+\.py)`", (DOCS / f"{page}.md").read_text())
        assert len(named) > 5
        assert [name for name in named if not any(file.endswith(f"/{name}") for file in files)] == []


def test_pictures_are_small_and_made_by_a_command_or_program():
    pictures = list((DOCS / "pictures").iterdir())
    assert sum(picture.stat().st_size for picture in pictures) <= MOST_BYTES_OF_ALL
    for picture in pictures:
        written = picture.name.replace(".webp", ".gif")
        assert any(f"out/{written}" in maker for maker in OWN_COMMANDS + PROGRAMS), picture.name
        assert any(f"pictures/{picture.name})" in page.read_text() for page in PAGES), picture.name
        assert picture.stat().st_size <= MOST_BYTES[picture.suffix], picture.name


def test_gallery_shows_every_scene_once():
    run = [arguments_of(command)[:2] for command in commands([DOCS / "gallery.md"])]
    assert sorted(run) == sorted(["run", name] for name in scenes.names())


def test_cases_that_prove_promises_exist():
    cases = {case.id for case in suite.all_cases(quick=False)}
    named = set(re.findall(r"\bV\d\d\b", (ROOT / "README.md").read_text()))
    assert named and named <= cases


def test_every_stage_has_a_page_with_its_kernels():
    """The headings of the step's pages are the code's names. Joints take part in several stages and have one page."""
    body = ast.parse(textwrap.dedent(inspect.getsource(Stages.step)))
    stages = {node.func.attr for node in ast.walk(body) if isinstance(node, ast.Call)} | {"joints"}
    overview = (DOCS / "step" / "index.md").read_text()
    assert stages == set(re.findall(r"^\| \[(\w+)\]", overview, flags=re.MULTILINE))
    shown = set()
    for page in (DOCS / "step").glob("*.md"):
        text = page.read_text()
        assert page.stem == "index" or (page.stem in stages and text.startswith(f"# {page.stem}\n"))
        for module, options in re.findall(r"^::: warp_rigid\.kernels\.\w+\.(\w+)\n((?: {4}.*\n)*)", text, flags=re.M):
            shown |= {(module, name) for name in re.findall(r"^ {8}- (\w+)$", options, flags=re.M)}
    classes = (Stages, hash_grid.HashGrid, heaps.HeapStages)
    launching = "".join(inspect.getsource(each) for each in classes)
    named = set(re.findall(r"\b(\w+)\.(\w+)\b", launching))
    launched = {
        (m, name)
        for m, name in named
        for source in (step, hash_grid, heaps)
        if isinstance(getattr(getattr(source, m, None), name, None), wp.Kernel)
    }
    launched |= {("joint_stages", name) for name, value in vars(joint_stages).items() if isinstance(value, wp.Kernel)}
    assert shown == launched - MEASURES


def test_api_page_has_every_public_name():
    paths = re.findall(r"^::: (\S+)$", (DOCS / "api.md").read_text(), flags=re.M)
    paths.remove(fields.__name__)  # the page shows all fields of the module
    assert sorted([*(path.split(".")[-1] for path in paths), *fields.__all__]) == sorted(warp_rigid.__all__)


def test_citation_has_this_version():
    assert f"\nversion: {warp_rigid.__version__}\n" in (ROOT / "CITATION.cff").read_text()
