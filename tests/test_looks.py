"""Looks of bodies: read from UsdPreviewSurface, drawn, kept in files and written again."""

import numpy as np
import pytest
from PIL import Image
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

import warp_rigid as wr
from warp_rigid.render.film import film_from_recording, film_from_usd
from warp_rigid.render.framing import CameraPath
from warp_rigid.render.raycast import RayCaster
from warp_rigid.runs.recording import Recording
from warp_rigid.scene.look import Look
from warp_rigid.scene.serialization import scenes_from_data, scenes_to_data


def recorded(scene, frames=1):
    return wr.record(wr.Simulator(scene, device="cpu"), frames=frames)


def stage_with_ball(path, display_color=None):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    ball = UsdGeom.Sphere.Define(stage, "/World/ball")
    for api in (UsdPhysics.RigidBodyAPI, UsdPhysics.CollisionAPI):
        api.Apply(ball.GetPrim())
    if display_color is not None:
        ball.CreateDisplayColorAttr([display_color])
    return stage, ball.GetPrim()


def surface_of(stage, prim, **inputs):
    material = UsdShade.Material.Define(stage, "/World/paint")
    shader = UsdShade.Shader.Define(stage, "/World/paint/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    for name, value in inputs.items():
        kind = Sdf.ValueTypeNames.Color3f if name == "diffuseColor" else Sdf.ValueTypeNames.Float
        shader.CreateInput(name, kind).Set(value)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)
    return shader


def test_preview_surfaces_are_read(tmp_path):
    stage, ball = stage_with_ball(tmp_path / "ball.usda")
    surface_of(stage, ball, diffuseColor=(0.1, 0.2, 0.3), roughness=0.25, metallic=1.0)
    stage.Save()
    (look,) = wr.import_usd(tmp_path / "ball.usda").looks.values()
    assert np.allclose(look.color, (0.1, 0.2, 0.3)) and (look.roughness, look.metallic) == (0.25, 1.0)


def test_display_colours_are_read_and_are_matt(tmp_path):
    stage, _ = stage_with_ball(tmp_path / "ball.usda", (0.5, 0.25, 0.125))
    stage.Save()
    assert wr.import_usd(tmp_path / "ball.usda").looks == {0: Look((0.5, 0.25, 0.125), 1.0, 0.0)}


def test_an_image_is_read_as_its_mean_light(tmp_path):
    """Half of the image is white, half black: half of the light, which is not half of the screen value."""
    pixels = np.zeros((32, 64, 3), np.uint8)
    pixels[:, :32] = 255
    Image.fromarray(pixels).save(tmp_path / "image.png")
    stage, ball = stage_with_ball(tmp_path / "ball.usda")
    shader = surface_of(stage, ball, roughness=0.5)
    texture = UsdShade.Shader.Define(stage, "/World/paint/image")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath("./image.png"))
    output = texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(output)
    stage.Save()
    assert np.allclose(wr.import_usd(tmp_path / "ball.usda").looks[0].color, 0.5, atol=0.01)
    (tmp_path / "image.png").write_bytes(b"no image")
    assert wr.import_usd(tmp_path / "ball.usda").looks[0].color is None


def painted():
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    for i in range(3):
        scene.add_body(wr.Sphere(0.2), position=(0.6 * i, 0, 0.2), name=f"ball_{i}")
    scene.looks = {1: Look((0.8, 0.1, 0.1), 0.25, 1.0), 3: Look(None, 0.5, 0.0)}
    return scene


def test_looks_are_kept_in_files(tmp_path):
    scene = painted()
    assert scene.copy().looks == scenes_from_data(*scenes_to_data([scene]))[0].looks == scene.looks
    recording = recorded(scene)
    recording.save(tmp_path / "film.npz")
    assert Recording.load(tmp_path / "film.npz").looks == recording.looks == scene.looks


@pytest.mark.parametrize("profile", ["scene", "animation"])
def test_looks_are_written_as_preview_surfaces(tmp_path, profile):
    recording = recorded(painted())
    path = tmp_path / "film.usda"
    wr.export_usd(recording, path, profile=profile)
    memory, film = film_from_recording(recording), film_from_usd(path)
    order, expected = np.argsort(film.body), np.argsort(memory.body)
    assert np.allclose(film.gloss[order], memory.gloss[expected])
    assert np.allclose(film.color[order], memory.color[expected])
    assert np.allclose(film.color[order][1], (0.8, 0.1, 0.1))
    if profile == "scene":
        stage = Usd.Stage.Open(str(path))
        shape = next(
            prim
            for prim in Usd.PrimRange(stage.GetPrimAtPath("/World/env_0000/ball_0"), Usd.TraverseInstanceProxies())
            if prim.IsA(UsdGeom.Mesh)
        )
        shader = UsdShade.MaterialBindingAPI(shape).ComputeBoundMaterial()[0].ComputeSurfaceSource()[0]
        values = {name: shader.GetInput(name).Get() for name in ("diffuseColor", "roughness", "metallic")}
        assert np.allclose(values.pop("diffuseColor"), (0.8, 0.1, 0.1)) and values == {"roughness": 0.25, "metallic": 1}
        again = wr.import_usd(path).looks
        assert set(again) == {1, 3} and (again[1].roughness, again[1].metallic) == (0.25, 1.0)


@pytest.mark.parametrize("profile", ["scene", "animation"])
def test_meshes_have_texture_coordinates(tmp_path, profile):
    """The sides of a box show the image upright and undistorted: lengths on the image are those on the box."""
    scene = wr.Scene()
    scene.add_body(wr.Box((0.4, 0.2, 0.1)), position=(0, 0, 1))
    wr.export_usd(recorded(scene), tmp_path / "film.usda", profile=profile)
    stage = Usd.Stage.Open(str(tmp_path / "film.usda"))
    meshes = [p for p in stage.Traverse(Usd.TraverseInstanceProxies()) if p.IsA(UsdGeom.Mesh)]
    primvar = UsdGeom.PrimvarsAPI(meshes[0]).GetPrimvar("st")
    assert primvar.GetInterpolation() == "faceVarying"
    st = np.array(primvar.Get()).reshape(-1, 3, 2)
    faces = np.array(meshes[0].GetAttribute("faceVertexIndices").Get()).reshape(-1, 3)
    points = np.array(meshes[0].GetAttribute("points").Get())[faces]
    assert st.min() == 0.0 and st.max() == 1.0
    for corner in range(3):
        on_image = np.linalg.norm(st[:, corner] - st[:, corner - 1], axis=1)
        on_box = np.linalg.norm(points[:, corner] - points[:, corner - 1], axis=1)
        assert np.allclose(on_image, on_box / 0.8, atol=1e-6)


def brightness(look):
    """Brightest and mean screen values of a ball of a look, seen from above."""
    scene = wr.Scene(camera=wr.Camera.orbit(-90.0, 40.0, look_at=(0, 0, 0), distance=3.0))
    ball = scene.add_body(wr.Sphere(0.5))
    scene.looks = {} if look is None else {ball: look}
    film = film_from_recording(recorded(scene, 0))
    view = CameraPath([film], [0], 80, 80).at(0)
    picture = RayCaster(film, view).draw(0, 80, 80)[25:55, 25:55].astype(float)
    return picture.max(), picture.mean(axis=(0, 1))


def test_smooth_surfaces_have_highlights_and_metals_lose_their_matt_light():
    colour = (0.3, 0.05, 0.05)
    matt, shiny = brightness(Look(colour, 1.0, 0.0)), brightness(Look(colour, 0.2, 0.0))
    assert shiny[0] > matt[0] + 60 and abs(shiny[1] - matt[1]).max() < 30
    metal = brightness(Look(colour, 0.2, 1.0))
    assert metal[1][0] > 2.0 * metal[1][2]


@pytest.mark.parametrize(
    ("values", "name"), [(((2, 0, 0),), "color"), (((0, 0, 0), -0.1), "roughness"), (((0, 0, 0), 0.5, 1.5), "metallic")]
)
def test_looks_outside_their_range_are_refused(values, name):
    with pytest.raises(ValueError, match=f"^{name}: "):
        Look(*values)


@pytest.mark.parametrize(
    ("looks", "told"),
    [
        ({"ball": Look()}, r"scene\.looks: index of a body: must be a whole number from 0 to 0, got 'ball'"),
        ({1: Look()}, r"scene\.looks: index of a body: must be a whole number from 0 to 0, got 1"),
        ({0: (1, 0, 0)}, r"scene\.looks\[0\]: must be a Look"),
        ([Look()], r"scene\.looks: must be a dictionary"),
    ],
)
def test_looks_of_no_body_and_of_other_types_are_refused_before_the_start(looks, told):
    """They were tracebacks when the first picture was drawn."""
    scene = wr.Scene()
    scene.add_body(wr.Sphere(0.5), name="ball")
    scene.looks = looks
    with pytest.raises(ValueError, match=f"^{told}"):
        wr.Simulator(scene, device="cpu")
