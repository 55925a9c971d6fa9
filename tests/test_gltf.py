"""The .glb file, read with a glTF reader that did not write it."""

import io
import json
import struct
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image

import warp_rigid as wr
from tests.fakes import FakeSimulator
from tests.oracles import rotation_matrix
from tests.textured_scene import MAP, textured_scene
from warp_rigid.commands import cli
from warp_rigid.render.appearance import spread_of
from warp_rigid.render.textures import embedded_image
from warp_rigid.scene.look import Look

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
    """The JSON of the file, and a function that reads an accessor."""
    return parsed(path)


def parsed(path):
    """A file's JSON and a function that reads an accessor, from the format's definition."""
    data = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size = struct.unpack("<I", data[12:16])[0]
    tree = json.loads(data[20 : 20 + size])
    blob = data[28 + size :]

    def read(index):
        accessor = tree["accessors"][index]
        view = tree["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
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


def test_ground_that_moves_has_its_heights_in_every_frame(tmp_path):
    """The morph targets of the format, against the heights of the shape; one environment was reset before."""
    heights, phase = np.array([[0, 0.1, 0], [0.2, 0, 0.1]]), np.arange(6).reshape(2, 3)
    ground = wr.Heightfield(heights, (2.0, 1.0), wr.HarmonicMotion(0.05 * (1 + heights), 9.0, phase))
    scene = wr.Scene()
    scene.add_kinematic(ground)
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 1))
    sim = wr.Simulator(scene, num_envs=2, device="cpu")
    sim.step(30)
    sim.reset(envs=[1])
    recording = wr.record(sim, 10, fps=30.0)
    wr.export_gltf(recording, tmp_path / "waves.glb")
    tree, read = parsed(tmp_path / "waves.glb")
    channels = [c for c in tree["animations"][0]["channels"] if c["target"]["path"] == "weights"]
    for channel, times in zip(channels, recording.times.T, strict=True):
        weights = read(tree["animations"][0]["samplers"][channel["sampler"]]["output"]).reshape(11, 2)
        mesh = tree["meshes"][tree["nodes"][channel["target"]["node"]]["mesh"]]
        assert mesh["weights"] == pytest.approx(weights[0])
        (primitive,) = mesh["primitives"]
        points = read(primitive["attributes"]["POSITION"])
        shapes = np.array([read(target["POSITION"]) for target in primitive["targets"]])
        for time, weight in zip(times, weights, strict=True):
            found = points + np.tensordot(weight, shapes, 1)
            np.testing.assert_allclose(found[:, 2], ground.height_at(found[:, :2], time), atol=1e-6)


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


@pytest.fixture(scope="module")
def textured(tmp_path_factory):
    """Path of a file with three bodies of one mesh, two of them with an image, and a compound of it and a box.

    The texture coordinates are a linear map of the places. Also the pixels of the image.
    """
    folder = tmp_path_factory.mktemp("textured")
    scene, pixels = textured_scene(folder)
    wr.export_gltf(wr.record(FakeSimulator(scene), 2), folder / "film.glb")
    return folder / "film.glb", pixels


def test_images_are_embedded_once_and_texture_coordinates_run_downward(textured):
    path, pixels = textured
    tree, read = parsed(path)
    (image,), (texture,) = tree["images"], tree["textures"]
    assert texture["source"] == 0 and image["mimeType"] == "image/png"
    assert all(tree["bufferViews"][entry["bufferView"]].get("byteOffset", 0) % 4 == 0 for entry in tree["accessors"])
    found = {node["name"]: tree["meshes"][node["mesh"]]["primitives"] for node in tree["nodes"] if "mesh" in node}
    assert found["body_0"] == found["body_1"] and [len(entry) for entry in found.values()] == [1, 1, 1, 2]
    for name in ("body_0", "body_3"):
        attributes, material = (found[name][0][key] for key in ("attributes", "material"))
        u, v = read(attributes["TEXCOORD_0"]).T
        np.testing.assert_allclose(np.stack([u, 1.0 - v]).T, read(attributes["POSITION"]) @ MAP.T, atol=1e-6)
        shading = tree["materials"][material]["pbrMetallicRoughness"]
        assert shading["baseColorTexture"]["index"] == 0 and shading["baseColorFactor"] == [1, 1, 1, 1]
        assert (shading["roughnessFactor"], shading["metallicFactor"]) == (0.25, 0.5)
    for plain in (found["body_2"][0], found["body_3"][1]):
        assert "TEXCOORD_0" not in plain["attributes"]
        assert "baseColorTexture" not in tree["materials"][plain["material"]]["pbrMetallicRoughness"]


def test_another_reader_finds_the_image_and_the_coordinates(textured):
    """Trimesh turns v upward again; the places are those of the mesh, before the node's pose."""
    path, pixels = textured
    meshes = trimesh.load(path, process=False).geometry.values()
    shown = [mesh for mesh in meshes if getattr(mesh.visual, "uv", None) is not None]
    assert len(shown) == 2
    for mesh in shown:
        np.testing.assert_allclose(mesh.visual.uv, mesh.vertices @ MAP.T, atol=1e-6)
        np.testing.assert_array_equal(np.asarray(mesh.visual.material.baseColorTexture.convert("RGB")), pixels)


@pytest.mark.parametrize(
    ("name", "mode", "media_type", "size"),
    [
        ("a.jpg", "RGB", "image/jpeg", (64, 32)),
        ("a.jpg", "CMYK", "image/jpeg", (64, 32)),
        ("a.bmp", "RGB", "image/png", (64, 32)),
        ("a.png", "I;16", "image/png", (64, 32)),
        ("a.png", "RGB", "image/png", (3000, 10)),
    ],
)
def test_images_of_other_formats_and_large_ones_are_converted(tmp_path, name, mode, media_type, size):
    Image.new("RGB" if mode == "CMYK" else mode, size).convert(mode).save(tmp_path / name)
    content, found = embedded_image(str(tmp_path / name))
    again = Image.open(io.BytesIO(content))
    assert found == media_type == Image.MIME[again.format] and again.mode == "RGB"
    assert again.size == (size if max(size) <= 2048 else (2048, 7))
    assert (content == (tmp_path / name).read_bytes()) == ((name, mode, size) == ("a.jpg", "RGB", (64, 32)))


def test_an_image_that_cannot_be_read_leaves_the_colour(tmp_path):
    (tmp_path / "image.png").write_bytes(b"no image")
    box = trimesh.creation.box((1, 1, 1))
    scene = wr.Scene()
    scene.add_body(wr.Mesh(box.vertices, box.faces, 16, uv=box.vertices @ MAP.T))
    scene.looks[0] = Look((0.125, 0.25, 0.5), image=tmp_path / "image.png")
    with pytest.warns(UserWarning, match="no image of a known format"):
        wr.export_gltf(wr.record(FakeSimulator(scene), 2), tmp_path / "film.glb")
    tree, _ = parsed(tmp_path / "film.glb")
    assert not tree.get("images") and not tree.get("textures")
    assert tree["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] == [0.125, 0.25, 0.5, 1]
