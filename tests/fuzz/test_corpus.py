"""Files that once took too long or too much memory, or ended in a traceback, used in every way again."""

from pathlib import Path

import pytest

from tests.fuzz import files, harness, sweeps, usd

CORPUS = sorted((Path(__file__).parent / "corpus").iterdir())


def uses(suffix: str):
    """Functions(content, folder) for the files of a format."""
    if suffix.startswith(".usd"):
        for use in dict.fromkeys(usd.USES):
            yield lambda content, folder, use=use: usd.try_file((suffix, content, use), folder)
    elif suffix == ".npz":
        yield files.try_recording
    elif suffix == ".ckpt":
        yield files.try_checkpoint
    elif suffix == ".parquet":
        for use in ("read", "merge", "resume", "plot", "replay"):
            yield lambda content, folder, use=use: sweeps.try_table((content, use), folder)
    else:
        yield lambda content, folder: files.try_mesh_file((suffix, content), folder)


@pytest.mark.parametrize("file", CORPUS, ids=lambda file: file.name)
def test_past_failures_end_well(file, tmp_path):
    for attempt in uses(file.suffix):
        harness.check(harness.Target(file.name, None, attempt), file.read_bytes(), tmp_path)
