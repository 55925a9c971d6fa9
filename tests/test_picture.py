"""Pictures against projections worked out by hand, and the same from memory and from USD."""

import subprocess
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.ndimage import binary_erosion

from tests.fakes import FakeSimulator
from warp_rigid import Box, Camera, Heightfield, Mesh, Plane, Scene, Simulator, Sphere
from warp_rigid.render.appearance import level_colors, on_screen, speed_colors
from warp_rigid.render.film import colored, film_from_recording, film_from_usd
from warp_rigid.render.framing import AFTERMATH, CameraPath, event_end, fit_camera, points_to_see
from warp_rigid.render.images import save_contact_sheet, save_film, save_picture
from warp_rigid.render.raycast import CUT, RayCaster
from warp_rigid.runs.recording import record
from warp_rigid.scenes.builders import stacks
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.builders.grounds import level_scene
from warp_rigid.usd import export_usd

RADIUS = 0.5


def film_of(scene, frames=6, num_envs=1):
    return film_from_recording(record(FakeSimulator(scene, num_envs), frames))


def camera_of(film, width=160, height=120, frame=0):
    return fit_camera(points_to_see(film, [frame]), width / height, height)


def rays(camera, width, height):
    """Unit directions through the pixels' centres, (height, width, 3), from the camera's fields."""
    forward, right, up = (np.array(v) for v in (camera.forward, camera.right, camera.up))
    x = (2 * np.arange(width) + 1) / width - 1
    y = 1 - (2 * np.arange(height) + 1) / height
    direction = forward + x[None, :, None] * right + y[:, None, None] * up
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def passes_sphere(start, direction, center):
    """Whether rays, from one point or many, come within RADIUS of a centre."""
    ahead = np.sum((center - start) * direction, axis=-1, keepdims=True)
    return np.linalg.norm(center - start - ahead * direction, axis=-1) < RADIUS


@pytest.fixture(scope="module")
def ball():
    scene = Scene()
    scene.add_static(Plane(), name="ground")
    scene.add_body(Sphere(RADIUS), position=(0.3, -0.2, 2.0), name="ball")
    return film_of(scene)


@pytest.fixture(scope="module")
def ball_picture(ball):
    camera = camera_of(ball, 320, 240)
    return camera, RayCaster(ball, camera).draw(0, 320, 240).astype(float) / 255.0


def is_colourful(picture):
    """Bodies are; ground and sky are nearly grey."""
    return np.ptp(picture, axis=-1) > 0.15


def test_sphere_is_drawn_where_geometry_puts_it(ball_picture):
    camera, picture = ball_picture
    expected = passes_sphere(np.array(camera.eye), rays(camera, 320, 240), np.array([0.3, -0.2, 2.0]))
    assert 0.05 < expected.mean() < 0.7
    # The sphere's triangles cut its rim a little short.
    assert (is_colourful(picture) != expected).mean() < 0.01


def test_shadow_lies_where_the_light_is_hidden():
    scene = Scene()
    scene.add_static(Plane(), name="ground")
    scene.add_body(Sphere(RADIUS), position=(0.0, 0.0, 0.8))
    scene.add_body(Sphere(RADIUS), position=(3.0, 0.0, 3.0))
    film = film_of(scene)
    camera = camera_of(film)
    camera.grid = 1e6  # no lines
    camera.haze = 1e6
    camera.lamp_radius = 0.0  # sharp shadows
    picture = RayCaster(film, camera).draw(0, 160, 120).astype(float) / 255.0
    eye, direction, light = np.array(camera.eye), rays(camera, 160, 120), np.array(camera.light)
    with np.errstate(divide="ignore"):
        point = eye - (eye[2] / direction[..., 2])[..., None] * direction
    ground = (direction[..., 2] < 0) & (np.abs(point[..., :2]) < 10.0).all(axis=-1)
    dark = np.zeros_like(ground)
    for center in ([0.0, 0.0, 0.8], [3.0, 0.0, 3.0]):
        ground &= ~passes_sphere(eye, direction, np.array(center))
        dark |= passes_sphere(point, light, np.array(center))
    brightness = picture.mean(axis=-1)
    # Pixels on a border mix both sides: only those with all neighbours on their own side count.
    shadow = brightness[binary_erosion(ground & dark, np.ones((3, 3)))]
    bright = brightness[binary_erosion(ground & ~dark, np.ones((3, 3)))]
    assert len(shadow) > 100 and len(bright) > 1000
    assert shadow.max() < bright.min() - 0.02


def test_ground_reaches_the_horizon():
    """Below a body that is 50 m from the origin there is ground, up to the horizon."""
    scene = Scene()
    scene.add_static(Plane())
    scene.add_body(Sphere(RADIUS), position=(50.0, -40.0, 2.0))
    film = film_of(scene)
    camera = fit_camera(points_to_see(film, [0]), 4 / 3, 120, Camera.orbit(-67.0, 3.0))
    camera.grid = 1e6
    camera.haze = 1e6
    picture = RayCaster(film, camera).draw(0, 160, 120) / 255.0
    height = rays(camera, 160, 120)[..., 2]
    plain = ~is_colourful(picture)
    # The sky is blue; the ground is not, except in the shadow of the ball.
    ground = picture[..., 0] > picture[..., 2]
    assert ground[plain & (height < -0.01)].mean() > 0.9 and ground[plain & (height > 0.01)].mean() < 0.01


def falling_then_still(frames=120):
    """A ball that moves for 60 frames, and then lies still."""
    scene = Scene()
    scene.add_static(Plane())
    for i in range(3):
        scene.add_body(Sphere(RADIUS), position=(i, 0, 20.0))
    film = film_of(scene, frames)
    position, orientation = film.position.copy(), film.orientation.copy()
    position[60:], orientation[60:] = position[60], orientation[60]
    return replace(film, position=position, orientation=orientation)


def test_films_end_when_the_event_does(tmp_path):
    film = falling_then_still(240)
    assert event_end(film) == 60 + round(AFTERMATH * film.fps)
    save_film(film, tmp_path / "film.gif", 80, 60)
    assert Image.open(tmp_path / "film.gif").n_frames == (60 + round(AFTERMATH * 60)) // 3 + 1


def test_camera_follows_and_keeps_the_bodies_in_view():
    """Balls come together from afar: at the end the camera is much closer, and always holds them all."""
    scene = Scene()
    for _ in range(6):
        scene.add_body(Sphere(RADIUS), position=(0, 0, 0))
    film = film_of(scene, 180)
    angle = np.arange(6) * np.pi / 3
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    size = np.linspace(40.0, 1.5, 181) + 2 * np.sin(np.arange(181))
    film = replace(film, position=(size[:, None, None] * circle).astype(np.float32))
    path = CameraPath([film], range(181), 160, 90)
    eyes = np.array([np.array(path.at(frame).eye) for frame in range(181)])
    for frame in range(181):
        camera = path.at(frame)
        offset = points_to_see(film, [frame]) - np.array(camera.eye)
        for side in (np.array(camera.right), np.array(camera.up)):
            assert np.abs(offset @ side / (side @ side) / (offset @ np.array(camera.forward))).max() < 1.0
    assert np.linalg.norm(eyes[-1]) < 0.25 * np.linalg.norm(eyes[0])
    # The path has no jumps, although the bodies shake.
    steps = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    assert steps.max() < 3.0 * steps.mean()


def test_camera_looks_over_hills():
    scene = Scene()
    i, j = np.indices((41, 41)) - 20
    scene.add_static(Heightfield(6.0 * np.exp(-(((i) ** 2 + (j + 8) ** 2) / 20.0)), (40.0, 40.0)))
    scene.add_body(Sphere(RADIUS), position=(0, 0, 1.0))
    film = replace(film_of(scene, 2), camera=Camera.orbit(-90.0, 10.0))
    camera = CameraPath([film], [0, 1, 2], 160, 90).at(0)
    picture = RayCaster(film, camera).draw(0, 160, 90) / 255.0
    assert is_colourful(picture).mean() > 0.02


def test_a_body_inside_a_ring_that_moves_is_not_cut_open():
    """A post through a falling ring: the ring's middle is in the post, the ring is not."""
    post, ring = trimesh.creation.cylinder(1.0, 6.0), trimesh.creation.annulus(r_min=1.2, r_max=2.4, height=1.0)
    scene = Scene()
    scene.add_static(Mesh(post.vertices, post.faces, sdf_resolution=16))
    scene.add_body(Mesh(ring.vertices, ring.faces, sdf_resolution=16), position=(0, 0, 1))
    film = replace(film_of(scene, 1), camera=Camera.orbit(-90.0, 5.0))
    caster = RayCaster(film, CameraPath([film], [0], 160, 90).at(0))
    assert caster._cut[0] != CUT


def test_a_hollow_body_is_cut_open_and_a_solid_one_is_not():
    """Balls in a bowl with a high rim, and balls around a large ball."""
    bowl = trimesh.creation.annulus(r_min=3.0, r_max=3.4, height=8.0)
    inside = [(0, 0, -2), (1, 0, 0), (-1, 0, 1)]
    around = [(0, 5, 0), (4, 3, 0), (-4, 3, 0), (0, -5, 0)]
    for shape, places, shows in (
        (Mesh(bowl.vertices, bowl.faces, sdf_resolution=16), inside, True),
        (Sphere(4.0), around, False),
    ):
        scene = Scene()
        scene.add_static(shape)
        for place in places:
            scene.add_body(Sphere(RADIUS), position=place)
        film = replace(film_of(scene, 1), camera=Camera.orbit(-90.0, 5.0))
        caster = RayCaster(film, CameraPath([film], [0], 160, 90).at(0))
        assert (caster._cut[0] == CUT) == shows
        if shows:
            assert is_colourful(caster.draw(0, 160, 90) / 255.0).mean() > 0.01


def test_camera_holds_everything_and_no_more():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(100, 3)) * [3.0, 1.0, 0.5] + [10.0, -5.0, 2.0]
    camera = fit_camera(points, 4 / 3, 480)
    offset = points - np.array(camera.eye)
    depth = offset @ np.array(camera.forward)
    right, up = np.array(camera.right), np.array(camera.up)
    x, y = offset @ right / (right @ right) / depth, offset @ up / (up @ up) / depth
    assert (depth > 0).all()
    assert max(np.abs(x).max(), np.abs(y).max()) == pytest.approx(1 / 1.12, abs=1e-3)
    # In the tighter direction both borders are reached.
    tight = x if np.abs(x).max() > np.abs(y).max() else y
    assert tight.min() == pytest.approx(-tight.max(), abs=1e-3)


def test_few_that_fly_off_do_not_guide_the_camera():
    scene = Scene()
    for i in range(10):
        scene.add_body(Sphere(0.1), position=(0.3 * i, 0, 0))
    scene.add_body(Sphere(0.1), position=(500.0, 0, 0))
    assert np.abs(points_to_see(film_of(scene), [0])).max() < 10.0


def test_threads_and_repetition_change_nothing(ball):
    camera = camera_of(ball)
    caster = RayCaster(ball, camera)
    first = caster.draw(3, 160, 120)
    caster._threads = 1
    assert (caster.draw(3, 160, 120) == first).all()
    assert (RayCaster(ball, camera).draw(3, 160, 120) == first).all()


def scene_behind_wall(thickness, kinematic=False):
    scene = Scene()
    scene.add_static(Plane())
    add = scene.add_kinematic if kinematic else scene.add_static
    add(Box((3.0, thickness, 2.0)), position=(0, -1.5 - thickness, 2.0))
    scene.add_body(Sphere(RADIUS), position=(0.0, 0.0, 1.0))
    return film_of(scene)


@pytest.mark.parametrize(
    ("thickness", "kinematic", "shows"), [(0.1, False, True), (1.5, False, False), (0.1, True, False)]
)
def test_a_thin_static_wall_shows_what_it_hides_and_others_do_not(thickness, kinematic, shows):
    """A gate that was closed throughout a film was left out of it."""
    film = scene_behind_wall(thickness, kinematic)
    camera = fit_camera(np.array([[-2.0, -1, 0], [2, 1, 0], [-2, 1, 2], [2, -1, 2]]), 1.0, 120)
    drawn = RayCaster(film, camera).draw(0, 120, 120) / 255.0
    assert (is_colourful(drawn).mean() > 0.02) == shows


@pytest.fixture(scope="module")
def two_envs():
    scene = Scene()
    scene.add_static(Plane(), name="ground")
    scene.add_body(Box((0.1, 0.2, 0.3)), position=(0, 0, 3), name="brick")
    scene.add_body(Sphere(0.2), position=(0.5, 0, 3), name="ball")
    return record(FakeSimulator(scene, 2), frames=10)


@pytest.mark.parametrize("profile", ["animation", "scene"])
def test_film_from_the_file_is_the_film_from_memory(two_envs, tmp_path, profile):
    export_usd(two_envs, tmp_path / "film.usdc", profile=profile)
    memory, file = film_from_recording(two_envs), film_from_usd(tmp_path / "film.usdc")
    assert file.fps == memory.fps and file.labels == memory.labels
    np.testing.assert_allclose(file.offset, memory.offset, atol=1e-6)

    def sorted_by_place(film):
        order = np.lexsort(film.position[0].round(4).T)
        meshes = [film.meshes[index] for index in film.mesh[order]]
        return film.position[:, order], film.orientation[:, order], film.color[order], meshes

    for one, other in zip(sorted_by_place(memory)[:3], sorted_by_place(file)[:3], strict=True):
        same = np.minimum(np.abs(one - other), np.abs(one + other))
        assert same.max() < 2e-6
    for one, other in zip(sorted_by_place(memory)[3], sorted_by_place(file)[3], strict=True):
        if one.flat:
            # The ground in the file is as much wider as the environments are apart.
            wider = 2.0 * np.ptp(memory.offset, axis=0).max() / np.ptp(one.vertices, axis=0).max()
            np.testing.assert_allclose(other.vertices, (1.0 + wider) * one.vertices, rtol=1e-6)
        elif profile == "animation":
            assert (one.vertices == other.vertices).all() and (one.faces == other.faces).all()
            np.testing.assert_allclose(one.normals, other.normals, atol=1e-6)
        else:
            triangles = (np.sort(mesh.vertices[mesh.faces].mean(axis=1), axis=0) for mesh in (one, other))
            np.testing.assert_allclose(*triangles, atol=1e-6)


@pytest.mark.parametrize("profile", ["animation", "scene"])
def test_picture_from_the_file_is_the_picture_from_memory(two_envs, tmp_path, profile):
    export_usd(two_envs, tmp_path / "film.usdc", profile=profile)
    save_picture(film_from_recording(two_envs), tmp_path / "a.png", 5, 160, 120)
    save_picture(film_from_usd(tmp_path / "film.usdc"), tmp_path / "b.png", 5, 160, 120)
    a, b = (np.asarray(Image.open(tmp_path / name)).astype(int) for name in ("a.png", "b.png"))
    assert a.shape == (120, 2 * 160, 3)
    assert (np.abs(a - b).max(axis=-1) > 3).mean() < 1e-3


def test_contact_sheet_and_gif(two_envs, tmp_path):
    film = film_from_recording(two_envs)
    save_contact_sheet(film, tmp_path / "deep" / "sheet.png", count=3)
    assert Image.open(tmp_path / "deep" / "sheet.png").size == (3 * 480, 2 * 270)
    save_contact_sheet(film.alone(0), tmp_path / "one.png", count=4)
    assert Image.open(tmp_path / "one.png").size == (2 * 480, 2 * 270)
    save_film(film.alone(0), tmp_path / "film.gif", 80, 60)
    gif = Image.open(tmp_path / "film.gif")
    # 11 frames at 60 a second, every third: 20 a second.
    assert gif.size == (80, 60) and gif.n_frames == 4 and gif.info["duration"] == 50


def test_mp4_has_the_film_in_its_length_and_size(two_envs, tmp_path):
    import imageio_ffmpeg

    save_film(film_from_recording(two_envs), tmp_path / "deep" / "film.mp4", 81, 60)
    # Not imageio_ffmpeg.read_frames, which gives ffmpeg 10 s to begin.
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", tmp_path / "deep" / "film.mp4", "-f", "rawvideo"]
    decoded = subprocess.run([*command, "-pix_fmt", "rgb24", "-"], capture_output=True, check=True)
    (stream,) = [line for line in decoded.stderr.decode().splitlines() if "Video: h264" in line]
    frames = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, 60, 160, 3)
    # Two panels of 80 pixels; 11 frames at 60 a second, every second one: 30 a second.
    assert ", 160x60" in stream and ", 30 fps, " in stream
    assert len(frames) == 6
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 30


def test_colours_tell_levels_and_speeds():
    scene = level_scene()
    add_bodies(scene, stacks.CUBE, stacks.column(3))
    scene.add_body(Sphere(0.1), position=(1, 0, 5.0), linear_velocity=(3.0, 0, 0))
    recording = record(Simulator(scene, device="cpu"), 6, 60.0, velocities=True)
    film = film_from_recording(recording)
    level = colored(film, recording, "level")
    assert recording.level[-1, 0, 1:4].tolist() == [1, 2, 3]
    np.testing.assert_allclose(level.color_at(6)[1:4], level_colors(recording.level[-1, 0, 1:4]))
    np.testing.assert_array_equal(level.color_at(6)[0], film.color[0])
    speed = colored(film, recording, "speed")
    np.testing.assert_allclose(speed.color_at(3)[1:], speed_colors([0.0, 0.0, 0.0, 3.0]), atol=0.02)
    assert colored(film, recording, "body") is film
    camera = camera_of(film)
    assert not np.array_equal(RayCaster(film, camera).draw(6, 80, 60), RayCaster(level, camera).draw(6, 80, 60))
    assert level.alone(0).color.shape == (7, 5, 3)
    with pytest.raises(ValueError, match="by: must be one of body, environment, level, speed, asleep"):
        colored(film, recording, "mass")


def test_many_environments_are_drawn_in_one_view(tmp_path):
    scene = Scene()
    scene.add_body(Sphere(0.2))
    save_picture(film_of(scene, 1, num_envs=10), tmp_path / "many.png", 0, 80, 60)
    assert Image.open(tmp_path / "many.png").size == (80, 60)


def test_bad_arguments_are_named(two_envs, tmp_path):
    with pytest.raises(ValueError, match="frame: must be from 0 to 10, or -1, got 11"):
        save_picture(film_from_recording(two_envs), tmp_path / "a.png", 11)
    with pytest.raises(FileNotFoundError):
        film_from_usd(tmp_path / "none.usdc")
    (tmp_path / "bad.usdc").write_text("no film")
    with pytest.raises(ValueError, match=r"bad.usdc: not a readable USD file"):
        film_from_usd(tmp_path / "bad.usdc")
    (tmp_path / "empty.usda").write_text("#usda 1.0\n")
    with pytest.raises(ValueError, match=r"empty.usda: must be an animation written by export_usd"):
        film_from_usd(tmp_path / "empty.usda")


def test_screen_values_follow_the_standard():
    np.testing.assert_allclose(
        on_screen(np.array([0.0, 0.0031308, 0.2140, 1.0, 2.0])), [0.0, 0.04045, 0.5, 1.0, 1.0], atol=1e-4
    )
