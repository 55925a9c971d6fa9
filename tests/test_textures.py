"""Texture coordinates and images: of meshes, read from USD, written again, and drawn."""

import warnings

import numpy as np
import pytest
import trimesh
from PIL import Image
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade
from scipy import ndimage

import warp_rigid as wr
from tests.usd_tools import start_of, validator_errors
from warp_rigid.render.appearance import linear_light
from warp_rigid.render.film import colored, film_from_recording, film_from_usd
from warp_rigid.render.framing import CameraPath
from warp_rigid.render.raycast import RayCaster
from warp_rigid.render.textures import mean_color
from warp_rigid.rotations import rotate
from warp_rigid.runs.recording import Recording
from warp_rigid.scene.look import Look
from warp_rigid.scene.serialization import scenes_from_data, scenes_to_data

L_OUTLINE = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], float)
MAP = np.array([[0.25, 0.5, -1.0], [0.75, -0.125, 0.5]])
"""A linear map from places to texture coordinates: it holds at every corner, however the surface is divided."""


def prism(left_handed=False):
    """Points and polygons of an L-shaped prism; two polygons are concave."""
    points = np.concatenate([np.column_stack([L_OUTLINE, np.full(6, z)]) for z in (0.0, 0.5)])
    sides = [[i, (i + 1) % 6, 6 + (i + 1) % 6, 6 + i] for i in range(6)]
    polygons = [[5, 4, 3, 2, 1, 0], [6, 7, 8, 9, 10, 11], *sides]
    return points, [polygon[::-1] for polygon in polygons] if left_handed else polygons


def checker(path, size=8):
    """An image of random colours, all different, and its pixels."""
    pixels = np.random.default_rng(1).integers(0, 256, (size, size, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(path)
    return pixels


def stage_with_prism(path, interpolation, st, *, indices=None, left_handed=False, scale=(1, 1, 1), varname="st"):
    """A file whose body is the prism, with coordinates and a texture."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    points, polygons = prism(left_handed)
    mesh = UsdGeom.Mesh.Define(stage, "/World/body")
    for api in (UsdPhysics.RigidBodyAPI, UsdPhysics.CollisionAPI, UsdPhysics.MeshCollisionAPI):
        api.Apply(mesh.GetPrim())
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr([len(polygon) for polygon in polygons])
    mesh.CreateFaceVertexIndicesAttr(np.concatenate(polygons).tolist())
    if left_handed:
        mesh.CreateOrientationAttr("leftHanded")
    mesh.AddScaleOp().Set(scale)
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(varname, Sdf.ValueTypeNames.TexCoord2fArray, interpolation)
    primvar.Set(st)
    if indices is not None:
        primvar.SetIndices(indices)
    paint(stage, mesh.GetPrim(), varname)
    stage.Save()
    return stage


def paint(stage, prim, varname="st", transform=None):
    """Bind a material with the image beside the file; its inputs are those of the material, as from other programs."""
    material = UsdShade.Material.Define(stage, "/World/paint")
    shader, image, reader = (
        UsdShade.Shader.Define(stage, f"/World/paint/{name}") for name in ("surface", "image", "reader")
    )
    for entry, kind in ((shader, "UsdPreviewSurface"), (image, "UsdUVTexture"), (reader, "UsdPrimvarReader_float2")):
        entry.CreateIdAttr(kind)
    file = material.CreateInput("file", Sdf.ValueTypeNames.Asset)
    file.Set(Sdf.AssetPath("./image.png"))
    image.CreateInput("file", Sdf.ValueTypeNames.Asset).ConnectToSource(file)
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(varname)
    coordinates = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    if transform is not None:
        between = UsdShade.Shader.Define(stage, "/World/paint/transform")
        between.CreateIdAttr("UsdTransform2d")
        between.CreateInput("in", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
        for name, value in transform.items():
            kind = Sdf.ValueTypeNames.Float if name == "rotation" else Sdf.ValueTypeNames.Float2
            between.CreateInput(name, kind).Set(value)
        coordinates = between.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
    rgb = image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(rgb)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)


def assert_mapped(shape, expected=lambda places: places @ MAP.T, orientation=(0, 0, 0, 1)):
    places = rotate(np.array(orientation), shape.vertices[shape.faces])
    np.testing.assert_allclose(shape.uv, expected(places), atol=1e-5)


@pytest.mark.parametrize("interpolation", ["vertex", "varying", "faceVarying", "indexed"])
@pytest.mark.parametrize("change", [{}, {"left_handed": True}, {"scale": (1, -1, 1)}, {"varname": "UVMap"}])
def test_coordinates_follow_the_corners_of_polygons(tmp_path, interpolation, change):
    pixels = checker(tmp_path / "image.png")
    points, polygons = prism("left_handed" in change)
    corners = np.concatenate(polygons)
    st = points @ MAP.T
    if interpolation == "faceVarying":
        stage_with_prism(tmp_path / "l.usda", interpolation, st[corners], **change)
    elif interpolation == "indexed":
        stage_with_prism(tmp_path / "l.usda", "faceVarying", st[::-1], indices=(11 - corners).tolist(), **change)
    else:
        stage_with_prism(tmp_path / "l.usda", interpolation, st, **change)
    scene = wr.import_usd(tmp_path / "l.usda")
    mirror = np.array(change.get("scale", (1, 1, 1)))
    assert len(scene.bodies[0].shape.faces) == 20
    assert_mapped(scene.bodies[0].shape, lambda places: (places * mirror) @ MAP.T, scene.bodies[0].orientation)
    assert scene.looks[0].image == str(tmp_path / "image.png")
    light = np.where(pixels / 255 <= 0.04045, pixels / 255 / 12.92, ((pixels / 255 + 0.055) / 1.055) ** 2.4)
    assert np.allclose(scene.looks[0].color, light.reshape(-1, 3).mean(axis=0), atol=1e-6)


def test_coordinates_of_whole_polygons(tmp_path):
    checker(tmp_path / "image.png")
    _, polygons = prism()
    stage_with_prism(tmp_path / "l.usda", "uniform", [(k, 10 + k) for k in range(len(polygons))])
    shape = wr.import_usd(tmp_path / "l.usda").bodies[0].shape
    normals = np.cross(*(shape.vertices[shape.faces[:, k]] - shape.vertices[shape.faces[:, 0]] for k in (1, 2)))
    assert (shape.uv[normals[:, 2] < -1e-9] == (0, 10)).all() and (shape.uv[normals[:, 2] > 1e-9] == (1, 11)).all()
    assert (np.ptp(shape.uv, axis=1) == 0).all() and len(np.unique(shape.uv[:, 0, 0])) == 8


def test_the_transform_of_a_material_is_applied(tmp_path):
    """Scale, then a counterclockwise turn, then a translation, as UsdTransform2d states."""
    checker(tmp_path / "image.png")
    points, _ = prism()
    stage = stage_with_prism(tmp_path / "l.usda", "vertex", points @ MAP.T)
    body = stage.GetPrimAtPath("/World/body")
    paint(stage, body, transform={"scale": (2.0, 3.0), "rotation": 90.0, "translation": (0.5, 0.25)})
    stage.Save()
    shape = wr.import_usd(tmp_path / "l.usda").bodies[0].shape
    assert_mapped(shape, lambda places: (places @ MAP.T * (2, 3))[..., ::-1] * (-1, 1) + (0.5, 0.25))


@pytest.mark.parametrize("st", [[(0, 0)] * 5, [(np.nan, 0)] * 12])
def test_coordinates_that_do_not_match_are_reported(tmp_path, st):
    checker(tmp_path / "image.png")
    stage_with_prism(tmp_path / "l.usda", "vertex", st)
    scene = wr.import_usd(tmp_path / "l.usda")
    assert scene.bodies[0].shape.uv is None and scene.looks[0].image is None and scene.looks[0].color is not None
    assert "primvars:st" in str(scene.import_report)


@pytest.mark.filterwarnings("ignore:mesh repaired")
def test_coordinates_follow_repairs():
    box = trimesh.creation.box((1, 1, 1))
    points = box.vertices[box.faces].reshape(-1, 3)
    faces = np.arange(36).reshape(-1, 3)
    faces[[2, 5]] = faces[[2, 5]][:, ::-1]
    faces = np.concatenate([faces, faces[:1][:, [1, 2, 0]], [[0, 0, 1]]])
    for uv in (points @ MAP.T, (points @ MAP.T)[faces]):
        mesh = wr.Mesh(points, faces, 16, uv=uv)
        assert len(mesh.repairs) == 4 and len(mesh.faces) == 12
        assert_mapped(mesh)


@pytest.mark.filterwarnings("ignore:mesh repaired")
@pytest.mark.parametrize("shift", [(0.5, 0.25, 0.125), (1.0, 0.0, 0.0)])
def test_coordinates_follow_the_union_of_shells(shift):
    box = trimesh.creation.box((1, 1, 1))
    points = np.concatenate([box.vertices, box.vertices + shift])
    faces = np.concatenate([box.faces, box.faces + 8])
    mesh = wr.Mesh(points, faces, 16, uv=points @ MAP.T)
    plain = wr.Mesh(points, faces, 16)
    assert mesh.watertight and "union" in mesh.repairs[-1] and mesh.volume == pytest.approx(plain.volume, rel=1e-9)
    assert_mapped(mesh)


def test_meshes_differ_by_their_coordinates_and_keep_them_in_files(tmp_path):
    box = trimesh.creation.box((1, 1, 1))
    plain = wr.Mesh(box.vertices, box.faces, 16)
    mesh = wr.Mesh(box.vertices, box.faces, 16, uv=box.vertices @ MAP.T)
    assert mesh != plain and mesh == wr.Mesh(box.vertices, box.faces, 16, uv=(box.vertices @ MAP.T)[box.faces])
    scene = wr.Scene()
    scene.add_body(mesh)
    scene.add_body(wr.Compound([(plain, (0, 0, 0), (0, 0, 0, 1)), (mesh, (0, 0, 1), (0, 0, 0, 1))]), position=(3, 0, 0))
    checker(tmp_path / "image.png")
    scene.looks[0] = Look(image=tmp_path / "image.png")
    (again,) = scenes_from_data(*scenes_to_data([scene]))
    assert again.bodies[0].shape == mesh and again.looks == scene.looks
    np.testing.assert_array_equal(again.bodies[0].shape.uv, mesh.uv)
    uv = again.bodies[1].shape.surface_uv()
    assert np.isnan(uv[:12]).all() and (uv[12:] == mesh.uv).all()


@pytest.mark.parametrize(
    ("uv", "message"), [(np.zeros((7, 2)), "uv: must be shaped"), (np.full((8, 2), np.inf), "uv: must be finite")]
)
def test_coordinates_that_are_refused(uv, message):
    box = trimesh.creation.box((1, 1, 1))
    with pytest.raises(ValueError, match=f"^{message}"):
        wr.Mesh(box.vertices, box.faces, 16, uv=uv)


def test_an_image_must_be_a_path():
    with pytest.raises(ValueError, match=r"^image: must be the path of a file, got 3"):
        Look(image=3)


@pytest.mark.parametrize("name", ["missing.png", "missing.usdz[image.png]"])
def test_an_image_must_exist(tmp_path, name):
    with pytest.raises(FileNotFoundError) as error:
        Look(image=tmp_path / name)
    assert str(error.value) == f"image: no such file: {tmp_path / name}"


def imported(folder):
    """The scene of a file with a textured prism, in a folder of its own."""
    folder.mkdir()
    checker(folder / "image.png")
    points, polygons = prism()
    stage_with_prism(folder / "l.usda", "faceVarying", (points @ MAP.T)[np.concatenate(polygons)])
    return wr.import_usd(folder / "l.usda")


def textured_meshes(path):
    """By pxr alone: of each mesh with an image, its corners, their coordinates and the path of the image."""
    found, stage = [], Usd.Stage.Open(str(path))
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
        if not prim.IsA(UsdGeom.Mesh) or not material:
            continue
        sources = material.ComputeSurfaceSource()[0].GetInput("diffuseColor").GetConnectedSources()[0]
        texture = UsdShade.Shader(sources[0].source.GetPrim()) if sources else None
        if texture is None or texture.GetIdAttr().Get() != "UsdUVTexture":
            continue
        (coordinates,) = texture.GetInput("st").GetConnectedSources()[0]
        reader = UsdShade.Shader(coordinates.source.GetPrim())
        assert reader.GetIdAttr().Get() == "UsdPrimvarReader_float2"
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(reader.GetInput("varname").Get())
        assert primvar.GetInterpolation() == "faceVarying"
        corners = np.array(prim.GetAttribute("faceVertexIndices").Get())
        points = np.array(prim.GetAttribute("points").Get())[corners]
        found.append((points, np.array(primvar.Get()), texture.GetInput("file").Get()))
    return found


@pytest.mark.parametrize("profile", ["scene", "animation"])
@pytest.mark.parametrize(
    ("suffix", "layout"),
    [(".usda", "single"), (".usdc", "single"), (".usdc", "payloads"), (".usda", "clips"), (".usdz", "single")],
)
def test_textures_are_written(tmp_path, profile, layout, suffix):
    scene = imported(tmp_path / "assets")
    scene.add_body(scene.bodies[0].shape, position=(5, 0, 0), name="plain")
    path = tmp_path / "out" / f"film{suffix}"
    wr.export_usd(start_of(scene), path, profile=profile, layout=layout)
    ((points, uv, asset),) = textured_meshes(path)
    np.testing.assert_allclose(uv, points @ MAP.T, atol=1e-5)
    if suffix == ".usdz":
        assert asset.resolvedPath.startswith(str(path)) and mean_color(asset.resolvedPath) == scene.looks[0].color
    else:
        assert asset.path.startswith("../") and asset.resolvedPath == str(tmp_path / "assets" / "image.png")
    assert validator_errors(path) == []


def test_a_package_without_the_image_has_the_colour(tmp_path):
    scene = imported(tmp_path / "assets")
    recording, image = start_of(scene), tmp_path / "assets" / "image.png"
    image.unlink()
    with pytest.warns(UserWarning, match="no such file") as found:
        wr.export_usd(recording, tmp_path / "film.usdz", profile="scene")
    assert len(found) == 1 and str(found[0].message).startswith(f"{image}: ")
    assert textured_meshes(tmp_path / "film.usdz") == []
    assert np.allclose(wr.import_usd(tmp_path / "film.usdz").looks[0].color, scene.looks[0].color)


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_textures_survive_a_round_trip(tmp_path, suffix):
    scene = imported(tmp_path / "assets")
    path = tmp_path / f"film{suffix}"
    wr.export_usd(start_of(scene), path, profile="scene")
    again = wr.import_usd(path)
    assert again.bodies[0].shape == scene.bodies[0].shape
    np.testing.assert_array_equal(again.bodies[0].shape.uv, scene.bodies[0].shape.uv)
    look = again.looks[0]
    assert look.color == scene.looks[0].color
    assert look.image == (scene.looks[0].image if suffix != ".usdz" else f"{path}[textures/0_image.png]")
    wr.export_usd(start_of(again), tmp_path / "again.usdz", profile="scene")
    final = wr.import_usd(tmp_path / "again.usdz")
    assert final.bodies[0].shape == scene.bodies[0].shape and final.looks[0].color == look.color


def test_a_compound_keeps_the_coordinates_of_its_meshes(tmp_path):
    """Those of the box, which has none, are projected."""
    box = trimesh.creation.box((1, 1, 1))
    mesh = wr.Mesh(box.vertices, box.faces, 16, uv=box.vertices @ MAP.T)
    scene = wr.Scene()
    parts = [(wr.Box((0.5, 0.5, 0.5)), (0, 0, 0), (0, 0, 0, 1)), (mesh, (0, 0, 1), (0, 0, 0, 1))]
    checker(tmp_path / "image.png")
    scene.looks[scene.add_body(wr.Compound(parts))] = Look((0.5, 0.5, 0.5), image=tmp_path / "image.png")
    wr.export_usd(start_of(scene), tmp_path / "film.usda", profile="scene")
    ((points, uv, _),) = textured_meshes(tmp_path / "film.usda")
    np.testing.assert_allclose(uv[36:], (points[36:] - (0, 0, 1)) @ MAP.T, atol=1e-6)
    assert np.isfinite(uv).all()
    again = wr.import_usd(tmp_path / "film.usda")
    assert again.looks[0].image == str(tmp_path / "image.png")
    (first, _, _), (second, _, _) = again.bodies[0].shape.children
    assert first == parts[0][0] and (second.uv == mesh.uv).all()


def test_other_colourings_replace_the_images_of_dynamic_bodies(tmp_path):
    scene = imported(tmp_path / "assets")
    scene.looks[scene.add_static(scene.bodies[0].shape, position=(5, 0, 0))] = scene.looks[0]
    wr.export_usd(start_of(scene), tmp_path / "film.usda", profile="scene", color="level")
    assert len(textured_meshes(tmp_path / "film.usda")) == 1


def test_recordings_keep_coordinates(tmp_path):
    recording = start_of(imported(tmp_path / "assets"))
    recording.save(tmp_path / "film.npz")
    again = Recording.load(tmp_path / "film.npz")
    np.testing.assert_array_equal(again.surfaces[0].uv, recording.surfaces[0].uv)
    assert again.looks == recording.looks


def slab(folder, pixels, repeat=1.0):
    """A slab from -1 to 1 whose upper side shows an image upright as seen from above, x to the right and y up."""
    Image.fromarray(pixels).save(folder / "image.png")
    box = trimesh.creation.box((2, 2, 0.2))
    mesh = wr.Mesh(box.vertices, box.faces, 16, uv=repeat * 0.5 * (box.vertices[:, :2] + 1.0))
    scene = wr.Scene(camera=wr.Camera(position=(0.0, -1e-3, 4.0), look_at=(0, 0, 0), field_of_view=40.0))
    scene.add_static(mesh)
    return scene


def seen(film, size=240):
    """A function of a point of the upper side: the screen colour (3,) of its pixel, 0 to 1, and the pixel's place."""
    view = CameraPath([film], [0], size, size).at(0)
    picture = RayCaster(film, view).draw(0, size, size) / 255.0
    eye, forward, right, up = (np.array(getattr(view, name)) for name in ("eye", "forward", "right", "up"))

    def at(x, y):
        ray = np.array((x, y, 0.1)) - eye
        ray /= ray @ forward
        column, row = (round(0.5 * size * (1.0 + s * (ray @ a) / (a @ a)) - 0.5) for s, a in ((1, right), (-1, up)))
        ray = forward + ((2 * column + 1) / size - 1) * right + (1 - (2 * row + 1) / size) * up
        return picture[row, column], (eye + (0.1 - eye[2]) / ray[2] * ray)[:2]

    return at


def plain_color(scene, color, x, y):
    """The screen colour of the same point of a body of one colour, under the same light."""
    scene.looks = {0: Look(tuple(color), 1.0, 0.0)}
    return seen(film_from_recording(start_of(scene)))(x, y)[0]


def interpolated(light, place):
    """Linear light at a place of the slab, from SciPy's interpolation of an image that repeats."""
    height, width = light.shape[:2]
    row, column = 0.5 * (1.0 - place[1]) * height - 0.5, 0.5 * (place[0] + 1.0) * width - 0.5
    return [ndimage.map_coordinates(light[..., k], [[row], [column]], order=1, mode="grid-wrap")[0] for k in range(3)]


@pytest.mark.parametrize("origin", ["recording", "scene", "animation"])
def test_pictures_show_the_texels_at_their_places(tmp_path, origin):
    """Centres of texels, a place between them, and one at the border; the first row is on top.

    The tolerance is a step of the screen values at the bright end, 0.009 in linear light.
    """
    pixels = np.random.default_rng(3).integers(0, 256, (4, 4, 3)).astype(np.uint8)
    scene = slab(tmp_path, pixels)
    scene.looks[0] = Look((0.5, 0.5, 0.5), 1.0, 0.0, tmp_path / "image.png")
    recording = start_of(scene)
    if origin == "recording":
        film = film_from_recording(recording)
    else:
        wr.export_usd(recording, tmp_path / "film.usdc", profile=origin)
        film = film_from_usd(tmp_path / "film.usdc")
    at, light = seen(film), linear_light(pixels.astype(float))
    for x, y in ((-0.75, 0.75), (0.75, 0.75), (0.25, 0.25), (-0.25, -0.75), (0.0, 0.25), (0.95, -0.4)):
        color, place = at(x, y)
        expected = plain_color(scene, interpolated(light, place), x, y)
        np.testing.assert_allclose(linear_light(255 * color), linear_light(255 * expected), atol=0.01)


def test_images_repeat_and_blur_from_afar(tmp_path):
    """Three repetitions of a checker of 2 x 2 texels; and one finer than the pixels, which has its mean light."""
    coarse = np.zeros((2, 2, 3), np.uint8)
    coarse[0, 0] = coarse[1, 1] = 255
    scene = slab(tmp_path, coarse, repeat=3.0)
    scene.looks[0] = Look(None, 1.0, 0.0, tmp_path / "image.png")
    at = seen(film_from_recording(start_of(scene)))
    for i, j in np.ndindex(6, 6):
        value = at(-1 + (i + 0.5) / 3, -1 + (j + 0.5) / 3)[0].mean()
        assert value < 0.35 if (i + j) % 2 == 0 else value > 0.7
    fine = np.kron(np.indices((512, 512)).sum(axis=0) % 2, np.ones((2, 2)))[..., None] * np.full(3, 255)
    scene = slab(tmp_path, fine.astype(np.uint8))
    scene.looks[0] = Look(None, 1.0, 0.0, tmp_path / "image.png")
    at = seen(film_from_recording(start_of(scene)))
    expected = plain_color(scene, (0.5, 0.5, 0.5), 0.0, 0.0)
    for x, y in ((0.0, 0.0), (0.3, -0.7), (-0.55, 0.21)):
        np.testing.assert_allclose(at(x, y)[0], expected, atol=0.02)


@pytest.mark.parametrize("repeat", [1e9, 1e30, 3e38])
def test_images_that_repeat_too_often_to_be_seen_are_drawn(tmp_path, repeat):
    """The number of texels of a pixel was infinite, and the size of the image for it outside of all sizes."""
    scene = slab(tmp_path, np.full((4, 4, 3), 255, np.uint8), repeat)
    scene.looks[0] = Look(None, 1.0, 0.0, tmp_path / "image.png")
    at = seen(film_from_recording(start_of(scene)))
    assert at(0.3, 0.2)[0].min() > 0.7


def told(act):
    """The result of a call, and the messages of its warnings."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        result = act()
    return result, [str(one.message) for one in found]


@pytest.mark.parametrize("content", [b"no image", None, b"half"])
def test_an_image_that_cannot_be_read_leaves_the_colour_and_is_named_once(tmp_path, content):
    """Also of a recording that was saved while the image was there."""
    image = tmp_path / "image.png"
    scene = slab(tmp_path, np.zeros((64, 64, 3), np.uint8))
    scene.looks[0] = Look((0.2, 0.4, 0.6), 1.0, 0.0, image)
    start_of(scene).save(tmp_path / "film.npz")
    half = image.read_bytes()[:60]
    image.unlink()
    if content is not None:
        image.write_bytes(half if content == b"half" else content)
    recording = Recording.load(tmp_path / "film.npz")
    assert recording.looks == scene.looks
    film = film_from_recording(recording)
    at, messages = told(lambda: seen(film))
    np.testing.assert_array_equal(at(0.0, 0.0)[0], plain_color(scene, (0.2, 0.4, 0.6), 0.0, 0.0))
    assert len(messages) == 1 and messages[0].startswith(f"{image}: ") and "\n" not in messages[0]
    assert told(lambda: seen(film))[1] == []


@pytest.mark.parametrize("content", [b"no image", None])
def test_an_image_that_a_file_lacks_is_named_once_and_reported(tmp_path, content):
    """Two bodies have it; both have the fallback of the texture."""
    points, _ = prism()
    stage = stage_with_prism(tmp_path / "l.usda", "vertex", points @ MAP.T)
    fallback = UsdShade.Shader.Get(stage, "/World/paint/image").CreateInput("fallback", Sdf.ValueTypeNames.Float4)
    fallback.Set((0.1, 0.2, 0.3, 1.0))
    Sdf.CopySpec(stage.GetRootLayer(), "/World/body", stage.GetRootLayer(), "/World/other")
    stage.Save()
    if content is not None:
        (tmp_path / "image.png").write_bytes(content)
    scene, messages = told(lambda: wr.import_usd(tmp_path / "l.usda"))
    assert len(messages) == 1 and messages[0].startswith(f"{tmp_path / 'image.png'}: ")
    assert [finding.path for finding in scene.import_report.changed] == ["/World/body", "/World/other"]
    assert np.allclose([look.color for look in scene.looks.values()], (0.1, 0.2, 0.3)) and len(scene.looks) == 2


def test_a_colouring_hides_the_images_of_dynamic_bodies(tmp_path):
    recording = start_of(imported(tmp_path / "assets"))
    film = film_from_recording(recording)
    assert film.image.tolist() == [0] and colored(film, recording, "level").image.tolist() == [-1]
