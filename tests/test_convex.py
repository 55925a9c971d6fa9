"""Pairs of convex solids against their exact overlap: every pair that overlaps has a contact, and comes apart."""

import itertools

import numpy as np
import pytest

from tests.convex_oracle import SOLIDS, overlaps, random_poses, solid
from tests.geometry_oracles import cube
from tests.oracles import contact_list, find_contacts, opened
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Mesh
from warp_rigid.scenes.builders import meshes

APART = 3.0
"""Distance of the pairs of a scene, so that only the two solids of each pair can meet [m]."""

MISSED = 0.02
"""Overlap over the smaller size from which a pair must have a contact."""

LEFT = 0.01
"""Overlap over the smaller size that may be left after a second."""

PORTION = 100


class Pairs:
    """One pair of every two kinds in each of many environments, in random poses."""

    def __init__(self, device, envs, seed):
        """Place them without gravity."""
        generator = np.random.default_rng(seed)
        solids = {kind: solid(make()) for kind, make in SOLIDS.items()}
        self.kinds = list(itertools.combinations_with_replacement(solids, 2))
        self.pairs = [(solids[a], solids[b]) for a, b in self.kinds]
        poses = [random_poses(a, b, envs, generator) for a, b in self.pairs]
        self.places = APART * np.array([(k % 9, k // 9, 0) for k in range(len(poses))])[:, None]
        scene = Scene(gravity=(0, 0, 0))
        for a, b in self.pairs:
            scene.add_body(a.shape, mass=1.0)
            scene.add_body(b.shape, mass=1.0)
        self.sim, self.stages = opened(scene, device, envs)
        position = np.stack([place + at for place, (at, _) in zip(self.places, poses, strict=True)], axis=1)
        orientation = np.stack([turn for _, turn in poses], axis=1)
        self.sim.set("position", position.reshape(envs, -1, 3))
        self.sim.set("orientation", orientation.reshape(envs, -1, 4))

    def depths(self):
        """Overlap of each pair over its smaller size, (envs, pairs)."""
        envs = self.sim.num_envs
        position = self.sim.get("position").astype(np.float64).reshape(envs, -1, 2, 3)
        orientation = self.sim.get("orientation").astype(np.float64).reshape(envs, -1, 2, 4)
        return np.stack(
            [
                overlaps(a, b, position[:, k], orientation[:, k]) / min(a.shape.size, b.shape.size)
                for k, (a, b) in enumerate(self.pairs)
            ],
            axis=1,
        )

    def contact_depths(self):
        """Depth of the deepest contact of each pair over its smaller size, (envs, pairs); -inf without one."""
        find_contacts(self.stages)
        found = contact_list(self.stages)
        deepest = np.full(self.sim.num_envs * len(self.pairs), -np.inf)
        np.maximum.at(deepest, found["body_a"] // 2, -found["gap"])
        sizes = [min(a.shape.size, b.shape.size) for a, b in self.pairs]
        return deepest.reshape(-1, len(self.pairs)) / sizes

    def named(self, chosen):
        """The kinds of the pairs that are chosen in any environment."""
        return [self.kinds[k] for k in np.flatnonzero(chosen.any(axis=0))]


def check_contacts(device, envs, seed):
    pairs = Pairs(device, envs, seed)
    depth, contact = pairs.depths(), pairs.contact_depths()
    deep = depth > MISSED
    assert deep.mean() > 0.6
    assert pairs.named(deep & ~np.isfinite(contact)) == []
    # A contact is as deep as the solids, or deeper along an axis that is not the least.
    assert (contact / depth)[deep].min() > 0.7
    assert pairs.named((depth < -MISSED) & (contact > 0.0)) == []


def test_every_overlap_has_a_contact(device):
    """200 random pairs a kind, and at most a tenth of them apart."""
    check_contacts(device, 16, seed=1)


@pytest.mark.long
@pytest.mark.parametrize("portion", range(2))
def test_every_overlap_of_fifteen_thousand_pairs_has_a_contact(device, portion):
    """78 pairs of kinds, 200 of each."""
    check_contacts(device, PORTION, seed=100 + portion)


@pytest.mark.parametrize(
    ("a", "b", "position", "orientation"),
    [
        # The axis of the rod ends outside the grid of the mesh.
        (
            "cylinder",
            "rod",
            (0.1211815, 0.1151371, 0.1625088),
            ((0.3969995, -0.537506, 0.6054119, 0.4323831), (-0.5838589, 0.2368549, 0.4843274, -0.6069889)),
        ),
        (
            "octahedron",
            "rod",
            (0.0970736, -0.0903063, -0.1603087),
            ((-0.6504381, -0.2336528, 0.7183959, -0.0790182), (0.762637, -0.1475052, -0.0088913, -0.6297206)),
        ),
        # An edge ends more than the reach of a contact above the mesh.
        (
            "tetrahedron",
            "tetrahedron",
            (-0.06427, 0.1091681, -0.1399237),
            ((-0.7898697, 0.6011009, -0.0058334, 0.1214477), (-0.892311, -0.1533063, 0.1869161, -0.3812355)),
        ),
        # An edge whose one end is in a face that it does not oppose leaves the solid beyond the reach of a contact.
        (
            "slab",
            "slab",
            (0.0532311, -0.0184879, -0.0868224),
            ((0.6800429, -0.5081967, -0.0516243, 0.5259398), (0.1122842, -0.9482425, 0.1273425, -0.2683511)),
        ),
    ],
)
def test_a_contact_is_built_as_it_was_found(a, b, position, orientation, device):
    """The search looks no further than contacts reach, the records are built without this limit."""
    a, b = solid(SOLIDS[a]()), solid(SOLIDS[b]())
    scene = Scene(gravity=(0, 0, 0))
    scene.add_body(a.shape, position=(0, 0, 0), orientation=orientation[0])
    scene.add_body(b.shape, position=position, orientation=orientation[1])
    sim, stages = opened(scene, device)
    find_contacts(stages)
    deepest = -contact_list(stages)["gap"].min()
    depth = overlaps(a, b, np.array([[(0, 0, 0), position]]), np.array([orientation]))[0]
    assert depth > LEFT * min(a.shape.size, b.shape.size)
    assert deepest == pytest.approx(depth, rel=0.3)


def check_coming_apart(device, envs, seed):
    pairs = Pairs(device, envs, seed)
    assert (pairs.depths() > 0.3).mean() > 0.3
    pairs.sim.step(240)
    depth = pairs.depths()
    assert pairs.named(depth > LEFT) == []
    # What is pushed apart has no velocity, and stops where the overlap ends.
    assert np.abs(pairs.sim.get("linear_velocity")).max() == 0.0


def test_overlapping_pairs_come_apart(device):
    check_coming_apart(device, 4, seed=2)


@pytest.mark.long
def test_twenty_overlapping_pairs_of_each_kind_come_apart(device):
    check_coming_apart(device, 20, seed=3)


def test_convex_meshes_are_known():
    """A cube of triangles and fine solids are; a bunny, a torus, two cubes and a cube with a dent are not."""
    corners, faces = cube(0.1)
    dented = np.concatenate([corners, [[0.0, 0.0, 0.02]]])
    top = [face for face in faces if (corners[face][:, 2] > 0.0).all()]
    rest = [face for face in faces if not (corners[face][:, 2] > 0.0).all()]
    sides = [(face[i], face[(i + 1) % 3]) for face in top for i in range(3)]
    rim = [side for side in sides if side[::-1] not in sides]
    two = np.concatenate([corners, corners + 1.0]), np.concatenate([faces, np.array(faces) + 8])
    assert len(Mesh(corners, faces).hull) == 8
    assert len(meshes.dodecahedron(0.2, 16).hull) == 20
    for shape in (
        Mesh(dented, rest + [(*side, 8) for side in rim]),
        Mesh(*two),
        meshes.torus(),
        meshes.bunny(),
        Box((1, 1, 1)),
    ):
        assert len(shape.hull) == 0
