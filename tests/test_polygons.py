"""Concave polygons in mesh files: the notch stays open, in every format that has polygons."""

import warnings

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdPhysics

import warp_rigid as wr
from warp_rigid.files.polygons import triangles_of_corners
from warp_rigid.scene.shapes import Mesh

U_OUTLINE = [(3, -3), (3, 3), (1, 3), (1, -2), (-1, -2), (-1, 3), (-3, 3), (-3, -3)]
"""A U with a slot between x = -1 and 1, open at y = 3, counterclockwise; area 26."""
L_OUTLINE = [(0, 0), (4, 0), (4, 1), (1, 1), (1, 4), (0, 4)]
DART = [(0, 0), (4, -3), (0, 5), (-4, -3)]
"""A concave quadrilateral: its first corner points inwards."""
KEYHOLE = [(-3, -3), (3, -3), (3, 3), (-3, 3), (-3, -3), (-1, -1), (-1, 1), (1, 1), (1, -1), (-1, -1)]
"""A square with a square hole as one polygon, with a cut from the outer corner to the inner one."""
SPLIT_SIDES = [(0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (3, 3), (1, 3), (0, 3), (0, 2)]
"""A square with corners on its sides."""


def prism(outline, height=2.0):
    """Points (n, 3) and polygons of the prism over an outline; coincident points are one."""
    flat, index = np.unique(np.array(outline, dtype=float), axis=0, return_inverse=True)
    count, around = len(flat), index.tolist()
    points = np.concatenate([np.column_stack([flat, np.full(count, z)]) for z in (0.0, height)])
    sides = list(zip(around, [*around[1:], around[0]], strict=True))
    walls = [[a, b, b + count, a + count] for a, b in sides if (b, a) not in sides]
    return points, [around[::-1], [i + count for i in around], *walls]


def area_of(outline):
    x, y = np.array(outline, dtype=float).T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def write(path, points, polygons):
    """A file in the format of its suffix."""
    suffix = path.suffix
    if suffix == ".obj":
        lines = [f"v {x} {y} {z}" for x, y, z in points]
        lines += ["f " + " ".join(str(i + 1) for i in polygon) for polygon in polygons]
    elif suffix == ".off":
        lines = ["OFF", f"{len(points)} {len(polygons)} 0", *(f"{x} {y} {z}" for x, y, z in points)]
        lines += [" ".join(map(str, [len(polygon), *polygon])) for polygon in polygons]
    elif suffix == ".ply":
        lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
        lines += [f"property float {axis}" for axis in "xyz"]
        lines += [f"element face {len(polygons)}", "property list uchar int vertex_indices", "end_header"]
        lines += [f"{x} {y} {z}" for x, y, z in points]
        lines += [" ".join(map(str, [len(polygon), *polygon])) for polygon in polygons]
    else:
        write_usd(path, points, polygons)
        return path
    path.write_text("\n".join(lines) + "\n")
    return path


def write_usd(path, points, polygons):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    mesh = UsdGeom.Mesh.Define(stage, "/part")
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    mesh.CreatePointsAttr(points.tolist())
    mesh.CreateFaceVertexCountsAttr([len(polygon) for polygon in polygons])
    mesh.CreateFaceVertexIndicesAttr(sum(polygons, []))
    stage.Save()


FORMATS = (".obj", ".off", ".ply", ".usda")
OUTLINES = {"u": U_OUTLINE, "l": L_OUTLINE, "dart": DART, "keyhole": KEYHOLE, "split sides": SPLIT_SIDES}


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("name", OUTLINES)
def test_a_prism_over_a_polygon(tmp_path, name, suffix):
    """The areas of the triangles add up to that of the prism's sides: none lies over another, or over a notch."""
    outline = OUTLINES[name]
    points, polygons = prism(outline)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = Mesh.from_file(write(tmp_path / f"part{suffix}", points, polygons))
    assert mesh.watertight and not mesh.fault and mesh.repairs == []
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    walls = sum(np.linalg.norm(np.subtract(*points[polygon[:2]])) * 2.0 for polygon in polygons[2:])
    assert mesh.volume == pytest.approx(2.0 * area_of(outline), rel=1e-12)
    assert 0.5 * np.linalg.norm(normals, axis=1).sum() == pytest.approx(2.0 * area_of(outline) + walls, rel=1e-12)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_slot_is_open(tmp_path, suffix):
    """In the middle of the slot's mouth the nearest surface is a wall of the slot, not a membrane."""
    points, polygons = prism(U_OUTLINE)
    mesh = Mesh.from_file(write(tmp_path / f"u{suffix}", points, polygons))
    distance, _ = mesh.signed_distance([(0, 0, 2), (0, 2, 0), (0, 0, 1), (2, 0, 1)])
    np.testing.assert_allclose(distance, [1.0, 1.0, 1.0, -1.0], atol=1e-6)


def test_a_ball_falls_through_the_slot(tmp_path):
    """As a collider of UsdPhysics: a ball of the slot's half width falls freely, g t^2 / 2, below the U."""
    points, polygons = prism(U_OUTLINE)
    scene = wr.import_usd(write(tmp_path / "u.usda", 0.1 * points, polygons))
    scene.add_body(wr.Sphere(0.08), position=(0, 0, 0.3))
    sim = wr.Simulator(scene, device="cpu")
    sim.step(96)
    assert sim.get("position")[0, 1, 2] == pytest.approx(0.3 - 0.5 * 9.81 * 0.4**2, abs=0.01)


def test_random_outlines_in_random_planes():
    """Stars with up to 13 corners, turned: as many triangles as corners less two, with the area of the outline."""
    generator = np.random.default_rng(4)
    for _ in range(200):
        count = int(generator.integers(4, 14))
        angle = 2.0 * np.pi * (np.arange(count) + generator.uniform(0.0, 0.9, count)) / count
        outline = (generator.uniform(0.1, 1.0, count) * [np.cos(angle), np.sin(angle)]).T
        turn = np.linalg.qr(generator.normal(size=(3, 3)))[0]
        points = np.column_stack([outline, np.zeros(count)]) @ turn.T + generator.uniform(-3, 3, 3)
        faces = triangles_of_corners(points, np.arange(count), np.array([count]))
        a, b, c = (points[faces[:, k]] for k in range(3))
        areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        assert faces.shape == (count - 2, 3) and areas.sum() == pytest.approx(area_of(outline), rel=1e-9)


def test_polygons_that_cross_themselves_keep_their_sides():
    """The boundary of the triangles is that of the polygon, so that the mesh around it stays closed."""
    generator = np.random.default_rng(5)
    for _ in range(500):
        count = int(generator.integers(4, 10))
        points = np.column_stack([generator.integers(0, 4, (count, 2)), np.zeros(count)]).astype(float)
        faces = triangles_of_corners(points, np.arange(count), np.array([count]))
        net = np.zeros((count, count), dtype=int)
        np.add.at(net, (faces, np.roll(faces, -1, axis=1)), 1)
        around = np.roll(np.eye(count, dtype=int), 1, axis=1)
        np.testing.assert_array_equal(net - net.T, around - around.T)


def test_negative_numbers_in_an_obj_file_count_back_from_the_latest_point(tmp_path):
    points, polygons = prism(L_OUTLINE)
    lines = []
    for polygon in polygons:
        lines += ["v " + " ".join(map(str, points[i])) for i in polygon]
        lines += ["f " + " ".join(str(k - len(polygon)) for k in range(len(polygon)))]
    path = tmp_path / "l.obj"
    path.write_text("mtllib nowhere.mtl\n" + "\n".join(lines) + "  # the last\n")
    mesh = Mesh.from_file(path)
    assert mesh.watertight and mesh.volume == pytest.approx(2.0 * area_of(L_OUTLINE), rel=1e-12)


@pytest.mark.parametrize(
    ("counts", "indices", "message"),
    [
        ([4, -4, 4], [0, 1, 2, 3], "faceVertexCounts must be >= 0, got -4"),
        ([3, 3], [0, 1, 2], "faceVertexCounts must add up to the length of faceVertexIndices, 3, got 6"),
        ([3], [0, 1, 9], "faceVertexIndices must be >= 0 and < 4, got 0 to 9"),
        ([3], [0, 1, -1], "faceVertexIndices must be >= 0 and < 4, got -1 to 1"),
    ],
)
def test_counts_and_indices_that_are_out_of_range(tmp_path, counts, indices, message):
    path = tmp_path / "wrong.usda"
    write_usd(path, np.eye(4, 3), [[0, 1, 2]])
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/part"))
    mesh.GetFaceVertexCountsAttr().Set(counts)
    mesh.GetFaceVertexIndicesAttr().Set(indices)
    stage.Save()
    with pytest.raises(ValueError) as refusal:
        Mesh.from_file(path)
    assert str(refusal.value) == f"{path}: cannot be read: /part: {message}"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("zero.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "indices must be >= 0 and < 3, got -1 to 1"),
        ("beyond.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "indices must be >= 0 and < 3, got 0 to 3"),
        ("short.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n", "must have 3 points and 1 faces, has 3 lines"),
        ("other.off", "PLY\n", "must begin with OFF, got 'PLY'"),
    ],
)
def test_damaged_files(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ValueError) as refusal:
        Mesh.from_file(path)
    assert str(refusal.value) == f"{path}: cannot be read: {message}"
