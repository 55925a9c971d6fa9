"""Oracles of the validation against closed forms of their own."""

import numpy as np
import pytest

from warp_rigid import rotations
from warp_rigid.validation import contact_search, sliding
from warp_rigid.validation.common import G

UPRIGHT = np.array([[0.0, 0.0, 0.0, 1.0]])
SIDE = 2.0 * contact_search.RADIUS / 3.0**0.5
"""Edge of the cube [m]."""


def test_overlap_of_cubes_face_to_face_and_edge_to_edge():
    """Level cubes overlap by their edge less the largest offset; turned about crossed axes, their edges meet."""
    for offset in ((0.3, 0.1, 0.05), (0.0, -0.44, 0.2), (0.1, 0.1, 0.5)):
        found = contact_search.overlap(("cube", "cube"), np.array([offset]), UPRIGHT)
        assert found == pytest.approx(SIDE - np.abs(offset).max(), abs=1e-6)
    first, second = (rotations.about_axis(axis, np.pi / 4.0) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    # In the world the upper cube is 0.6 m above; its lowest edge crosses the highest one of the lower cube.
    offset = rotations.rotate(rotations.inverse(first), np.array([0.0, 0.0, 0.6]))
    turn = rotations.multiply(rotations.inverse(first), second)
    found = contact_search.overlap(("cube", "cube"), offset[None], turn[None])
    assert found == pytest.approx(2.0**0.5 * SIDE - 0.6, abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "vertices", "normals", "edges"),
    [("cube", 8, 3, 3), ("tetrahedron", 4, 4, 6), ("octahedron", 6, 4, 6), ("cylinder", 26, 7, 7)],
)
def test_features_of_polyhedra(kind, vertices, normals, edges):
    """Numbers of vertices, and of normals and edges up to their sign; the diagonals of faces are no edges.

    The caps of the cylinder have a vertex in their middle.
    """
    assert [len(part) for part in contact_search.features(kind)] == [vertices, normals, edges]
    assert [len(part) for part in contact_search.features("icosahedron")] == [12, 10, 15]
    assert [len(part) for part in contact_search.features("dodecahedron")] == [20, 6, 15]


def test_random_pairs_overlap_as_asked():
    offset, turn, depth = contact_search.random_pairs(("cube", "octahedron"), 50, 1)
    assert len(offset) == len(turn) == len(depth) == 50
    assert depth.min() > 0.02 * 2.0 * contact_search.RADIUS
    assert (np.linalg.norm(offset, axis=1) < 2.0 * contact_search.RADIUS).all()


@pytest.mark.parametrize("count", [3, 12])
def test_a_ring_that_only_slides_or_only_spins_stops_as_a_block_does(count):
    """From v0 after v0 / (mu g); a spin has the speed w R at every foot and the inertia m R^2."""
    feet, decay = sliding.ring_feet(count), sliding.MU * G
    time, way, angle = sliding.stop(feet, 0.0, sliding.RING_RADIUS, 2.0, 0.0)
    assert (time, way, angle) == pytest.approx((2.0 / decay, 2.0**2 / (2.0 * decay), 0.0), rel=3e-3, abs=1e-9)
    time, way, angle = sliding.stop(feet, 0.0, sliding.RING_RADIUS, 0.0, 4.0)
    turned = 4.0**2 * sliding.RING_RADIUS / (2.0 * decay)
    assert (time, angle) == pytest.approx((4.0 * sliding.RING_RADIUS / decay, turned), rel=3e-3)
    assert way == pytest.approx(0.0, abs=1e-9)


def test_a_block_that_brakes_is_loaded_in_front_and_stops_all_the_same():
    """The load moves to the front feet, but its sum, and so the friction, stays."""
    feet = np.array([(x, y, 0.0) for x in (-0.3, 0.3) for y in (-0.2, 0.2)])
    time, way, _ = sliding.stop(feet, 0.1, 0.2, 2.0, 0.0)
    assert (time, way) == pytest.approx((2.0 / (sliding.MU * G), 2.0 / (sliding.MU * G)), rel=3e-3)
