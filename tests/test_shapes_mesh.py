"""Meshes: repairs, refusals, files, ready-made meshes (V04)."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.geometry_oracles import cube, hollow_cube, star_prism
from warp_rigid.files import mesh_files
from warp_rigid.scene.shapes import Mesh
from warp_rigid.scenes.builders import meshes


@pytest.fixture(scope="module")
def bunny():
    return meshes.bunny()


def repaired(vertices, faces):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = Mesh(vertices, faces)
    assert len(caught) == (1 if mesh.repairs else 0)
    for warning in caught:
        assert "\n" not in str(warning.message)
    return mesh


def assert_sane(mesh):
    assert mesh.volume > 0.0
    assert np.isfinite(mesh.center_of_mass).all() and np.isfinite(mesh.inertia).all()
    assert np.linalg.eigvalsh(mesh.inertia)[0] > 0.0
    samples = mesh.samples()
    for array in (samples.point, samples.normal, samples.cluster_radius):
        assert np.isfinite(array).all()


def assert_same_solid(mesh, other, tolerance=1e-12):
    assert_sane(mesh)
    assert mesh.volume == pytest.approx(other.volume, rel=tolerance)
    np.testing.assert_allclose(mesh.center_of_mass, other.center_of_mass, atol=tolerance)
    limit = tolerance * other.inertia.max()
    np.testing.assert_allclose(mesh.inertia, other.inertia, atol=limit)


def test_a_good_mesh_is_left_alone(bunny):
    again = repaired(bunny.vertices, bunny.faces)
    assert again.repairs == [] and again.watertight
    np.testing.assert_array_equal(again.vertices, bunny.vertices)
    np.testing.assert_array_equal(again.faces, bunny.faces)


def test_inverted_winding(bunny):
    inverted = repaired(bunny.vertices, bunny.faces[:, ::-1])
    assert inverted.repairs == ["turned 12200 faces of an inverted surface outward"]
    assert_same_solid(inverted, bunny)


def test_faces_that_disagree_with_their_neighbours(bunny):
    flip = np.random.default_rng(0).random(len(bunny.faces)) < 0.3
    mixed = np.where(flip[:, None], bunny.faces[:, ::-1], bunny.faces)
    mesh = repaired(bunny.vertices, mixed)
    assert mesh.repairs == [f"turned {flip.sum()} faces that disagreed with their neighbours"]
    assert_same_solid(mesh, bunny)


def test_holes(bunny):
    generator = np.random.default_rng(1)
    kept = np.ones(len(bunny.faces), dtype=bool)
    for seed in generator.integers(0, len(bunny.vertices), 12):
        gap = np.linalg.norm(bunny.vertices - bunny.vertices[seed], axis=1)
        kept &= ~(gap < 0.006)[bunny.faces].any(axis=1)
    holed = repaired(bunny.vertices, bunny.faces[kept])
    assert not holed.watertight and 100 < (~kept).sum() < 1000
    assert_sane(holed)
    assert holed.volume == pytest.approx(bunny.volume, rel=5e-3)
    np.testing.assert_allclose(holed.inertia, bunny.inertia, atol=5e-3 * bunny.inertia.max())


def test_duplicate_vertices(bunny):
    soup = bunny.vertices[bunny.faces].reshape(-1, 3)
    mesh = repaired(soup, np.arange(len(soup)).reshape(-1, 3))
    assert mesh.repairs == [f"merged {len(soup) - 6102} duplicate vertices"]
    assert mesh.watertight and len(mesh.vertices) == 6102
    assert_same_solid(mesh, bunny)


def test_zero_area_and_repeated_faces_and_unused_vertices():
    vertices, faces = cube()
    extra = np.concatenate([vertices, [[9.0, 9.0, 9.0]], vertices[[0]]])
    degenerate = np.array([[0, 0, 1], [2, 3, 2], [0, 9, 4]])
    mesh = repaired(extra, np.concatenate([faces, degenerate, faces[:2, [1, 2, 0]]]))
    assert mesh.repairs == [
        "merged 1 duplicate vertices",
        "dropped 3 faces without area",
        "dropped 2 repeated faces",
        "dropped 1 vertices that no face uses",
    ]
    assert mesh.watertight
    assert_same_solid(mesh, Mesh(vertices, faces))


def test_a_flat_sliver_between_collinear_corners_is_no_hole():
    vertices, faces = cube()
    middle = vertices[[0, 4]].mean(axis=0)
    split = [face for face in faces.tolist() if not {0, 4} <= set(face)]
    cut = [face for face in faces.tolist() if {0, 4} <= set(face)]
    assert len(cut) == 2
    # one side of the edge 0-4 is cut at its middle, and a sliver without area fills the gap
    a, b = cut[0], cut[1]
    k = next(i for i in range(3) if {a[i], a[(i + 1) % 3]} == {0, 4})
    first, second, third = a[k], a[(k + 1) % 3], a[(k + 2) % 3]
    split += [b, [first, 8, third], [8, second, third], [first, second, 8]]
    mesh = repaired(np.concatenate([vertices, [middle]]), np.array(split))
    assert "dropped 1 faces without area" in mesh.repairs
    assert_same_solid(mesh, Mesh(vertices, faces))
    points = np.random.default_rng(2).uniform(-1, 1, (500, 3))
    distance, _ = mesh.signed_distance(points)
    expected = Mesh(vertices, faces).signed_distance(points)[0]
    np.testing.assert_allclose(distance, expected, atol=1e-6)


def test_cavities_survive_and_inverted_bodies_do_not():
    hollow = repaired(*hollow_cube())
    assert hollow.repairs == [] and hollow.volume == pytest.approx(0.488)
    vertices, faces = hollow_cube()
    assert repaired(vertices, faces[:, ::-1]).volume == pytest.approx(0.488)
    inward = cube()[0], cube()[1][:, ::-1]
    pair = np.concatenate([cube()[0], inward[0] * 0.5 + 3.0])
    both = repaired(pair, np.concatenate([cube()[1], inward[1] + 8]))
    assert both.repairs == ["turned 12 faces of an inverted surface outward"]
    assert both.volume == pytest.approx(1.125)


GOOD = cube()


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3), int), "vertices: must be shaped"),
        (GOOD[0], np.zeros((0, 3), int), "faces: must be shaped"),
        (GOOD[0][:, :2], GOOD[1], "vertices: must be shaped"),
        (GOOD[0], GOOD[1][:, :2], "faces: must be shaped"),
        (GOOD[0], GOOD[1].astype(float), "faces: must be whole numbers"),
        (GOOD[0], GOOD[1] + 1, "faces: must name vertices 0 to 7, got 1 to 8"),
        (GOOD[0] * [1, np.nan, 1], GOOD[1], "vertices: must be finite"),
        (GOOD[0] * [1, 1, np.inf], GOOD[1], "vertices: must be finite"),
        (np.zeros((8, 3)), GOOD[1], "faces: must hold a triangle with an area"),
        (GOOD[0] * [1, 1, 0], GOOD[1], "mesh: must enclose a volume"),
        (GOOD[0], GOOD[1][:1], "mesh: must enclose a volume"),
        (GOOD[0], GOOD[1][:2], "mesh: must enclose a volume"),
    ],
)
def test_what_cannot_be_repaired_is_refused_in_one_line(vertices, faces, message):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(ValueError) as refusal:
            Mesh(vertices, faces)
    assert str(refusal.value).startswith(message) and "\n" not in str(refusal.value)


@pytest.mark.parametrize("resolution", [7, 513, 64.0, "fine"])
def test_resolution_out_of_range(resolution):
    with pytest.raises(ValueError, match="^sdf_resolution: must be a whole number from 8 to 512"):
        Mesh(*GOOD, sdf_resolution=resolution)


def test_random_damage_never_gives_a_bad_mass():
    generator = np.random.default_rng(3)
    base = meshes.torus(segments=16)
    refused = 0
    for _ in range(60):
        vertices, faces = base.vertices.copy(), base.faces.copy()
        faces = faces[generator.random(len(faces)) < generator.uniform(0.02, 1.0)]
        flip = generator.random(len(faces)) < generator.choice([0.0, 0.5, 1.0])
        faces[flip] = faces[flip, ::-1]
        swap = generator.random(len(faces)) < generator.choice([0.0, 0.2])
        faces[swap, 0] = faces[swap, 1]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                mesh = Mesh(vertices, faces, sdf_resolution=512)  # a coarse grid is refused for thin walls
        except ValueError as error:
            refused += "\n" not in str(error)
        else:
            assert_sane(mesh)
    assert refused < 30


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "glb", "off"])
def test_files_that_trimesh_reads(tmp_path, suffix):
    vertices, faces = star_prism()
    vertices = vertices + [0.0, 0.5, 2.0]
    path = tmp_path / f"star.{suffix}"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # merging what the format repeats is no news
        mesh = Mesh.from_file(path, scale=0.1, sdf_resolution=16)
    expected = Mesh(0.1 * vertices, faces)
    assert mesh.watertight and len(mesh.faces) == len(faces) and mesh.sdf_resolution == 16
    assert mesh.volume == pytest.approx(expected.volume, rel=1e-5)
    center = expected.center_of_mass
    if suffix == "glb":  # glTF is y up
        center = np.array([center[0], -center[2], center[1]])
    np.testing.assert_allclose(mesh.center_of_mass, center, atol=1e-6)
    assert bool(mesh.repairs) == (suffix == "stl")


USD_TEXT = """#usda 1.0
(
    metersPerUnit = 0.01
    upAxis = "{up}"
)
def Xform "root" {{
    double3 xformOp:translate = (0, 100, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Mesh "block" {{
        point3f[] points = [(-50,-50,-50), (-50,-50,50), (-50,50,-50), (-50,50,50),
                            (50,-50,-50), (50,-50,50), (50,50,-50), (50,50,50)]
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = [0,1,3,2, 4,6,7,5, 0,4,5,1, 2,3,7,6, 0,2,6,4, 1,5,7,3]
        uniform token orientation = "{hand}Handed"
    }}
    def Mesh "mirrored" {{
        double3 xformOp:scale = (-1, 1, 0.5)
        double3 xformOp:translate = (300, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
        point3f[] points = [(0,0,0), (100,0,0), (0,100,0), (0,0,100)]
        int[] faceVertexCounts = [3, 3, 3, 3]
        int[] faceVertexIndices = [0,2,1, 0,1,3, 0,3,2, 1,2,3]
    }}
}}
"""


@pytest.mark.parametrize(("up", "hand"), [("Y", "right"), ("Z", "right"), ("Z", "left")])
def test_usd_units_axes_places_and_polygons(tmp_path, up, hand):
    path = tmp_path / "two.usda"
    path.write_text(USD_TEXT.format(up=up, hand=hand))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mesh = Mesh.from_file(path, scale=2.0)
    assert len(mesh.faces) == 12 + 4
    assert mesh.volume == pytest.approx(8.0 * (1.0 + 0.5 / 6.0), rel=1e-6)
    # a left-handed file's faces were turned while reading, so they are wrong here and repaired
    assert bool(mesh.repairs) == (hand == "left")
    center_y_up = (np.array([0, 1, 0]) + np.array([2.75, 1.25, 0.125]) / 12.0) / (1 + 1 / 12)
    if up == "Y":
        center_y_up = center_y_up[[0, 2, 1]] * [1, -1, 1]
    np.testing.assert_allclose(mesh.center_of_mass, 2.0 * center_y_up, atol=1e-6)


def test_unreadable_files_are_refused_by_name(tmp_path):
    broken = tmp_path / "broken.obj"
    broken.write_text("f 1 2 3\n")
    text = tmp_path / "notes.txt"
    text.write_text("no mesh")
    scrap = tmp_path / "scrap.usda"
    scrap.write_text("#usda 1.0\n(")
    empty = tmp_path / "empty.usda"
    empty.write_text("#usda 1.0\n")
    flat = tmp_path / "flat.obj"
    flat.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    for path in (broken, text, scrap, empty, flat):
        with pytest.raises(ValueError) as refusal:
            Mesh.from_file(path)
        assert str(refusal.value).startswith(f"{path}: ") and "\n" not in str(refusal.value)
    with pytest.raises(ValueError, match="^scale: "):
        Mesh.from_file(flat, scale=0)


@pytest.mark.parametrize("suffix", [".stl", ".usda"])
def test_a_missing_file_is_named(tmp_path, suffix):
    path = tmp_path / f"missing{suffix}"
    with pytest.raises(FileNotFoundError) as refusal:
        Mesh.from_file(path)
    assert str(refusal.value) == f"{path}: no such file"


def test_bunny(bunny):
    assert bunny.watertight and bunny.repairs == []
    assert bunny.vertices.shape == (6102, 3) and len(bunny.faces) == 12_200
    np.testing.assert_allclose(bunny.center_of_mass, 0.0, atol=1e-12)
    moments = np.diag(bunny.inertia)
    np.testing.assert_allclose(bunny.inertia, np.diag(moments), atol=1e-9 * moments.max())
    assert (np.diff(moments) > 0).all()
    import warp

    raw = Path(warp.__file__).parent / "examples" / "assets" / "bunny.usd"
    upright, *_ = mesh_files.load(raw)
    scale = 0.2 / np.ptp(upright, axis=0).max()
    gap = np.linalg.norm(bunny.vertices[0] - bunny.vertices[5000])
    assert gap == pytest.approx(scale * np.linalg.norm(upright[0] - upright[5000]))
    assert meshes.bunny(size=0.4).volume == pytest.approx(8.0 * bunny.volume)


@pytest.mark.parametrize(
    ("make", "faces", "volume"),
    [
        (meshes.tetrahedron, 4, 8 / (9 * 3**0.5)),
        (meshes.octahedron, 8, 4 / 3),
        (meshes.icosahedron, 20, 2.5361507),
        (meshes.dodecahedron, 36, 2.7851639),
    ],
)
def test_platonic_solids(make, faces, volume):
    solid = make(radius=1.0)
    assert len(solid.faces) == faces and solid.watertight and solid.repairs == []
    assert solid.volume == pytest.approx(volume, rel=1e-7)
    np.testing.assert_allclose(np.linalg.norm(solid.vertices, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(solid.center_of_mass, 0.0, atol=1e-12)
    np.testing.assert_allclose(solid.inertia, np.eye(3) * solid.inertia[0, 0], atol=1e-12)


def test_ring_is_a_pierced_prism():
    ring = meshes.ring(0.06, 0.1, 0.04, segments=48)
    polygon = 0.5 * 48 * np.sin(2 * np.pi / 48)
    assert ring.repairs == [] and ring.watertight
    assert ring.volume == pytest.approx(polygon * (0.1**2 - 0.06**2) * 0.04)
    with pytest.raises(ValueError, match="^outer: "):
        meshes.ring(0.1, 0.1)
    with pytest.raises(ValueError, match="^segments: "):
        meshes.ring(segments=4)
    with pytest.raises(ValueError, match="^major: "):
        meshes.torus(0.01, 0.02)


def test_the_triangles_of_a_mesh_with_holes_decide_unless_it_crosses_itself():
    """A missing face, a box without a lid; then its floor through the cap, a crack, and two balls, one with a hole."""
    box = trimesh.creation.box((1, 1, 1)).subdivide().subdivide().subdivide()
    assert not Mesh(box.vertices, box.faces[1:]).fault
    lidless = box.faces[box.face_normals[:, 2] < 0.9]
    assert not Mesh(box.vertices, lidless).fault
    floor = np.flatnonzero((box.vertices[:, 2] < -0.49) & (np.abs(box.vertices[:, :2]) < 0.45).all(axis=1))
    for height in (0.02, 0.05, 0.2):
        for vertex in floor[::9]:
            spiked = box.vertices.copy()
            spiked[vertex, 2] = 0.5 + height
            assert "crosses itself" in Mesh(spiked, lidless).fault
    cube = trimesh.creation.box((0.2, 0.2, 0.2))
    first, second, third = cube.faces[0]
    middle = 0.5 * (cube.vertices[first] + cube.vertices[second])
    cracked = np.concatenate([cube.faces[1:], [[first, 8, third], [8, second, third]]])
    for seed in range(6):
        matrix = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))[:3, :3]
        assert "crosses itself" in Mesh(np.concatenate([cube.vertices, [middle]]) @ matrix.T, cracked).fault
    balls = trimesh.util.concatenate([trimesh.creation.icosphere(2).apply_translation((x, 0, 0)) for x in (0, 1)])
    assert "crosses itself" in Mesh(balls.vertices, balls.faces[1:]).fault
