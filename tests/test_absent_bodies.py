"""Bodies that are switched off are recorded as such, and drawn nowhere."""

from dataclasses import replace

import numpy as np
import pygltflib
import pytest
from pxr import Usd, UsdGeom

import warp_rigid as wr
from warp_rigid.render.film import film_from_recording, film_from_usd
from warp_rigid.render.framing import CameraPath, points_to_see
from warp_rigid.render.raycast import RayCaster
from warp_rigid.runs.recording import Recording
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


def test_absent_bodies_change_no_pixel_and_no_view(recording):
    """They are drawn as bodies far below the ground are, and do not widen the picture."""
    film = film_from_recording(recording)
    away = film.position.copy()
    away[~film.present] = (0.0, 0.0, -50.0)
    without = replace(film, position=away)
    everywhere = replace(film, present=np.ones_like(film.present))
    camera = CameraPath([film], [0], 64, 36).at(0)
    pictures = [
        [RayCaster(each, camera).draw(frame, 64, 36) for frame in (0, 4, 8)] for each in (film, without, everywhere)
    ]
    np.testing.assert_array_equal(pictures[0], pictures[1])
    # At the start, the ball of the pool lies in the brick.
    assert [bool((one != other).any()) for one, other in zip(pictures[0], pictures[2], strict=True)] == [
        False,
        True,
        True,
    ]
    lowest = points_to_see(without, range(9))[:, 2].min()
    assert lowest > -1.0


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
