"""Inputs that fuzzing found to end in a traceback, a hang or several lines; each is refused in one line now."""

import ast
from pathlib import Path

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid.files import archive
from warp_rigid.runs.assignments import sort_assignments
from warp_rigid.runs.recording import steps_per_frame

HUGE = 10**5000


def no_parameters():
    """Stands in for a scene that has none."""


@pytest.mark.parametrize(
    ("attempt", "field"),
    [
        (lambda: wr.Heightfield(["\xad", [[1.0]]], (1, 1)), "heights"),
        (lambda: wr.Heightfield({}, (1, 1)), "heights"),
        (lambda: wr.Mesh({}, [[0, 1, 2]]), "vertices"),
        (lambda: wr.Mesh([[0, 0, 0], [1, 0]], [[0, 1, 2]]), "vertices"),
        (lambda: wr.Mesh(np.eye(3), [[0, 1, 2], [0]]), "faces"),
        (lambda: wr.Mesh.from_trimesh(np.eye(3)), "mesh"),
        (lambda: wr.Sphere(HUGE), "radius"),
        (lambda: wr.Sphere([[1.0], []]), "radius"),
        (lambda: wr.Box({}), "half_extents"),
        (lambda: wr.Settings(dt=HUGE), "dt"),
        (lambda: wr.Settings(sleeping=np.zeros((99, 99))), "sleeping"),
        (lambda: sort_assignments(["9" * 5000], no_parameters), "--set"),
        (lambda: steps_per_frame(1 / 240, 1e-300), "fps"),
        (lambda: steps_per_frame(1 / 240, float("inf")), "fps"),
    ],
)
def test_refused_in_one_short_line(attempt, field):
    with pytest.raises(ValueError) as error:
        attempt()
    text = str(error.value)
    assert text.startswith(f"{field}:") and "\n" not in text and len(text) < 400


def test_a_mass_of_thousands_of_digits_is_no_number():
    scene = wr.Scene()
    scene.add_body(wr.Sphere(0.1))
    sim = wr.Simulator(scene, device="cpu")
    with pytest.raises(ValueError, match="^mass: must be numbers"):
        sim.set("mass", 10**746)


@pytest.mark.parametrize("value", ["-" * 20_000 + "1", "(" * 20_000, "{[]:1}"])
def test_values_that_python_cannot_read_are_words(value):
    assert sort_assignments([f"mass={value}"], no_parameters).properties == {"mass": value}


@pytest.mark.parametrize(
    "header", [b"{'descr': '|u1', \0", b"{'descr': '|u1', 'shape': (142,), ", b"(" * 100, b"{'descr': '|O'}"]
)
def test_members_with_a_broken_header_are_refused(tmp_path, header):
    import zipfile

    with zipfile.ZipFile(tmp_path / "a", "w") as file:
        file.writestr("header.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(ValueError, match="not a thing of warp_rigid"):
        archive.load(tmp_path / "a", "thing", 1)


def test_a_place_before_the_file_is_refused(tmp_path):
    archive.save(tmp_path / "a", "thing", 1, {}, {"x": np.zeros(9)})
    content = (tmp_path / "a").read_bytes()
    for size in range(1, 60, 7):
        (tmp_path / "a").write_bytes(content[size:])
        with pytest.raises(ValueError, match="not a thing of warp_rigid"):
            archive.load(tmp_path / "a", "thing", 1)


def test_nothing_that_is_read_can_be_run():
    """No pickles, no shell and no evaluated text; only a scene, metric or cluster in a .py file is a program."""
    root = Path(wr.__file__).parent
    for file in (*root.rglob("*.py"), *(root / "scenes").glob("*.py"), *(root / "kernels").glob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {alias.name for alias in node.names} | {getattr(node, "module", "")}
                assert not names & {"pickle", "marshal", "shelve", "dill", "cloudpickle", "runpy"}, file
            elif isinstance(node, ast.Call):
                if isinstance(node.func, ast.Name):
                    assert node.func.id not in ("eval", "exec", "compile", "__import__"), (file, node.lineno)
                elif isinstance(node.func, ast.Attribute):
                    assert node.func.attr != "exec_module" or file.name == "user_code.py", (file, node.lineno)
                given = {word.arg: getattr(word.value, "value", None) for word in node.keywords}
                assert "shell" not in given and given.get("allow_pickle", False) is False, (file, node.lineno)
