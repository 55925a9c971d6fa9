"""Exported films in a second reader, tinyusdz, which is written without OpenUSD: poses, meshes, camera and lights."""

import ast

import numpy as np
import pytest
import tinyusdz

import warp_rigid as wr
from warp_rigid.scene.scene import Motion


@pytest.fixture(scope="module")
def recording():
    scene = wr.scenes.load("box_stack", height=2)
    return wr.record(wr.Simulator(scene, device="cpu"), frames=20)


def value_at(prim, name, frame):
    """An attribute at a time code: its last sample, or its default if it does not change."""
    samples = [value for time, value in prim.get_attribute_timesamples(name) if time <= frame]
    return np.array(ast.literal_eval((samples[-1] if samples else prim.get_attribute(name).value()).to_string()))


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_poses_of_every_frame_are_those_of_the_recording(recording, tmp_path, suffix):
    path = tmp_path / f"film.{suffix}"
    wr.export_usd(recording, path, profile="scene")
    stage = tinyusdz.load(str(path))
    assert [stage.get_metadata(name) for name in ("upAxis", "metersPerUnit", "timeCodesPerSecond")] == ["Z", 1.0, 60.0]
    assert stage.get_metadata("endTimeCode") == len(recording.position) - 1
    for index, body in enumerate(recording.scene.bodies):
        if body.motion == Motion.STATIC:
            continue
        prim = stage.get_prim_at_path(f"/World/env_0000/{body.name}")
        for frame in (0, 7, 20):
            position = value_at(prim, "xformOp:translate", frame)
            np.testing.assert_allclose(position, recording.position[frame, 0, index], atol=1e-6)


def test_it_finds_camera_lights_and_meshes_for_a_frame(tmp_path):
    """What a renderer is given: the mesh of the bunny, animated bodies, the camera and both lights."""
    scene = wr.scenes.load("bunny_pile", bodies=2)
    film = wr.record(wr.Simulator(scene, device="cpu"), frames=3)
    wr.export_usd(film, tmp_path / "film.usdc", profile="scene")
    rendered = tinyusdz.tydra.convert_to_render_scene(tinyusdz.load(str(tmp_path / "film.usdc")))
    # The reader gives each corner of a triangle its own point.
    vertices, faces = scene.bodies[-1].shape.surface()
    largest = max((np.asarray(mesh.points).reshape(-1, 3) for mesh in rendered.meshes()), key=len)
    np.testing.assert_allclose(largest, vertices[faces].reshape(-1, 3), atol=1e-6)
    assert [len(found()) for found in (rendered.cameras, rendered.lights)] == [1, 2]
    assert len(rendered.animations()) == 2
