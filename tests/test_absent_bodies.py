"""Bodies that are switched off are recorded as such, and drawn nowhere."""

from dataclasses import replace

import numpy as np
import pygltflib
import pytest
from pxr import Usd, UsdGeom

import warp_rigid as wr
from warp_rigid.render.appearance import spread_of
from warp_rigid.render.film import film_from_recording, film_from_usd
from warp_rigid.render.framing import event_end, fit_camera, points_to_see
from warp_rigid.render.raycast import RayCaster
from warp_rigid.render.strings import with_strings
from warp_rigid.runs.recording import CAPTURED, Recording
from warp_rigid.viewer.instances import Instances
from warp_rigid.viewer.page import start_server, stop_server

BALL, STRAY = 2, 3


@pytest.fixture(scope="module")
def recording():
    """A ball of a pool that is there in frames 3 to 5 only, and a body that leaves the bounds."""
    scene = wr.Scene(bounds=((-1, -1, -1), (1, 1, 2)), out_of_bounds="remove")
    scene.add_static(wr.Plane(), name="ground")
    scene.add_body(wr.Box((0.2, 0.2, 0.2)), position=(0, 0, 0.1), name="brick")
    scene.add_pool(wr.Sphere(0.2), 1, "ball")
    scene.add_body(wr.Box((0.2, 0.1, 0.1)), position=(0.8, 0, 1), linear_velocity=(4, 0, 0), name="stray")
    sim = wr.Simulator(scene, device="cpu")

    def change(index, sim):
        if index == 2:
            sim.spawn("ball", position=(-0.4, 0, 0.6))
        if index == 5:
            sim.despawn(BALL)

    return wr.record(sim, 8, 60, on_frame=change)


def shown(recording, body):
    return np.flatnonzero(recording.active[:, 0, body]).tolist()


def test_each_frame_tells_which_bodies_are_active(recording, tmp_path):
    assert recording.active.dtype == bool and recording.active[:, 0, :2].all()
    assert shown(recording, BALL) == [3, 4, 5]
    assert shown(recording, STRAY) == [0, 1, 2, 3]
    assert [frame.active[0, BALL] for frame in recording.frames()] == recording.active[:, 0, BALL].tolist()
    recording.save(tmp_path / "run.npz")
    loaded = Recording.load(tmp_path / "run.npz")
    np.testing.assert_array_equal(loaded.active, recording.active)


def test_a_file_without_it_has_all_bodies(recording, tmp_path):
    path = tmp_path / "run.npz"
    recording.save(path)
    with np.load(path) as file:
        np.savez(path, **{name: file[name] for name in file.files if name != "active"})
    assert Recording.load(path).active.all()


def test_xarray_has_it(recording):
    pytest.importorskip("xarray", reason="an optional package")
    found = recording.to_xarray()["active"]
    assert found.dims == ("time", "env", "body")
    np.testing.assert_array_equal(found, recording.active)


def without(recording, *bodies):
    """The recording of the same motion without some bodies."""
    kept = [body for body in range(len(recording.names)) if body not in bodies]
    frames = {name: getattr(recording, name)[:, :, kept] for name in CAPTURED}
    frames |= {name: getattr(recording, name)[kept] for name in ("motion", "surface")}
    return replace(recording, **frames, names=tuple(recording.names[body] for body in kept), scene=None)


def drawn(film, frame):
    view = fit_camera(np.array([[-1, -1, 0], [1, 1, 1]]), 1.5, 80)
    return RayCaster(film, view).draw(frame, 120, 80)


def test_an_absent_body_changes_no_pixel(recording):
    film, alone = (film_from_recording(one) for one in (recording, without(recording, BALL, STRAY)))
    for frame in range(film.num_frames):
        there = frame in (*shown(recording, BALL), *shown(recording, STRAY))
        assert (drawn(film, frame) == drawn(alone, frame)).all() == (not there), frame


def test_an_absent_plane_is_not_drawn(recording):
    active = recording.active.copy()
    active[3:, :, 0] = False
    film = film_from_recording(replace(recording, active=active))
    alone = film_from_recording(without(replace(recording, active=active), 0))
    assert not film.level.any() and (drawn(film, 6) == drawn(alone, 6)).all()
    assert (drawn(film, 2) != drawn(alone, 2)).any()


def test_only_what_is_present_is_kept_in_view(recording):
    film = film_from_recording(recording)
    for frame in range(film.num_frames):
        gone = [body for body in (BALL, STRAY) if not recording.active[frame, 0, body]]
        expected = points_to_see(film_from_recording(without(recording, *gone)), [frame])
        np.testing.assert_array_equal(points_to_see(film, [frame]), expected)


def test_a_camera_waits_for_the_first_body():
    """Before a body appears, the camera shows where it will."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    scene.add_pool(wr.Sphere(0.1), 2, "ball")
    sim = wr.Simulator(scene, device="cpu")
    place = (3, 0, 0.5)
    recorded = wr.record(sim, 6, 60, on_frame=lambda i, sim: sim.spawn("ball", position=place) if i == 3 else None)
    film = film_from_recording(recorded)
    for frame in range(film.num_frames):
        np.testing.assert_allclose(points_to_see(film, [frame]).mean(axis=0), place, atol=0.05)
    none = film_from_recording(replace(recorded, active=recorded.active & (recorded.motion == wr.Motion.STATIC)))
    assert np.isfinite(points_to_see(none, [0])).all()


def test_a_film_goes_on_until_the_last_body_appears_or_vanishes(recording):
    """The bodies are at rest all the time; AFTERMATH is 0.8 s."""
    frames, time = 200, np.arange(200) / 60
    at_rest = {name: np.repeat(getattr(recording, name)[-1:], frames, axis=0) for name in CAPTURED}
    at_rest["active"][:100, :, BALL] = False
    at_rest["active"][100:, :, BALL] = True
    at_rest["position"][100:, :, BALL] += 0.5
    film = film_from_recording(replace(recording, time=time, times=np.tile(time[:, None], (1, 1)), **at_rest))
    assert event_end(film) == 100 + 48
    gone = replace(film, present=film.present.copy())
    gone.present[120:] = False
    assert event_end(gone) == 120 + 48


def test_the_string_of_an_absent_body_is_not_drawn():
    scene = wr.Scene()
    ball = scene.add_body(wr.Sphere(0.1), position=(0, 0, 1), active=False)
    scene.add_joint(wr.DistanceJoint(maximum=1.0), ball, anchor=(0, 0, 1), anchor_b=(0, 0, 2))
    sim = wr.Simulator(scene, device="cpu")
    recorded = wr.record(sim, 2, 60, on_frame=lambda i, sim: sim.set("active", True))
    film = with_strings(film_from_recording(recorded), recorded)
    assert [bool(np.ptp(vertices, axis=0).any()) for vertices in film.meshes[-1].frames] == [False, True, True]


def test_environments_are_spaced_by_the_bodies_that_are_present(recording):
    far = replace(recording, position=recording.position.copy())
    far.position[~recording.active] = 50.0
    np.testing.assert_array_equal(spread_of(far).spacing(), spread_of(recording).spacing())
    assert spread_of(far).spacing()[0] > 1.2  # from the ball, which appears later, to the one that leaves


@pytest.mark.parametrize("profile", ["scene", "animation"])
def test_usd_files_hide_them(recording, profile, tmp_path):
    path = tmp_path / "film.usda"
    wr.export_usd(recording, path, profile=profile)
    film = film_from_usd(path)
    present = {int(body): film.present[:, k].tolist() for k, body in enumerate(film.body)}
    assert [present[body] for body in range(4)] == recording.active[:, 0].T.tolist()
    if profile == "scene":
        stage = Usd.Stage.Open(str(path))
        (ball,) = (prim for prim in stage.Traverse() if prim.GetName() == "ball_0")
        seen = [UsdGeom.Imageable(ball).ComputeVisibility(frame) for frame in range(9)]
        assert np.flatnonzero(np.array(seen) == "inherited").tolist() == [3, 4, 5]


def test_usd_files_without_absent_bodies_have_no_visibility(tmp_path):
    scene = wr.Scene()
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 1))
    for profile in ("scene", "animation"):
        path = tmp_path / f"{profile}.usda"
        wr.export_usd(wr.record(wr.Simulator(scene, device="cpu"), 2), path, profile=profile)
        assert not any(word in path.read_text() for word in ("visibility", "invisibleIds"))


def test_gltf_files_scale_them_to_nothing(recording, tmp_path):
    wr.export_gltf(recording, tmp_path / "film.glb")
    file = pygltflib.GLTF2().load(str(tmp_path / "film.glb"))
    scaled = {}
    for channel in file.animations[0].channels:
        if channel.target.path == "scale":
            sampler = file.animations[0].samplers[channel.sampler]
            assert sampler.interpolation == "STEP"
            accessor = file.accessors[sampler.output]
            view = file.bufferViews[accessor.bufferView]
            values = np.frombuffer(file.binary_blob(), np.float32, 3 * accessor.count, view.byteOffset)
            scaled[file.nodes[channel.target.node].name] = values.reshape(-1, 3)
            assert file.nodes[channel.target.node].scale == values[:3].tolist()
    assert sorted(scaled) == ["ball_0", "stray"]
    np.testing.assert_array_equal(scaled["ball_0"], recording.active[:, 0, BALL, None] * np.ones(3))


def test_the_page_shows_them_while_they_are_there(recording):
    film = film_from_recording(recording)
    server = start_server("127.0.0.1", 8710)
    try:
        instances = Instances(server, film, film.moving)
        for frame in (0, 4, 8):
            instances.show(film, frame)
            for handle, chosen in instances.handles:
                opacity = handle.batched_opacities
                drawn = np.ones(len(chosen), bool) if opacity is None else opacity > 0.0
                np.testing.assert_array_equal(drawn, film.present[frame, chosen])
    finally:
        stop_server(server)
