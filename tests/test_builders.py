"""Builders: bodies start where geometry demands, touch without overlap, and are returned by index."""

import itertools

import numpy as np
import pytest

from tests.scene_oracles import body_separation
from warp_rigid.rotations import rotate
from warp_rigid.scene.shapes import Box, Sphere
from warp_rigid.scenes.builders import grounds, stacks
from warp_rigid.scenes.builders.bodies import add_bodies


def separations(scene, bodies):
    """Gap of each pair of bodies [m]."""
    return [body_separation(scene.bodies[a], scene.bodies[b]) for k, a in enumerate(bodies) for b in bodies[k + 1 :]]


@pytest.mark.parametrize("shape", [Box((0.2, 0.1, 0.05)), Sphere(0.3)])
def test_a_stack_stands_on_its_support_with_equal_gaps(shape):
    scene = grounds.level_scene()
    rows = add_bodies(scene, shape, stacks.column(4, shape, bottom=0.5, gap=0.01, lean=0.02))
    position = np.array([scene.bodies[i].position for i in rows])
    half = 0.05 if isinstance(shape, Box) else 0.3
    np.testing.assert_allclose(position[:, 2] - half, [0.51 + k * (2 * half + 0.01) for k in range(4)])
    np.testing.assert_allclose(position[:, 0], [0.0, 0.02, 0.04, 0.06])


@pytest.mark.parametrize("count", [2, 5, 10])
def test_the_steepest_tower_that_stands_has_harmonic_overhangs(count):
    """From the top, each cube may overhang by 1 / (2 k) of its width, k counting from 1."""
    steps = 1.0 / (2.0 * np.arange(count, 0, -1))[1:]
    places = np.concatenate([[0.0], np.cumsum(steps)])
    assert not stacks.leaning_tower_falls(0.999 * places, 0.5)
    assert stacks.leaning_tower_falls(1.001 * places, 0.5)


@pytest.mark.parametrize(
    ("add", "count"),
    [
        (lambda scene: add_bodies(scene, stacks.CUBE, stacks.pyramid(4)), 10),
        (lambda scene: add_bodies(scene, *stacks.crossed_layers(4)), 8),
        (lambda scene: add_bodies(scene, *stacks.card_house(2, np.radians(25.0))), 7),
    ],
)
def test_structures_of_boxes_touch_without_overlap(add, count):
    scene = grounds.level_scene()
    rows = add(scene)
    gaps = separations(scene, rows)
    lowest = min(np.asarray(scene.bodies[i].position)[2] for i in rows)
    assert len(rows) == count and lowest > 0.0
    assert min(gaps) > -1e-12
    assert sum(abs(gap) < 1e-12 for gap in gaps) >= count - 1


@pytest.mark.parametrize(("stones", "thickness"), [(3, 0.5), (15, 0.625)])
def test_stones_of_an_arch_meet_in_whole_faces(stones, thickness):
    """Neighbours share the four corners of a joint; the outer joints lie on the ground."""
    scene = grounds.level_scene()
    rows = add_bodies(scene, *stacks.arch(stones, 5.0, thickness))
    bodies = [scene.bodies[i] for i in rows]
    corners = [rotate(np.array(b.orientation), b.shape.vertices) + b.position for b in bodies]
    for one, other in itertools.pairwise(corners):
        distance = np.linalg.norm(one[:, None] - other[None], axis=-1)
        assert (distance.min(axis=1) < 1e-12).sum() == 4
    for stone, side in ((corners[0], -1), (corners[-1], 1)):
        foot = stone[np.abs(stone[:, 2]) < 1e-12]
        assert sorted(foot[:, 0] * side) == pytest.approx([5.0 - 0.5 * thickness] * 2 + [5.0 + 0.5 * thickness] * 2)
    assert min(corner[:, 2].min() for corner in corners) > -1e-12
    section = np.sin(np.pi / stones) * 5.0 * thickness
    assert bodies[0].shape.volume == pytest.approx(section)


def test_balls_of_a_pyramid_touch_four_below():
    scene = grounds.level_scene()
    rows = add_bodies(scene, Sphere(0.1), stacks.ball_pyramid(3, 0.1))
    place = np.array([scene.bodies[i].position for i in rows])
    distance = np.linalg.norm(place[:, None] - place[None], axis=-1)
    below = (np.abs(distance - 0.2) < 1e-12) & (place[None, :, 2] < place[:, None, 2] - 1e-9)
    assert len(rows) == 14 and distance[np.triu_indices(14, 1)].min() > 0.2 - 1e-12
    assert below.sum(axis=1).tolist() == [0] * 9 + [4] * 5
