"""Files that are damaged, cut off or made by something else: meshes, recordings, checkpoints."""

import functools
import io
import json
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from hypothesis import strategies as st

import warp_rigid as wr
from tests.fuzz.harness import NUMBERS, Target, damaged
from tests.fuzz.shapes import use

SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".off", ".usda", ".usdc")

USDA = """#usda 1.0
( upAxis = "Z"
  metersPerUnit = 1 )
def Mesh "m" {
    int[] faceVertexCounts = [3, 3, 3, 3]
    int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
}
"""


@functools.cache
def mesh_file(suffix: str) -> bytes:
    """A tetrahedron in a file."""
    if suffix == ".usda":
        return USDA.encode()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"mesh{suffix}"
        if suffix == ".usdc":
            from pxr import Usd

            Usd.Stage.CreateInMemory()
            layer = Usd.Stage.CreateNew(str(path))
            layer.GetRootLayer().ImportFromString(USDA)
            layer.GetRootLayer().Save()
        else:
            solid = trimesh.creation.icosphere(subdivisions=0)
            solid.export(path)
        return path.read_bytes()


@st.composite
def mesh_files(draw: Any) -> tuple[str, bytes]:
    suffix = draw(st.sampled_from(SUFFIXES))
    return suffix, draw(st.one_of(damaged(mesh_file(suffix)), damaged(mesh_file(suffix)), st.binary(max_size=64)))


def try_mesh_file(case: tuple[str, bytes], folder: Path) -> None:
    suffix, content = case
    path = folder / f"mesh{suffix}"
    path.write_bytes(content)
    use(wr.Mesh.from_file(path, sdf_resolution=8))


@functools.cache
def saved(kind: str) -> bytes:
    """A recording or a checkpoint of a small scene."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1))
    scene.add_body(
        wr.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], 8)
    )
    sim = wr.Simulator(scene, num_envs=2, device="cpu")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        if kind == "recording":
            wr.record(sim, 2).save(path)
        else:
            sim.step(3)
            sim.save(path)
        return path.read_bytes()


@functools.cache
def members(kind: str) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(saved(kind))) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


PLAIN = st.recursive(
    st.one_of(NUMBERS, st.none(), st.booleans(), st.text(max_size=3)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=3), inner, max_size=2)),
    max_leaves=4,
)


@st.composite
def archives(draw: Any, kind: str) -> bytes:
    """Bytes changed at random, or one member changed inside an archive that is otherwise right."""
    if draw(st.booleans()):
        return draw(damaged(saved(kind)))
    parts = dict(members(kind))
    name = draw(st.sampled_from(sorted(parts)))
    how = draw(st.sampled_from(["missing", "bytes", "values", "header", "header"]))
    if how == "missing":
        del parts[name]
    elif how == "bytes":
        parts[name] = draw(damaged(parts[name]))
    elif how == "values" and name != "header.npy":
        array = np.load(io.BytesIO(parts[name])).copy()
        if array.size:
            place = draw(st.integers(0, array.size - 1))
            wild = draw(st.sampled_from([-1, 0, 1, 7, 127, 10**6, 2**31 - 1, -(2**31)]))
            array.reshape(-1)[place] = wild if array.dtype.kind != "b" else bool(wild)
        parts[name] = npy(array)
    else:
        header = json.loads(np.load(io.BytesIO(parts["header.npy"])).tobytes())
        change(draw, header)
        parts["header.npy"] = npy(np.frombuffer(json.dumps(header).encode(), np.uint8))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for member, content in parts.items():
            archive.writestr(member, content)
    return stream.getvalue()


def change(draw: Any, value: Any) -> None:
    """Replace one entry somewhere in plain data."""
    keys = sorted(value) if isinstance(value, dict) else list(range(len(value)))
    if not keys:
        return
    key = draw(st.sampled_from(keys))
    if isinstance(value[key], dict | list) and value[key] and draw(st.booleans()):
        change(draw, value[key])
    else:
        value[key] = draw(PLAIN)


def try_recording(content: bytes, folder: Path) -> None:
    (folder / "a.npz").write_bytes(content)
    recording = wr.Recording.load(folder / "a.npz")
    recording.rows()
    recording.save(folder / "b.npz")


def try_checkpoint(content: bytes, folder: Path) -> None:
    (folder / "a.ckpt").write_bytes(content)
    sim = wr.Simulator.load(folder / "a.ckpt", device="cpu")
    sim.step(2)
    sim.contacts()
    sim.penetration()


TARGETS = [
    Target("mesh files", mesh_files(), try_mesh_file),
    Target("recordings", archives("recording"), try_recording),
    Target("checkpoints", archives("checkpoint"), try_checkpoint),
]
