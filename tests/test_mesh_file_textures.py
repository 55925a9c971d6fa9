"""Texture coordinates and images of mesh files. A linear map holds at every corner, however the surface is divided."""

import warnings

import numpy as np
import pytest
import trimesh
from PIL import Image
from pxr import Sdf, Usd, UsdGeom

import warp_rigid as wr
from tests.test_polygons import L_OUTLINE, prism
from tests.test_textures import MAP, assert_mapped, checker
from tests.usd_tools import start_of
from warp_rigid.render.film import film_from_recording

POINTS, POLYGONS = prism(L_OUTLINE)
ST = np.round(POINTS @ MAP.T, 6)
CORNERS = np.concatenate(POLYGONS)


def write_obj(path, style):
    """Coordinates of the points, or one line for each corner, or counted from the end; with a material."""
    lines = ["mtllib the paint.mtl", *(f"v {x} {y} {z}" for x, y, z in POINTS)]
    at = 0
    if style != "corner":
        lines += [f"vt {u} {v}" for u, v in ST]
    for polygon in POLYGONS:
        names = [f"{k + 1}/{k + 1}" for k in polygon]
        if style == "negative":
            names = [f"{k - len(POINTS)}/{k - len(POINTS)}/1" for k in polygon]
        elif style == "corner":
            lines += [f"vt {u} {v} 0.0" for u, v in ST[polygon]]
            names = [f"{k + 1}/{at + n + 1}/" for n, k in enumerate(polygon)]
            at += len(polygon)
        lines.append("f " + " ".join(names))
    path.write_text("\n".join(lines) + "\n")
    (path.parent / "the paint.mtl").write_text("newmtl a\nKd 1 1 1\nmap_Kd -s 1 1 1 -clamp on my image.png\n")


def write_ply(path, style):
    lines = ["ply", "format ascii 1.0", "comment TextureFile my image.png", f"element vertex {len(POINTS)}"]
    names = {"s": "st", "u": "uv", "texture_u": ("texture_u", "texture_v")}.get(style, ())
    lines += [f"property float {name}" for name in (*"xyz", *names)]
    lines += [f"element face {len(POLYGONS)}", "property list uchar int vertex_indices"]
    lines += ["property list uchar float texcoord"] if style == "texcoord" else []
    rows = np.concatenate([POINTS, ST], axis=1) if names else POINTS
    lines += ["end_header", *(" ".join(map(str, row)) for row in rows.tolist())]
    for polygon in POLYGONS:
        of_corners = [2 * len(polygon), *ST[polygon].ravel().tolist()] if style == "texcoord" else []
        lines.append(" ".join(map(str, [len(polygon), *polygon, *of_corners])))
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("suffix", "style"),
    [
        *((".obj", style) for style in ("point", "corner", "negative")),
        *((".ply", style) for style in ("s", "u", "texture_u", "texcoord")),
    ],
)
def test_coordinates_of_polygons(tmp_path, suffix, style):
    checker(tmp_path / "my image.png")
    path = tmp_path / f"l{suffix}"
    (write_obj if suffix == ".obj" else write_ply)(path, style)
    mesh = wr.Mesh.from_file(path, sdf_resolution=16)
    assert len(mesh.faces) == 20 and mesh.image == str(tmp_path / "my image.png")
    assert_mapped(mesh)
    scaled = wr.Mesh.from_file(path, scale=0.5, sdf_resolution=16)
    assert_mapped(scaled, lambda places: 2.0 * places @ MAP.T)


def test_coordinates_of_binary_ply_files(tmp_path):
    """Lists of coordinates beside those of corners, as MeshLab writes them."""
    box = trimesh.creation.box((1, 1, 1))
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 8",
        *(f"property float {axis}" for axis in "xyz"),
    ]
    header += ["element face 12", "property list uchar int vertex_indices", "property list uchar float texcoord"]
    kinds = [("sides", "u1"), ("corners", "<i4", 3), ("count", "u1"), ("uv", "<f4", 6)]
    rows = np.zeros(12, kinds)
    rows["sides"], rows["corners"], rows["count"] = 3, box.faces, 6
    rows["uv"] = (box.vertices @ MAP.T)[box.faces].reshape(12, 6)
    content = "\n".join([*header, "end_header\n"]).encode() + box.vertices.astype("<f4").tobytes() + rows.tobytes()
    (tmp_path / "box.ply").write_bytes(content)
    mesh = wr.Mesh.from_file(tmp_path / "box.ply", sdf_resolution=16)
    assert len(mesh.faces) == 12 and mesh.image is None
    assert_mapped(mesh)


def textured(box, image, shift=0.0):
    """A box of trimesh with an image; every face has vertices of its own."""
    points, faces = box.vertices[box.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    visual = trimesh.visual.TextureVisuals(uv=(points + (shift, 0, 0)) @ MAP.T, material=material)
    return trimesh.Trimesh(points + (shift, 0, 0), faces, visual=visual, process=False)


def back(places):
    """From z up, as meshes of glTF files are turned, to y up, in which their coordinates were made."""
    return np.stack([places[..., 0], places[..., 2], -places[..., 1]], axis=-1)


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_coordinates_and_images_of_gltf_files(tmp_path, monkeypatch, suffix):
    """Two meshes with images of their own: the coordinates are not changed, and the first image is kept.

    The file needs not stay where it is: the image, which may be inside of it, is copied.
    """
    monkeypatch.setenv("WARP_RIGID_CACHE", str(tmp_path / "cache"))
    images = [Image.fromarray(checker(tmp_path / "a.png", size)) for size in (8, 16)]
    box = trimesh.creation.box((1, 1, 1))
    scene = trimesh.Scene([textured(box, images[0]), textured(box, images[1], 3.0)])
    (tmp_path / "files").mkdir()
    path = tmp_path / "files" / f"two{suffix}"
    scene.export(path)
    mesh = wr.Mesh.from_file(path, sdf_resolution=16)
    assert len(mesh.vertices) == 16 and len(mesh.faces) == 24
    assert_mapped(mesh, lambda places: back(places) @ MAP.T)
    np.testing.assert_array_equal(np.asarray(Image.open(mesh.image)), np.asarray(images[0]))
    assert wr.Mesh.from_file(path, sdf_resolution=16).image == mesh.image


def test_parts_without_coordinates(tmp_path):
    box = trimesh.creation.box((1, 1, 1))
    plain = trimesh.creation.box((1, 1, 1), transform=trimesh.transformations.translation_matrix((3, 0, 0)))
    trimesh.Scene([textured(box, Image.new("RGB", (4, 4))), plain]).export(tmp_path / "two.glb")
    mesh = wr.Mesh.from_file(tmp_path / "two.glb", sdf_resolution=16)
    first = mesh.vertices[mesh.faces][:, :, 0].max(axis=1) < 1.0
    np.testing.assert_allclose(mesh.uv[first], back(mesh.vertices[mesh.faces][first]) @ MAP.T, atol=1e-5)
    assert first.sum() == 12 and (mesh.uv[~first] == 0.0).all()


@pytest.mark.parametrize("change", [{}, {"mirror": True}, {"left_handed": True}])
def test_coordinates_of_usd_files(tmp_path, change):
    stage = Usd.Stage.CreateNew(str(tmp_path / "l.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    mesh = UsdGeom.Mesh.Define(stage, "/l")
    polygons = [polygon[::-1] for polygon in POLYGONS] if "left_handed" in change else POLYGONS
    mesh.CreatePointsAttr(POINTS)
    mesh.CreateFaceVertexCountsAttr([len(polygon) for polygon in polygons])
    mesh.CreateFaceVertexIndicesAttr(np.concatenate(polygons).tolist())
    if "left_handed" in change:
        mesh.CreateOrientationAttr("leftHanded")
    if "mirror" in change:
        mesh.AddScaleOp().Set((1, -1, 1))
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
    primvar.Set(ST[np.concatenate(polygons)])
    stage.Save()
    found = wr.Mesh.from_file(tmp_path / "l.usda", sdf_resolution=16)
    assert_mapped(found, lambda places: (places * (1, -1 if "mirror" in change else 1, 1)) @ MAP.T)
    assert found.image is None


def test_a_body_shows_the_image_of_its_file(tmp_path):
    pixels = checker(tmp_path / "my image.png")
    write_obj(tmp_path / "l.obj", "corner")
    scene = wr.Scene()
    mesh = wr.Mesh.from_file(tmp_path / "l.obj", sdf_resolution=16)
    scene.add_body(mesh)
    film = film_from_recording(start_of(scene))
    assert film.images == (str(tmp_path / "my image.png"),) and film.image.tolist() == [0]
    assert pixels.shape == (8, 8, 3) and scene.copy().looks == scene.looks


def test_an_image_of_a_trimesh_is_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_RIGID_CACHE", str(tmp_path / "cache"))
    box, image = trimesh.creation.box((1, 1, 1)), Image.fromarray(checker(tmp_path / "a.png"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its vertices are merged
        mesh = wr.Mesh.from_trimesh(textured(box, image), 16)
    assert_mapped(mesh)
    np.testing.assert_array_equal(np.asarray(Image.open(mesh.image)), np.asarray(image))


def test_a_missing_image_is_named(tmp_path):
    write_obj(tmp_path / "l.obj", "point")
    with pytest.warns(UserWarning) as found:
        mesh = wr.Mesh.from_file(tmp_path / "l.obj", sdf_resolution=16)
    assert mesh.image is None and mesh.uv is not None
    assert len(found) == 1 and f"image {tmp_path / 'my image.png'} does not exist" in str(found[0].message)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [("f 6/6", "f 6/99", "vt: there are 12, but a face names 99"), ("vt ", "vt x", "could not convert")],
)
def test_coordinates_that_do_not_match_are_refused(tmp_path, old, new, message):
    write_obj(tmp_path / "l.obj", "point")
    text = (tmp_path / "l.obj").read_text()
    assert old in text
    (tmp_path / "l.obj").write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        wr.Mesh.from_file(tmp_path / "l.obj")
