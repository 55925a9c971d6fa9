"""Cameras: where they stand, against projections worked out by hand; in scenes, files and on the command line."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from pxr import Gf, Usd, UsdGeom

import warp_rigid as wr
from warp_rigid.commands.cli import main
from warp_rigid.render.film import film_from_recording, film_from_usd
from warp_rigid.render.framing import CameraPath, fit_camera, points_to_see
from warp_rigid.runs import runner
from warp_rigid.runs.recording import Recording
from warp_rigid.scene.camera import camera_of_text
from warp_rigid.scene.serialization import scenes_from_data, scenes_to_data

WIDTH, HEIGHT = 320, 180


def falling(camera=None):
    """A ball that falls, and one that lies 3 m away."""
    scene = wr.Scene(camera=camera)
    scene.add_static(wr.Plane())
    scene.add_body(wr.Sphere(0.2), position=(0.0, 0.0, 4.0), name="high")
    scene.add_body(wr.Sphere(0.2), position=(3.0, 0.0, 0.2), name="low")
    return scene


def recorded(camera=None, frames=6):
    return wr.record(wr.Simulator(falling(camera), device="cpu"), frames=frames, fps=60)


def on_picture(view, point):
    """Where a point is in the picture: right and up, from -1 to 1, and its depth [m]."""
    eye, forward, right, up = (np.array(getattr(view, name)) for name in ("eye", "forward", "right", "up"))
    away = np.asarray(point) - eye
    depth = away @ forward
    return np.array([away @ side / (side @ side) / depth for side in (right, up)]), depth


def view_of(recording, frame=0):
    return CameraPath([film_from_recording(recording)], [0, recording.num_frames], WIDTH, HEIGHT).at(frame)


def test_a_camera_looks_from_its_position_at_its_point():
    view = view_of(recorded(wr.Camera(position=(3, -1, 2), look_at=(0, 0.5, 1), field_of_view=40)))
    middle, depth = on_picture(view, (0, 0.5, 1))
    assert np.allclose(np.array(view.eye), (3, -1, 2)) and np.allclose(middle, 0.0, atol=1e-6)
    assert depth == pytest.approx(np.sqrt(9 + 2.25 + 1), rel=1e-6)
    # The upper border is 20 degrees above the axis; the picture is upright.
    up = np.array(view.up) / np.linalg.norm(np.array(view.up))
    border = np.array(view.eye) + np.array(view.forward) + np.tan(np.radians(20.0)) * up
    assert np.allclose(on_picture(view, border)[0], (0.0, 1.0), atol=1e-6) and up[2] > 0.0


def test_from_straight_above_x_points_right():
    view = view_of(recorded(wr.Camera(position=(0, 0, 9), look_at=(0, 0, 0))))
    at, _ = on_picture(view, (1.0, 0.5, 0.0))
    assert at[0] > 0.0 and at[1] > 0.0


def test_orbit_keeps_the_moving_bodies_in_view_from_its_direction():
    recording = recorded(wr.Camera.orbit(30.0, 10.0, field_of_view=50.0))
    view = view_of(recording)
    expected = np.cos(np.radians(10.0)) * np.array((np.cos(np.radians(30.0)), np.sin(np.radians(30.0)), 0.0))
    assert np.allclose(-np.array(view.forward), expected + (0, 0, np.sin(np.radians(10.0))), atol=1e-6)
    for frame in (0, 6):
        for position in recording.position[frame, 0, 1:]:
            assert np.abs(on_picture(view, position)[0]).max() < 1.0


def test_orbit_at_a_distance_and_around_a_point():
    view = view_of(recorded(wr.Camera.orbit(-90.0, 0.0, look_at=(1, 2, 3), distance=5.0)))
    assert np.allclose(np.array(view.eye), (1, -3, 3))
    around = view_of(recorded(wr.Camera.orbit(-90.0, 0.0, look_at=(0, 0, 1))))
    assert np.allclose(on_picture(around, (0, 0, 1))[0], 0.0, atol=1e-6)
    assert np.abs(on_picture(around, (3.0, 0.0, 0.2))[0]).max() < 1.0


def test_follow_keeps_its_body_in_the_middle_at_the_same_distance():
    recording = recorded(wr.Camera.follow("high", -90.0, 20.0, distance=2.0), frames=30)
    for frame in (0, 15, 30):
        at, depth = on_picture(view_of(recording, frame), recording.position[frame, 0, 1])
        assert np.allclose(at, 0.0, atol=1e-4) and depth == pytest.approx(2.0, rel=1e-4)
    assert recording.position[0, 0, 1, 2] - recording.position[30, 0, 1, 2] > 1.0


def test_pictures_of_a_follow_camera_show_the_body(tmp_path):
    from warp_rigid.render.images import save_picture

    film = film_from_recording(recorded(wr.Camera.follow(1), frames=30))
    save_picture(film, tmp_path / "ball.png", 30, 160, 90)
    middle = np.asarray(Image.open(tmp_path / "ball.png").convert("RGB")).astype(int)[40:50, 75:85]
    assert (np.ptp(middle, axis=-1) > 40).all()


def test_large_static_bodies_do_not_shrink_the_picture():
    """A table of 10 m, and a pole far away, change nothing; a small table beside the bodies is in view."""

    def reach(*fixed):
        scene = falling()
        for half, position in fixed:
            scene.add_static(wr.Box(half), position=position)
        film = film_from_recording(wr.record(wr.Simulator(scene, device="cpu"), frames=6))
        return points_to_see(film, [0, 6])

    alone = reach()
    assert np.array_equal(alone, reach(((5, 5, 0.1), (0, 0, -0.2)), ((0.1, 0.1, 1.0), (40, 0, 1))))
    assert len(reach(((0.3, 0.3, 0.3), (1.5, 0, 0.3)))) == len(alone) + 8


def test_a_single_frame_frames_the_bodies_that_may_move():
    scene = falling()
    scene.add_static(wr.Box((5, 5, 0.1)), position=(0, 0, -0.2))
    film = film_from_recording(wr.record(wr.Simulator(scene, device="cpu"), frames=0))
    assert np.abs(points_to_see(film, [0])).max() < 4.5


def test_cameras_of_scenes_are_kept_in_files(tmp_path):
    for camera in (None, wr.Camera((1, 2, 3), (0, 0, 0.1), 33.0), wr.Camera.follow("high", 10.0, 20.0, distance=3.0)):
        scene = falling(camera)
        assert scene.copy().camera == scenes_from_data(*scenes_to_data([scene]))[0].camera == camera
        sim = wr.Simulator(scene, device="cpu")
        sim.save(tmp_path / "state.ckpt")
        assert wr.Simulator.load(tmp_path / "state.ckpt", device="cpu").scene.camera == camera
        recording = wr.record(sim, frames=1)
        recording.save(tmp_path / "film.npz")
        assert Recording.load(tmp_path / "film.npz").camera == recording.camera
        assert recording.camera == (camera if camera is None or camera.body is None else replace(camera, body=1))


@pytest.mark.parametrize(
    "camera",
    [
        wr.Camera((3, -1, 2), (0.1, 0.2, 0.3), 33.0),
        wr.Camera.orbit(20, 30, distance=4),
        wr.Camera.follow("low", -10, 5.5, distance=2.25),
        wr.Camera(),
    ],
)
def test_text_of_a_camera_makes_the_camera(camera):
    assert camera_of_text(str(camera)) == camera


def test_a_recording_may_have_another_camera_than_its_scene():
    camera = wr.Camera((1, 0, 0), (0, 0, 0))
    sim = wr.Simulator(falling(wr.Camera.orbit(5.0)), device="cpu")
    assert wr.record(sim, frames=1, camera=camera).camera == camera


def test_a_film_may_have_another_camera_than_its_recording(tmp_path):
    recording, low = recorded(), wr.Camera.follow("low", distance=2.0)
    for name, film, options in (
        ("own", recording, {}),
        ("other", recording, {"camera": low}),
        ("kept", recorded(low), {}),
    ):
        film.to_gif(tmp_path / f"{name}.gif", width=64, **options)
    own, other, kept = ((tmp_path / f"{name}.gif").read_bytes() for name in ("own", "other", "kept"))
    assert other == kept != own and recording.camera is None
    with pytest.raises(ValueError, match="camera: there is no body 'nobody' to follow"):
        recording.show(camera=wr.Camera.follow("nobody"))


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: wr.Camera(position=(1, 2, 3)), "look_at"),
        (lambda: wr.Camera((1, 2, 3), (1, 2, 3)), "look_at"),
        (lambda: wr.Camera((1, 2), (0, 0, 0)), "position"),
        (lambda: wr.Camera((1, 2, 3), (0, 0, np.nan)), "look_at"),
        (lambda: wr.Camera((1, 2, 3), (0, 0, 0), 0.5), "field_of_view"),
        (lambda: wr.Camera.orbit(400.0), "azimuth"),
        (lambda: wr.Camera.orbit(elevation=91), "elevation"),
        (lambda: wr.Camera.orbit(distance=0), "distance"),
        (lambda: wr.Camera.follow(-1), "body"),
        (lambda: wr.Camera.follow(""), "body"),
        (lambda: wr.Scene(camera="above"), "camera"),
        (lambda: recorded(wr.Camera.follow("hihg")), "camera"),
        (lambda: recorded(wr.Camera.follow(3)), "camera"),
        (lambda: camera_of_text("position=1,2"), "position"),
        (lambda: camera_of_text("zoom=3"), "camera"),
        (lambda: camera_of_text("distance=far"), "camera"),
        (lambda: camera_of_text("distance=1 distance=2"), "camera"),
    ],
)
def test_bad_cameras_are_refused_by_name(make, name):
    with pytest.raises(ValueError, match=f"^{name}: "):
        make()


def usd_scene(path, up="Z", unit=1.0, **attributes):
    """A file with a ball, and a camera at (3, -1, 2) m that looks at the origin."""
    scene = wr.Scene()
    scene.add_body(wr.Sphere(0.2), position=(0, 0, 1), name="ball")
    wr.export_usd(wr.record(wr.Simulator(scene, device="cpu"), frames=0), path, profile="scene")
    stage = Usd.Stage.Open(str(path))
    stage.RemovePrim("/World/Camera")
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    camera = UsdGeom.Camera.Define(stage, "/World/Shot")
    matrix = Gf.Matrix4d().SetLookAt(Gf.Vec3d(3, -1, 2) / unit, Gf.Vec3d(0, 0, 0), Gf.Vec3d(0, 0, 1)).GetInverse()
    camera.AddTransformOp().Set(matrix)
    for name, value in attributes.items():
        camera.GetPrim().GetAttribute(name).Set(value)
    stage.Save()
    return stage


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_cameras_of_usd_files_are_read(tmp_path, unit):
    usd_scene(tmp_path / "scene.usda", unit=unit, focalLength=50.0, verticalAperture=24.0)
    scene = wr.import_usd(tmp_path / "scene.usda")
    camera = scene.camera
    assert scene.import_report.cameras == {"/World/Shot": camera}
    assert np.allclose(camera.position, (3, -1, 2), atol=1e-6)
    ahead = np.subtract(camera.look_at, camera.position)
    assert np.allclose(ahead / np.linalg.norm(ahead), np.array((-3, 1, -2)) / np.sqrt(14), atol=1e-6)
    assert camera.field_of_view == pytest.approx(2 * np.degrees(np.arctan(12.0 / 50.0)), rel=1e-6)


def test_an_orthographic_camera_is_left_out(tmp_path):
    usd_scene(tmp_path / "scene.usda", projection="orthographic")
    with pytest.warns(UserWarning, match="left out"):
        scene = wr.import_usd(tmp_path / "scene.usda")
    assert scene.camera is None and [finding.path for finding in scene.import_report.left_out] == ["/World/Shot"]


@pytest.mark.parametrize("profile", ["scene", "animation"])
@pytest.mark.parametrize(
    "camera", [wr.Camera((3, -1, 2), (0, 0, 0.5), 40.0), wr.Camera.follow("high", distance=2.0), wr.Camera.orbit(10.0)]
)
def test_cameras_are_written_to_usd(tmp_path, profile, camera):
    """The prim, evaluated by USD, sees what the camera of the picture sees; the film of the file has the camera."""
    recording = recorded(camera, frames=30)
    wr.export_usd(recording, tmp_path / "film.usdc", profile=profile)
    assert film_from_usd(tmp_path / "film.usdc").camera == recording.camera
    stage = Usd.Stage.Open(str(tmp_path / "film.usdc"))
    prim = UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera"))
    for frame in (0, 30):
        seen = prim.GetCamera(frame)
        assert seen.GetFieldOfView(Gf.Camera.FOVVertical) == pytest.approx(camera.field_of_view, rel=1e-5)
        frustum = seen.frustum
        if camera.look_at is not None or camera.body is not None:
            view = view_of(recording, frame)
            assert np.allclose(frustum.GetPosition(), np.array(view.eye), atol=1e-4)
            assert np.allclose(frustum.ComputeViewDirection(), np.array(view.forward), atol=1e-5)
        else:
            for position in recording.position[frame, 0, 1:]:
                assert frustum.Intersects(Gf.Vec3d(*position.astype(float).tolist()))
    if profile == "scene":
        assert wr.import_usd(tmp_path / "film.usdc").camera == recording.camera


def test_of_several_environments_a_camera_shows_the_first(tmp_path):
    sim = wr.Simulator(falling(wr.Camera((3, -1, 2), (0, 0, 0.5))), num_envs=2, device="cpu")
    wr.export_usd(wr.record(sim, frames=1), tmp_path / "film.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "film.usdc"))
    place = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/World/env_0000")).ExtractTranslation()
    frustum = UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera")).GetCamera(0).frustum
    assert np.allclose(frustum.GetPosition() - place, (3, -1, 2), atol=1e-6)


def test_command_line_cameras(tmp_path, capsys):
    usd_scene(tmp_path / "scene.usda")
    command = [
        "run",
        str(tmp_path / "scene.usda"),
        "--frames",
        "2",
        "--device",
        "cpu",
        "-o",
        str(tmp_path / "out.usdc"),
    ]
    for text, position in (("Shot", (3, -1, 2)), ("position=1,2,3 look_at=0,0,1", (1, 2, 3))):
        assert main([*command, "--camera", text]) == 0
        camera = film_from_usd(tmp_path / "out.usdc").camera
        assert np.allclose(camera.position, position, atol=1e-6)
    assert main([*command, "--camera", "follow=ball distance=2"]) == 0
    assert film_from_usd(tmp_path / "out.usdc").camera == wr.Camera.follow(0, distance=2.0)
    capsys.readouterr()
    for wrong in ("Shto", "follow=bal", "elevation=100", "position=1,2,3"):
        assert main([*command, "--camera", wrong]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_fitted_cameras_of_any_direction_hold_all_points():
    points = np.random.default_rng(3).normal(size=(40, 3))
    for camera in (wr.Camera.orbit(0, 90), wr.Camera.orbit(123, -90, field_of_view=80), wr.Camera.orbit(-200, 45)):
        view = fit_camera(points, 1.5, 100, camera)
        assert max(np.abs(on_picture(view, point)[0]).max() for point in points) < 1.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nobody", r"camera: must be values such as .* \(the scene has no cameras of its own\), got 'nobody'"),
        ("fov=30", "camera: unknown value 'fov'; .*field_of_view"),
        ("azimuth=3 field_of_view", "camera: must be NAME=VALUE with spaces between them, got 'field_of_view'"),
    ],
)
def test_messages_about_cameras_of_the_command_line(text, message):
    demo = runner.find_scene("seesaw")
    with pytest.raises(ValueError, match=message):
        runner.plan_run(demo, device="cpu", camera=text)
