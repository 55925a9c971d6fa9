"""Commands that would overwrite a file that they read are refused, whatever name it is given by."""

import os

import pytest

import warp_rigid as wr
from tests.usd_tools import moved, rigid, write_stage
from warp_rigid.commands import cli
from warp_rigid.usd.instancing import flatten_usd


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A stage that refers to another one, and links to it."""
    write_stage(tmp_path / "part.usda", rigid("Ball", "Sphere", moved(0, 0, 3)))
    write_stage(tmp_path / "m.usda", 'def Xform "Both" (\n prepend references = @./part.usda@\n)\n{\n}\n')
    os.symlink(tmp_path / "m.usda", tmp_path / "link.usda")
    os.link(tmp_path / "m.usda", tmp_path / "hard.usda")
    monkeypatch.chdir(tmp_path)
    return {path.name: path.read_bytes() for path in tmp_path.iterdir()}


def assert_refused(capsys, tmp_path, files, name, *arguments):
    status = cli.main(list(arguments))
    err = capsys.readouterr().err.splitlines()
    assert status == 2 and err[-1] == f"warp-rigid: {name}: must not be a file that is read, which would be overwritten"
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == files


@pytest.mark.parametrize("name", ["m.usda", "./m.usda", "link.usda", "hard.usda", "part.usda"])
def test_run_does_not_overwrite_what_it_reads(capsys, tmp_path, files, name):
    assert_refused(capsys, tmp_path, files, name, "run", "m.usda", "--frames", "1", "-o", name)


def test_run_does_not_overwrite_its_input_by_a_checkpoint(capsys, tmp_path, files):
    given = ("--checkpoint", "m.usda", "--checkpoint-every", "1")
    assert_refused(capsys, tmp_path, files, "m.usda", "run", "m.usda", "--frames", "2", *given)


def test_flatten_does_not_overwrite_what_it_reads(capsys, tmp_path, files):
    assert_refused(capsys, tmp_path, files, "m.usda", "usd", "flatten", "m.usda", "m.usda")
    with pytest.raises(ValueError, match=r"^part\.usda: must not be a file that is read"):
        flatten_usd("m.usda", "part.usda")


def test_other_names_are_written(tmp_path, files):
    assert cli.main(["run", "m.usda", "--frames", "1", "-o", "new.usda", "--device", "cpu"]) == 0
    assert wr.import_usd("new.usda").import_report.files == (str(tmp_path / "new.usda"),)
    assert {path: (tmp_path / path).read_bytes() for path in files} == files
