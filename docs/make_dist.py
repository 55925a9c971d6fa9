"""Build the wheel and the sdist of the last commit, of the same bytes every time: python docs/make_dist.py out/dist."""

import gzip
import io
import os
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUILD = "import sys; from setuptools import build_meta; print('\\n' + getattr(build_meta, sys.argv[1])(sys.argv[2]))"


def build(target: Path) -> list[Path]:
    """Build both into a folder and return their paths.

    The files are those of the commit, with its time and fixed permissions, and the setuptools of this interpreter
    builds them. The wheel is built from the sdist.
    """
    target = target.resolve()
    target.mkdir(parents=True, exist_ok=True)
    seconds = int(_git("log", "-1", "--format=%ct"))
    with tempfile.TemporaryDirectory() as folder:
        source, inner = Path(folder) / "source", Path(folder) / "sdist"
        _unpack(_git("-c", "tar.umask=0022", "archive", "HEAD"), source)
        sdist = _built("build_sdist", source, target, seconds)
        sdist.write_bytes(_repacked(sdist, seconds))
        _unpack(gzip.decompress(sdist.read_bytes()), inner)
        (unpacked,) = inner.iterdir()
        return [sdist, _built("build_wheel", unpacked, target, seconds)]


def _git(*arguments: str) -> bytes:
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True).stdout


def _unpack(archive: bytes, folder: Path) -> None:
    with tarfile.open(fileobj=io.BytesIO(archive)) as file:
        file.extractall(folder, filter="tar")


def _built(what: str, source: Path, target: Path, seconds: int) -> Path:
    """What setuptools builds of a folder; its wheels have the time SOURCE_DATE_EPOCH."""
    environment = {**os.environ, "SOURCE_DATE_EPOCH": str(seconds)}
    command = [sys.executable, "-c", BUILD, what, str(target)]
    options = {"cwd": source, "env": environment, "umask": 0o022}
    done = subprocess.run(command, check=True, capture_output=True, text=True, **options)
    return target / done.stdout.splitlines()[-1]


def _repacked(sdist: Path, seconds: int) -> bytes:
    """The sdist with the time of the commit, without users, and in the order of names."""
    plain, packed = io.BytesIO(), io.BytesIO()
    with tarfile.open(sdist) as old, tarfile.open(fileobj=plain, mode="w", format=tarfile.PAX_FORMAT) as new:
        for member in sorted(old.getmembers(), key=lambda member: member.name):
            member.mtime, member.uid, member.gid, member.uname, member.gname = seconds, 0, 0, "", ""
            member.pax_headers = {}
            new.addfile(member, old.extractfile(member) if member.isfile() else None)
    with gzip.GzipFile(fileobj=packed, mode="wb", mtime=seconds) as file:
        file.write(plain.getvalue())
    return packed.getvalue()


if __name__ == "__main__":
    for made in build(Path(sys.argv[1])):
        print(made)
