"""Every command and every program of the README and of docs/ runs; only sizes are cut."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest

from warp_rigid import cli
from warp_rigid.viewer.page import stop_server

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXT = "\n".join(page.read_text() for page in PAGES)


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", TEXT, flags=re.DOTALL)


COMMANDS = [line.split("#")[0].strip() for block in blocks("bash") for line in block.splitlines() if line]
OWN_COMMANDS = [command for command in COMMANDS if command.startswith("warp-rigid ")]


def test_there_is_something_to_test():
    assert len(OWN_COMMANDS) >= 10 and len(blocks("python")) >= 1


@pytest.mark.parametrize("command", OWN_COMMANDS)
def test_command_runs(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = shlex.split(command)[1:]
    if arguments[0] == "run":
        arguments += ["--frames", "2", "--device", "cpu"]
    if arguments[0] == "view":
        # The page opens, and closes at once; tests/browser has it used.
        monkeypatch.setattr("warp_rigid.viewer.live.LiveViewer.run", lambda viewer: stop_server(viewer.server))
        monkeypatch.setattr("warp_rigid.viewer.playback.FilmViewer.run", lambda viewer: stop_server(viewer.server))
    for film in (part for part in arguments if arguments[0] == "view" and part.startswith("out/")):
        assert cli.main(["run", "seesaw", "-o", film, "--frames", "2", "--device", "cpu"]) == 0
    if arguments[0] == "sweep":
        arguments += ["--duration", "0.01", "--device", "cpu"]
    if arguments[0] == "inspect":
        arguments += ["--sdf-resolution", "16"]
    assert cli.main(arguments) == 0
    written = [part for part in arguments if part.startswith("out/")]
    assert all((tmp_path / path).stat().st_size > 0 for path in written)


@pytest.mark.parametrize("program", blocks("python"))
def test_program_runs(program, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(program, "program.py", "exec"), {})
    assert all((tmp_path / path).is_file() for path in re.findall(r'"(out/[^"]+)"', program))


def test_make_targets_and_files_exist():
    makefile = (ROOT / "Makefile").read_text()
    for command in COMMANDS:
        if command.startswith("make "):
            assert f"\n{command.split()[1]}:" in makefile
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert "://" in target or (page.parent / target).is_file()
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    asked = {extra for group in re.findall(r"'\.\[([\w,]+)\]'", TEXT) for extra in group.split(",")}
    assert asked and asked <= set(extras)
