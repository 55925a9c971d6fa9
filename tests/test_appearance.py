"""Normals, quaternion signs, colours and layout against their definitions."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from tests.fakes import FakeSimulator
from warp_rigid import Box, Cylinder, Plane, Scene, Simulator, Sphere, export_usd
from warp_rigid.render.appearance import (
    corner_normals,
    drawn_surfaces,
    environment_offsets,
    level_colors,
    speed_colors,
    spread_of,
)
from warp_rigid.render.film import film_from_usd
from warp_rigid.rotations import continuous_signs
from warp_rigid.runs.recording import record


def test_box_has_flat_faces():
    vertices, faces = Box((0.1, 0.2, 0.3)).surface()
    normals = corner_normals(vertices, faces)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    np.testing.assert_allclose(normals, np.repeat(flat[:, None], 3, axis=1), atol=1e-7)


def test_sphere_is_smooth():
    vertices, faces = Sphere(0.5).surface()
    normals = corner_normals(vertices, faces)
    radial = vertices[faces] / np.linalg.norm(vertices[faces], axis=-1, keepdims=True)
    assert (np.sum(normals * radial, axis=-1) > 0.999).all()


def test_cylinder_is_smooth_around_and_sharp_at_the_rim():
    vertices, faces = Cylinder(0.2, 0.5).surface()
    normals = corner_normals(vertices, faces)
    corners = vertices[faces]
    cap = np.ptp(corners[..., 2], axis=1) < 1e-9
    np.testing.assert_allclose(normals[cap], [[[0, 0, 1]]] * np.sign(corners[cap][..., 2:]), atol=1e-6)
    radial = corners[~cap] * [1.0, 1.0, 0.0] / 0.2
    assert (np.sum(normals[~cap] * radial, axis=-1) > 0.998).all()


def test_seams_in_the_triangles_do_not_show():
    vertices, faces = Sphere(0.5).surface()
    split = vertices[faces].reshape(-1, 3)
    apart = np.arange(len(split)).reshape(-1, 3)
    np.testing.assert_allclose(corner_normals(split, apart), corner_normals(vertices, faces), atol=1e-6)


def test_signs_become_continuous_and_nothing_else_changes():
    rng = np.random.default_rng(0)
    angle = np.cumsum(rng.uniform(0, 1.5, size=(100, 4)), axis=0)
    smooth = np.stack([np.sin(angle / 2), 0 * angle, 0 * angle, np.cos(angle / 2)], axis=-1)
    broken = smooth * rng.choice([-1.0, 1.0], size=(100, 4, 1))
    mended = continuous_signs(broken)
    assert (np.sum(mended[1:] * mended[:-1], axis=-1) > 0).all()
    np.testing.assert_allclose(np.abs(np.sum(mended * broken, axis=-1)), 1.0)
    np.testing.assert_array_equal(mended[0], broken[0])


def lightness(colors):
    """CIE L* of linear RGB, for colours brighter than 1 % of white."""
    return 116.0 * np.cbrt(colors @ [0.2126, 0.7152, 0.0722]) - 16.0


def test_levels_differ_and_repeat():
    colors = level_colors([[0, 1, 2], [3, 4, 5]]).reshape(-1, 3)
    assert np.linalg.norm(colors[:, None] - colors[None] + np.eye(6)[..., None], axis=-1).min() > 0.1
    assert (np.diff(lightness(colors[1:])) > 10.0).all()
    np.testing.assert_array_equal(level_colors([6, 15]), level_colors([1, 5]))


def test_faster_is_lighter():
    colors = speed_colors(np.linspace(0.0, 2.0, 21))
    assert (np.diff(lightness(colors)) > 0.0).all()
    np.testing.assert_array_equal(speed_colors([2.0, np.inf, np.nan]), colors[[-1, -1, 0]])


@pytest.mark.parametrize("count", [1, 2, 5, 6, 16, 100])
def test_environments_keep_their_distance(count):
    offsets = environment_offsets(count, (2.0, 3.0))
    assert offsets.shape == (count, 3)
    difference = np.abs(offsets[:, None] - offsets[None]) + 10.0 * np.eye(count)[..., None]
    assert ((difference[..., 0] > 1.999) | (difference[..., 1] > 2.999)).all()
    if count in (1, 5, 16, 100):
        np.testing.assert_allclose(offsets.mean(axis=0), 0.0, atol=1e-12)


def test_only_a_tilted_plane_shrinks():
    scene = Scene()
    scene.add_static(Plane((0, 0, 1), 0.5))
    scene.add_static(Plane((1, 0, 1), 0.5))
    scene.add_body(Sphere(0.25))
    recording = record(FakeSimulator(scene, 2), frames=1)
    spread = spread_of(recording)
    spread.spacing = lambda: np.array((2.0, 3.0))
    level, tilted, ball = drawn_surfaces(recording, 2, spread)
    assert level is recording.surfaces[0] and ball is recording.surfaces[2]
    np.testing.assert_allclose(np.ptp(tilted.vertices, axis=0).max(), 3.0, rtol=1e-5)
    distance = tilted.vertices @ np.array([1, 0, 1]) / np.sqrt(2.0)
    np.testing.assert_allclose(distance, 0.5, atol=1e-6)
    assert drawn_surfaces(recording, 1, spread) == list(recording.surfaces)


def test_planes_reach_beyond_the_bodies(tmp_path):
    scene = Scene()
    scene.add_static(Plane((0, 0, 1), 0.5))
    scene.add_body(Sphere(0.25), position=(0, -35, 2))
    scene.add_body(Sphere(0.25), position=(0, 1, 2), linear_velocity=(0, 500, 0))
    recording = record(Simulator(scene, device="cpu"), 12)
    path = tmp_path / "film.usda"
    export_usd(recording, path)
    stage = Usd.Stage.Open(str(path))
    planes = [prim for prim in Usd.PrimRange.AllPrims(stage.GetPseudoRoot()) if prim.IsA(UsdGeom.Plane)]
    drawn = np.ptp(drawn_surfaces(recording, 1, spread_of(recording))[0].vertices[:, 1])
    assert planes
    assert [plane.GetAttribute("width").Get() for plane in planes] == pytest.approx(len(planes) * [drawn], rel=1e-5)
    assert 2 * 100 < drawn < 1000
    square = np.array(film_from_usd(path).meshes[0].vertices)
    assert np.ptp(square[:, 1]) == pytest.approx(drawn, rel=1e-5)
