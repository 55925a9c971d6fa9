"""The commands and programs of the pages, cut in size, for tests.

As a program it runs those of the README, the tutorials and the notebooks, one after the other, in the working folder,
with what is installed beside the interpreter: `python tests/pages.py`.
"""

import importlib.util
import json
import re
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from unittest import mock

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


def blocks(language: str, pages: list[Path]) -> list[str]:
    """Code of a language, each text once."""
    text = "\n".join(page.read_text() for page in pages)
    return list(dict.fromkeys(re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)))


def commands(pages: list[Path]) -> list[str]:
    """The lines of the blocks of a shell, each once."""
    lines = [line for block in blocks("bash", pages) for line in block.splitlines() if line]
    return list(dict.fromkeys(line.split("#")[0].strip() for line in lines))


def arguments_of(command: str) -> list[str]:
    """Arguments of a command `warp-rigid ...`, with options that cut its size."""
    arguments = shlex.split(command)[1:]
    smaller = {
        "run": ["--frames", "2", "--device", "cpu"],
        "bench": ["--device", "cpu"],
        "sweep": ["--duration", "0.01", "--device", "cpu"],
        "inspect": ["--sdf-resolution", "16"],
        "validate": ["--cases", "V23"],
    }
    return arguments + smaller.get(arguments[0], [])


def write_scene_files(pages: list[Path], folder: Path) -> dict[str, str]:
    """Write the files that the pages tell the reader to save, and return their text by name."""
    text = "\n".join(page.read_text() for page in pages)
    files = dict(re.findall(r'```python title="(\w+\.py)"\n(.*?)```', text, flags=re.DOTALL))
    for name, content in files.items():
        (folder / name).write_text(content)
    return files


def close_viewers_at_once(setattr: Callable) -> None:
    """Let `warp-rigid view` open its page, and close it at once; tests/browser has it used."""
    from warp_rigid.viewer.page import stop_server

    for viewer in ("live.LiveViewer", "playback.FilmViewer"):
        setattr(f"warp_rigid.viewer.{viewer}.run", lambda viewer: stop_server(viewer.server))


def draw_small_pictures(setattr: Callable) -> None:
    """Draw panels of a quarter of their usual width."""
    for name in ("PICTURE_SIZE", "GIF_SIZE"):
        setattr(f"warp_rigid.render.images.{name}", (320, 180))
    setattr("warp_rigid.render.images.SHEET_SIZE", (160, 90))
    setattr("warp_rigid.render.images.SMALLEST_PANEL", 80)


def notebook_tool() -> ModuleType:
    """docs/run_notebooks.py as a module."""
    spec = importlib.util.spec_from_file_location("run_notebooks", DOCS / "run_notebooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run_notebook(path: Path) -> None:
    """A notebook ends in a figure that can be published: units on the axes, and a legend.

    A sweep runs twice in one folder: the table that the first run has written is replaced, and the result is the same.
    """
    notebook = json.loads(path.read_text())
    figures = notebook_tool().run_cells(notebook)
    (axes,) = figures[-1].axes
    for label in (axes.get_xlabel(), axes.get_ylabel()):
        assert re.search(r"\w \[[^\]]+\]$", label), label
    assert axes.get_legend() is not None and len(axes.get_lines()) >= 3
    if path.stem == "sweep":
        (again,) = notebook_tool().run_cells(notebook)[-1].axes
        for one, other in zip(axes.get_lines(), again.get_lines(), strict=True):
            assert (one.get_xydata() == other.get_xydata()).all()


def run_all() -> None:
    """Run all; the first exception or failure ends the program."""
    from warp_rigid.commands import cli

    pages = [ROOT / "README.md", DOCS / "tutorials.md"]
    for command in commands(pages):
        if command.startswith("warp-rigid "):
            print(command, flush=True)
            status = cli.main(arguments_of(command))
            if status:
                sys.exit(f"status {status}: {command}")
    for program in blocks("python", pages):
        exec(compile(program, "program.py", "exec"), {"__name__": "__main__"})
    for path in NOTEBOOKS:
        print(path.name, flush=True)
        run_notebook(path)


if __name__ == "__main__":
    for change in (close_viewers_at_once, draw_small_pictures):
        change(lambda target, new: mock.patch(target, new).start())
    write_scene_files([DOCS / "tutorials.md"], Path())
    run_all()
    print("ran all")
