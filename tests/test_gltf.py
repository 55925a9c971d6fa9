"""The .glb file, read with a glTF reader that did not write it."""

import json
import struct
import sys

import numpy as np
import pytest
import trimesh

import warp_rigid as wr
from tests.fakes import FakeSimulator
from tests.oracles import rotation_matrix
from warp_rigid.commands import cli
from warp_rigid.render.appearance import spread_of

FRAMES = 20
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
"""From z up to y up."""


@pytest.fixture(scope="module")
def recording():
    scene = wr.Scene()
    scene.add_static(wr.Box((1.0, 1.0, 0.1)), name="table")
    scene.add_body(wr.Box((0.1, 0.2, 0.3)), position=(0.5, 0.0, 2.0), name="brick")
    scene.add_body(wr.Box((0.1, 0.2, 0.3)), position=(-0.5, 0.0, 2.0), name="brick")
    return wr.record(FakeSimulator(scene, num_envs=2), FRAMES, fps=30.0)


@pytest.fixture(scope="module")
def path(recording, tmp_path_factory):
    path = tmp_path_factory.mktemp("gltf") / "made" / "film.glb"
    wr.export_gltf(recording, path)
    return path


@pytest.fixture(scope="module")
def content(path):
    """The file's JSON and a function that reads an accessor, from the format's definition."""
    data = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size = struct.unpack("<I", data[12:16])[0]
    tree = json.loads(data[20 : 20 + size])
    blob = data[28 + size :]

    def read(index):
        accessor = tree["accessors"][index]
        view = tree["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        dtype = {5126: np.float32, 5125: np.uint32}[accessor["componentType"]]
        found = np.frombuffer(blob, dtype, accessor["count"] * width, view.get("byteOffset", 0))
        return found.reshape(-1, width)

    return tree, read


def nodes_by_place(tree):
    """Index of each body's node by environment and body."""
    (world,) = tree["scenes"][0]["nodes"]
    envs = tree["nodes"][world]["children"]
    return {(e, b): child for e, env in enumerate(envs) for b, child in enumerate(tree["nodes"][env]["children"])}


def test_first_frame_is_where_another_reader_sees_it(path, recording):
    """Trimesh puts the nodes together by itself; y is up there."""
    scene = trimesh.load(path, process=False)
    searched = sorted(tuple(mesh.bounds.round(4).ravel()) for mesh in scene.dump())
    offsets = np.array([[-0.5, 0, 0], [0.5, 0, 0]])
    wanted = []
    offsets = offsets * spread_of(recording).spacing()[0]
    for row in range(2):
        for body in range(3):
            vertices = recording.surfaces[recording.surface[body]].vertices
            turned = vertices @ rotation_matrix(recording.orientation[0, row, body].astype(float)).T
            world = (turned + recording.position[0, row, body] + offsets[row]) @ UPRIGHT.T
            wanted.append((*world.min(axis=0).round(4), *world.max(axis=0).round(4)))
    np.testing.assert_allclose(searched, sorted(wanted), atol=2e-4)


def test_every_frame_is_the_recordings(content, recording):
    tree, read = content
    (animation,) = tree["animations"]
    nodes = nodes_by_place(tree)
    moved = set()
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        np.testing.assert_allclose(read(sampler["input"])[:, 0], np.arange(FRAMES + 1) / 30.0, rtol=1e-6)
        row, body = next(key for key, node in nodes.items() if node == channel["target"]["node"])
        values = read(sampler["output"])
        if channel["target"]["path"] == "translation":
            np.testing.assert_array_equal(values, recording.position[:, row, body])
        else:
            wanted = recording.orientation[:, row, body]
            assert (np.abs(np.sum(values * wanted, axis=1)) > 1 - 1e-6).all()
            assert (np.sum(values[1:] * values[:-1], axis=1) > 0).all()
        moved.add((row, body))
    assert moved == {(row, body) for row in range(2) for body in (1, 2)}


def test_equal_bodies_share_their_arrays(content):
    tree, _ = content
    nodes = nodes_by_place(tree)
    meshes = [tree["meshes"][tree["nodes"][nodes[0, body]]["mesh"]] for body in (1, 2)]
    positions = [mesh["primitives"][0]["attributes"]["POSITION"] for mesh in meshes]
    assert positions[0] == positions[1]


def test_the_command_line_writes_it(capsys, tmp_path, monkeypatch):
    path = tmp_path / "film.glb"
    arguments = ["run", "box_stack", "--frames", "2", "--device", "cpu", "-o", str(path)]
    assert cli.main([*arguments, "--picture", str(tmp_path / "a.png")]) == 0
    assert path.read_bytes()[:4] == b"glTF" and (tmp_path / "a.png").is_file()
    monkeypatch.setitem(sys.modules, "pygltflib", None)
    assert cli.main(arguments) == 2
    assert "pip install 'warp-rigid[gltf]'" in capsys.readouterr().err


def test_bad_arguments_are_named(recording, tmp_path):
    with pytest.raises(ValueError, match="path: must end in .glb"):
        wr.export_gltf(recording, tmp_path / "a.gltf")
    with pytest.raises(ValueError, match="envs: "):
        wr.export_gltf(recording, tmp_path / "a.glb", envs=[5])
