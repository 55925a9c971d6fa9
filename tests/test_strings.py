"""Strings in pictures: tubes between the anchors of distance joints."""

import numpy as np
from PIL import Image

import warp_rigid as wr
from warp_rigid.commands import cli
from warp_rigid.render.film import film_from_recording
from warp_rigid.render.strings import SIDES, THICKNESS, with_strings

RADIUS = THICKNESS * 0.2


def pendulums():
    """A ball on a string of 1 m, and one on a string that breaks at once."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(normal=(0, 0, 1), offset=-3.0))
    for k, strength in enumerate((np.inf, 1e-3)):
        ball = scene.add_body(wr.Sphere(0.1), position=(2.0 * k + 1.0, 0, 0), mass=1.0)
        joint = wr.DistanceJoint(maximum=1.0)
        scene.add_joint(joint, ball, anchor=(2.0 * k + 1.0, 0, 0), anchor_b=(2.0 * k, 0, 0), break_force=strength)
    return scene


def recording(envs=2):
    return wr.record(wr.Simulator(pendulums(), num_envs=envs, device="cpu"), frames=30)


def test_strings_end_at_the_anchors():
    found = recording()
    film = with_strings(film_from_recording(found), found)
    assert len(film.mesh) == 2 * 3 + 2 and film.env[-2:].tolist() == [0, 1]
    for env in range(2):
        mesh = film.meshes[film.mesh[-2 + env]]
        for frame in (0, 12, 30):
            tube = mesh.frames[frame][: 2 * SIDES].reshape(SIDES, 2, 3)
            ends = tube.mean(axis=0)
            np.testing.assert_allclose(ends, [found.position[frame, env, 1], (0, 0, 0)], atol=1e-6)
            axis = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
            arms = tube - ends
            np.testing.assert_allclose(np.linalg.norm(arms, axis=2), RADIUS, rtol=1e-4)
            np.testing.assert_allclose(arms @ axis, 0.0, atol=1e-6)
        np.testing.assert_array_equal(film.position[:, -2 + env], np.broadcast_to(film.offset[env], (31, 3)))


def test_a_broken_string_is_not_drawn():
    found = recording(envs=1)
    assert np.linalg.norm(found.position[-1, 0, 2] - (2, 0, 0)) > 1.1
    tube = with_strings(film_from_recording(found), found).meshes[-1].frames[-1][2 * SIDES :]
    assert np.ptp(tube, axis=0).max() == 0.0


def test_strings_are_drawn_when_the_poses_are_written_to_a_file(tmp_path):
    """The frames are then streamed to the file, and none of them is recorded."""
    film = tmp_path / "cradle.usdc"
    pictures = {}
    for options in ([], ["-o", str(film)]):
        picture = tmp_path / f"{len(options)}.png"
        run = ["run", "cradle", "--frames", "2", "--device", "cpu", "--picture", str(picture)]
        assert cli.main([*run, *options]) == 0
        pictures[len(options)] = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    assert np.mean(np.abs(pictures[0] - pictures[2]).max(axis=2) > 8) < 0.01
