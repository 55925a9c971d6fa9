"""Random convex solids and the bones: the same for the same seed, closed, and shaped as they say."""

import numpy as np
import pytest

from warp_rigid.scenes.builders.assortment import CONVEX_KINDS, convex_solid, convex_solids


@pytest.mark.parametrize("kind", CONVEX_KINDS)
def test_a_solid_fits_its_ball_and_is_convex(kind):
    shape = convex_solid(kind, 0.3)
    vertices, faces = shape.surface()
    assert np.linalg.norm(vertices, axis=1).max() <= 0.3 * (1.0 + 1e-9)
    assert np.linalg.norm(vertices, axis=1).max() > 0.2
    np.testing.assert_allclose(shape.center_of_mass, 0.0, atol=1e-9)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    heights = np.einsum("fvk,fk->fv", vertices[None] - a[:, None], normal / np.linalg.norm(normal, axis=1)[:, None])
    assert heights.max() < 1e-6


def test_the_seed_decides():
    first, again, other = (convex_solids(200, seed, 0.2) for seed in (4, 4, 5))
    assert [shape.key for shape in first] == [shape.key for shape in again]
    assert [shape.key for shape in first] != [shape.key for shape in other]
    assert len({shape.key for shape in first}) == 3 * len(CONVEX_KINDS)
    assert [shape.key for shape in convex_solids(3, 4, 0.2)] != [shape.key for shape in convex_solids(3, 5, 0.2)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 0, 0.2), "^count: must be a whole number from 1 to 100000"),
        ((1, -1, 0.2), "^seed: must be a whole number from 0 to 4294967295"),
        ((1, 0, 0.0), "^radius: must be a finite number > 0"),
    ],
)
def test_bad_numbers_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        convex_solids(*arguments)
