"""Surfaces as programs export them: faces in both directions, inverted shells, corners that nearly coincide."""

import itertools
import warnings

import numpy as np
import pytest
import trimesh

from tests.geometry_oracles import cube
from warp_rigid.scene.shapes import Mesh

SIZE = np.array([0.2, 0.1, 0.05])
SIDES = ("x-", "x+", "y-", "y+", "z-", "z+")


def repaired(vertices, faces, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Mesh(vertices, faces, **options)


def box(size=(1, 1, 1), at=(0, 0, 0), inverted=False):
    made = trimesh.creation.box(size)
    made.apply_translation(at)
    if inverted:
        made.invert()
    return made


def union_volume(parts):
    """Volume of the union of boxes, from inclusion and exclusion."""
    bounds = np.array([part.bounds for part in parts])
    total = 0.0
    for count in range(1, len(parts) + 1):
        for chosen in itertools.combinations(bounds, count):
            sides = np.min(chosen, axis=0)[1] - np.max(chosen, axis=0)[0]
            total -= (-1) ** count * np.prod(np.maximum(sides, 0.0))
    return total


def side_faces(names):
    """The numbers of the triangles of a box on some of its sides."""
    normals = box().face_normals
    return np.flatnonzero([any(n["xyz".index(s[0])] == float(s[1] + "1") for s in names) for n in normals])


@pytest.mark.parametrize("names", [n for k in (1, 2, 3, 6) for n in itertools.combinations(SIDES, k)])
def test_sides_of_a_box_that_are_stored_in_both_directions(names):
    """Any sides may be stored twice, in any order: the box is closed, and its volume is the product of its sides."""
    solid = box(SIZE)
    generator = np.random.default_rng(len(names))
    twice = solid.faces[side_faces(names)][:, ::-1]
    faces = generator.permutation(np.concatenate([solid.faces, twice]))
    mesh = repaired(solid.vertices, faces)
    assert mesh.volume == pytest.approx(SIZE.prod(), rel=1e-12)
    assert mesh.watertight and len(mesh.faces) == 12 and not mesh.fault
    assert f"dropped {len(twice)} repeated faces" in mesh.repairs
    assert mesh.signed_distance([[0, 0, 0.025]])[0] == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("inverted", [False, True])
def test_the_common_side_of_two_boxes_is_no_wall(inverted):
    """Two boxes that share the corners of a side are one solid, also if one of them is inverted."""
    vertices, faces = cube()
    moved = vertices + [np.ptp(vertices[:, 0]), 0, 0]
    other = faces[:, ::-1] if inverted else faces
    pair = np.concatenate([vertices, moved]), np.concatenate([faces, other + len(vertices)])
    mesh = repaired(*pair)
    single = repaired(vertices, faces)
    assert mesh.volume == pytest.approx(2.0 * single.volume, rel=1e-12) and mesh.watertight and not mesh.fault
    middle = [[vertices[:, 0].max(), *vertices[:, 1:].mean(axis=0)]]
    assert mesh.signed_distance(middle)[0] == pytest.approx(-0.5 * np.ptp(vertices[:, 1]), rel=1e-6)


def test_a_fin_of_no_thickness_is_dropped():
    """A sheet in both directions on an edge of a box bounds no volume."""
    solid = box()
    corner, edge = solid.vertices[0], solid.vertices[solid.edges_unique[0]]
    tip = edge.mean(axis=0) + 2.0 * (edge.mean(axis=0) - solid.centroid)
    fin = np.array([*solid.edges_unique[0], len(solid.vertices)])
    vertices = np.concatenate([solid.vertices, [tip]])
    mesh = repaired(vertices, np.concatenate([solid.faces, [fin, fin[::-1]]]))
    assert mesh.volume == pytest.approx(1.0, rel=1e-12) and not mesh.fault and len(mesh.faces) == 12
    assert mesh.signed_distance([corner])[0] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("first", [0, 1])
def test_a_solid_that_fills_a_cavity_leaves_none(first):
    """The faces of a cavity and of a solid inside it cancel: a ball in its socket, both from one program."""
    outer, core = box(), box((0.5, 0.5, 0.5))
    inner = [core.faces + 8, core.faces[:, ::-1] + 8]
    faces = np.concatenate([outer.faces, inner[first], inner[1 - first]])
    mesh = repaired(np.concatenate([outer.vertices, core.vertices]), faces)
    assert mesh.volume == pytest.approx(1.0, rel=1e-9)
    assert mesh.signed_distance([[0, 0, 0]])[0] == pytest.approx(-0.5, rel=1e-6)


def test_a_cavity_that_is_stored_twice_stays():
    outer, core = box(), box((0.5, 0.5, 0.5), inverted=True)
    faces = np.concatenate([outer.faces, core.faces + 8, core.faces + 8])
    mesh = repaired(np.concatenate([outer.vertices, core.vertices]), faces)
    assert mesh.volume == pytest.approx(1.0 - 0.125, rel=1e-12)


OVERLAPPING = {
    "two equal boxes": [box(), box(at=(0.5, 0.3, 0.2))],
    "a small one at a corner": [box(), box((0.4, 0.4, 0.4), (0.5, 0.5, 0.5))],
    "a bar through a box": [box(), box((3, 0.2, 0.2))],
    "edge to edge": [box(), box(at=(1, 1, 0))],
    "side to side": [box(), box(at=(1, 0, 0))],
    "three in a row": [box(), box(at=(0.7, 0.1, 0.1)), box(at=(1.4, -0.1, 0.2))],
    "apart": [box(), box((0.5, 0.5, 0.5), (3, 0, 0))],
}


@pytest.mark.parametrize("parts", OVERLAPPING.values(), ids=OVERLAPPING.keys())
def test_inverted_shells_that_overlap_are_turned_in_any_order(parts):
    """Whichever shells are inverted, in whatever order their faces lie: the volume is that of the union."""
    generator = np.random.default_rng(len(parts))
    expected = union_volume(parts)
    for inverted in itertools.product([False, True], repeat=len(parts)):
        for _ in range(4):
            chosen = [part.copy() for part in parts]
            for part, is_inverted in zip(chosen, inverted, strict=True):
                if is_inverted:
                    part.invert()
            whole = trimesh.util.concatenate([chosen[k] for k in generator.permutation(len(chosen))])
            faces = np.array([np.roll(face, generator.integers(3)) for face in generator.permutation(whole.faces)])
            mesh = repaired(whole.vertices, faces)
            assert mesh.volume == pytest.approx(expected, rel=1e-9), inverted


@pytest.mark.parametrize("inverted", [False, True])
def test_cavities_within_solids_within_cavities(inverted):
    """A solid that floats in a cavity stays solid, however it is turned, and a cavity stays a cavity."""
    sizes = (1.0, 0.8, 0.6, 0.4)
    parts = [box((size,) * 3, inverted=bool(k % 2)) for k, size in enumerate(sizes)]
    if inverted:
        parts[2].invert()
    whole = trimesh.util.concatenate(parts)
    mesh = repaired(whole.vertices, whole.faces)
    assert mesh.volume == pytest.approx(1.0 - 0.8**3 + 0.6**3 - 0.4**3)


def tiled_box(size, tiles):
    """The sides of a box as separate triangles (m, 3, 3) float64, `tiles` squares along each edge."""
    solid = box(size)
    for _ in range(tiles.bit_length() - 1):
        solid = solid.subdivide()
    return solid.triangles.copy()


@pytest.mark.parametrize("offset", [0.0, 0.3, 5.0])
def test_corners_that_differ_in_the_last_bits_of_float32(tmp_path, offset):
    """Every triangle of an STL file has its own corners, rounded on its own: a closed box all the same."""
    generator = np.random.default_rng(1)
    triangles = tiled_box(SIZE, 8) + [offset, 0.0, 0.0]
    assert len(triangles) == 768
    exact = triangles.astype(np.float32)
    steps = generator.integers(-1, 2, exact.shape)
    moved = np.where(steps == 0, exact, np.nextafter(exact, np.where(steps > 0, np.inf, -np.inf).astype(np.float32)))
    corners = moved.reshape(-1, 3)
    path = tmp_path / "noise.stl"
    trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False).export(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = Mesh.from_file(path)
    assert mesh.watertight and not mesh.fault and len(mesh.vertices) == 386 and len(mesh.faces) == 768
    assert mesh.volume == pytest.approx(SIZE.prod(), rel=1e-5)


def test_corners_that_are_written_with_six_digits():
    """Turned and rounded to six digits, each triangle on its own."""
    generator = np.random.default_rng(2)
    turn = trimesh.transformations.random_rotation_matrix(generator.random(3))[:3, :3]
    triangles = tiled_box(SIZE, 4) @ turn.T + generator.uniform(-3e-7, 3e-7, (192, 3, 3))
    corners = np.array([float(f"{x:.6g}") for x in triangles.ravel()]).reshape(-1, 3)
    mesh = repaired(corners, np.arange(len(corners)).reshape(-1, 3))
    assert mesh.watertight and not mesh.fault and len(mesh.faces) == 192
    assert mesh.volume == pytest.approx(SIZE.prod(), rel=1e-4)


def test_small_features_of_a_closed_mesh_are_kept():
    """Corners are merged at open edges only: a step of a millionth of the size stays."""
    solid = box()
    sheared = solid.vertices.copy()
    thin = box((1.0, 1.0, 1e-7))
    mesh = repaired(np.concatenate([sheared, thin.vertices + [3, 0, 0]]), np.concatenate([solid.faces, thin.faces + 8]))
    assert len(mesh.vertices) == 16 and mesh.repairs == []
