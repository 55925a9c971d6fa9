"""Distance grids of meshes: values, interpolation, cache; their signs and errors, V05 to V07, are in the validation."""

import os
import warnings

import numpy as np
import pytest
import warp as wp

from tests.geometry_oracles import (
    cube,
    distance_to_triangles,
    hollow_cube,
    l_prism,
    numeric_gradient,
    points_around,
    star_prism,
    winding,
)
from warp_rigid.scene.shapes import Mesh, distance_grid
from warp_rigid.scene.shapes.base import Grid
from warp_rigid.scenes.builders import meshes
from warp_rigid.validation.solids import spike, tetrahedron, wedge

SAMPLE_COUNT = 20_000

SHARP = {
    "spike": spike(),
    "wedge": wedge(),
    "tet_corner": tetrahedron([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]),
    "needle": tetrahedron([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0.03, 0.03, 2)]),
    "star": star_prism(),
    "l_prism": l_prism(),
    "hollow_cube": hollow_cube(),
}


@pytest.fixture(autouse=True, scope="module")
def cache(tmp_path_factory):
    """A cache folder of this module's own."""
    folder = tmp_path_factory.mktemp("grids")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WARP_RIGID_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="module")
def bunny():
    return meshes.bunny()


def exact_distance(mesh, points):
    """Signed distance by brute force."""
    triangles = mesh.vertices[mesh.faces]
    inside = winding(points, triangles) > 0.5
    return np.where(inside, -1.0, 1.0) * distance_to_triangles(points, triangles)


@pytest.mark.parametrize("name", SHARP)
def test_distance_to_triangles_is_exact(name, device):
    mesh = Mesh(*SHARP[name])
    points = points_around(*mesh.bounds, 2.0, 1000, np.random.default_rng(1))
    distance, direction = distance_grid.mesh_distance(mesh.vertices, mesh.faces, points, True, wp.get_device(device))
    extent = np.ptp(mesh.vertices, axis=0).max()
    np.testing.assert_allclose(distance, exact_distance(mesh, points), atol=1e-6 * extent)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, atol=1e-12)
    foot = points - distance[:, None] * direction
    assert distance_to_triangles(foot[:100], mesh.vertices[mesh.faces]).max() < 1e-6 * extent


def test_bunny_distance_is_exact(bunny):
    points = points_around(*bunny.bounds, 1.3, 150, np.random.default_rng(2))
    distance, _ = bunny.signed_distance(points)
    np.testing.assert_allclose(distance, exact_distance(bunny, points), atol=1e-7)


@pytest.mark.parametrize("simple", [True, False], ids=["pseudonormal", "winding"])
def test_nodes_hold_the_distance_to_the_mesh(device, simple):
    mesh = meshes.torus(0.4, 0.15, segments=24)
    origin, spacing, shape = distance_grid.grid_layout(mesh.vertices, 32)
    values = distance_grid.bake(mesh.vertices, mesh.faces, origin, spacing, shape, simple, wp.get_device(device))
    assert values.shape == shape and values.dtype == np.float32
    chosen = np.random.default_rng(3).integers(0, values.size, 1500)
    index = np.stack(np.unravel_index(chosen, shape), axis=1)
    expected = exact_distance(mesh, origin + spacing * index)
    np.testing.assert_allclose(values[tuple(index.T)], expected, atol=1e-6)


@pytest.mark.parametrize("name", ["cube", "l_prism", "torus"])
def test_sign_and_leaks_at_every_node(name):
    build = {"cube": cube, "l_prism": l_prism}
    mesh = meshes.torus(segments=24) if name == "torus" else Mesh(*build[name]())
    mesh = Mesh(mesh.vertices, mesh.faces, sdf_resolution=24)
    grid = mesh.grid
    index = np.stack(np.meshgrid(*map(np.arange, grid.values.shape), indexing="ij"), axis=-1)
    nodes = np.array(grid.origin) + grid.spacing * index.reshape(-1, 3)
    inside = winding(nodes, mesh.vertices[mesh.faces]) > 0.5
    values = grid.values.reshape(-1)
    clear = np.abs(values) > 1e-6
    np.testing.assert_array_equal((values < 0.0)[clear], inside[clear])
    # along every grid line the value changes by no more than the spacing: no leaks, no jumps
    for axis in range(3):
        assert np.abs(np.diff(grid.values, axis=axis)).max() <= grid.spacing * (1 + 1e-4)


def test_layout_has_the_resolution_and_three_cells_of_padding(bunny):
    grid = bunny.grid
    lower, upper = bunny.bounds
    assert grid.spacing == pytest.approx((upper - lower).max() / 64)
    assert max(grid.values.shape) == 64 + 6 + 1
    far = np.array(grid.origin) + grid.spacing * (np.array(grid.values.shape) - 1)
    assert (lower - grid.origin >= 3 * grid.spacing * (1 - 1e-6)).all()
    assert (far - upper >= 3 * grid.spacing * (1 - 1e-6)).all()
    assert (far - upper < 3.6 * grid.spacing).all()
    assert not grid.values.flags.writeable
    (part,) = bunny.parts()
    assert part.grid is grid and bunny.grid is grid


def analytic_grid(distance, extent, cells):
    """A grid whose nodes hold a known distance, around a body of the given longest side."""
    spacing = extent / cells
    count = cells + 2 * distance_grid.PADDING_CELLS + 1
    axis = (np.arange(count) - 0.5 * (count - 1)) * spacing
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    values = distance(nodes).reshape(count, count, count).astype(np.float32)
    return Grid((axis[0], axis[0], axis[0]), spacing, values)


def sphere_distance(points):
    return np.linalg.norm(points, axis=1) - 0.5


def torus_distance(points):
    ring = np.linalg.norm(points[:, :2], axis=1) - 0.4
    return np.hypot(ring, points[:, 2]) - 0.15


def band(distance, extent, width, count=100_000):
    """Points within `width` of a surface."""
    points = np.random.default_rng(4).uniform(-0.5 * extent - width, 0.5 * extent + width, (8 * count, 3))
    return points[np.abs(distance(points)) < width][:count]


@pytest.mark.parametrize(("distance", "extent", "sharpest"), [(sphere_distance, 1.0, 0.5), (torus_distance, 1.1, 0.15)])
def test_interpolation_converges_at_second_order(distance, extent, sharpest):
    errors = []
    for cells in (32, 64, 128):
        grid = analytic_grid(distance, extent, cells)
        points = band(distance, extent, 3 * grid.spacing)
        value, _ = distance_grid.interpolate(grid, points)
        errors.append(np.abs(value - distance(points)).max())
        # Trilinear error: h^2/8 times the sum of the second derivatives, at most 2/r for radius r
        radius = sharpest - 3 * grid.spacing
        assert errors[-1] <= grid.spacing**2 / (4 * radius) + 1e-7
    if distance is sphere_distance:
        assert 3.5 < errors[0] / errors[1] < 5.0 and 3.5 < errors[1] / errors[2] < 5.0


@pytest.mark.parametrize("cells", [64, 128])  # h = R / 32 and R / 64
def test_sphere_normals_have_the_error_of_a_trilinear_gradient(cells):
    grid = analytic_grid(sphere_distance, 1.0, cells)
    points = band(sphere_distance, 1.0, grid.spacing)
    _, gradient = distance_grid.interpolate(grid, points)
    radial = points / np.linalg.norm(points, axis=1, keepdims=True)
    cosine = np.einsum("ij,ij->i", gradient, radial) / np.linalg.norm(gradient, axis=1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    # In each of the two tangent directions the slope is that of the cell's middle, at most h / 2
    # away where the normal has turned by h / (2 r): 1.27 degrees in all at R / 32
    radius = 0.5 - grid.spacing
    assert angle.max() < np.degrees(grid.spacing / (2**0.5 * radius))
    assert angle.mean() < 1.0 and (cells < 128 or angle.max() < 1.0)


def test_gradient_is_that_of_the_interpolation(bunny):
    points = points_around(*bunny.bounds, 1.3, 3000, np.random.default_rng(5))
    step = 1e-7
    place = (points - np.array(bunny.grid.origin)) / bunny.grid.spacing
    within = (np.abs(place - np.round(place)) > 1e-3).all(axis=1)  # no step leaves its cell
    numeric = numeric_gradient(lambda at: distance_grid.interpolate(bunny.grid, at)[0], points, step)
    _, gradient = distance_grid.interpolate(bunny.grid, points)
    assert within.sum() > 2500
    np.testing.assert_allclose(gradient[within], numeric[within], atol=1e-5)


def test_bunny_grid_is_near_the_exact_distance(bunny):
    points = points_around(*bunny.bounds, 1.2, SAMPLE_COUNT, np.random.default_rng(7))
    exact, _ = bunny.signed_distance(points)
    value, _ = distance_grid.interpolate(bunny.grid, points)
    near = np.abs(exact) < 3 * bunny.grid.spacing
    error = np.abs(value - exact)[near] / bunny.grid.spacing
    assert near.sum() > 3000
    assert error.max() < 1.0 and error.mean() < 0.05


def test_outside_the_grid_distances_are_lower_bounds(bunny):
    points = points_around(*bunny.bounds, 8.0, 5000, np.random.default_rng(8))
    lower = np.array(bunny.grid.origin)
    upper = lower + bunny.grid.spacing * (np.array(bunny.grid.values.shape) - 1)
    points = points[((points < lower) | (points > upper)).any(axis=1)]
    distance, gradient = distance_grid.interpolate(bunny.grid, points)
    exact, direction = bunny.signed_distance(points)
    error_of_grid = 0.2 * bunny.grid.spacing
    assert (distance <= exact + error_of_grid).all() and (distance > 0.7 * exact).all()
    assert (np.linalg.norm(gradient, axis=1) < 1.0 + 1e-3).all()
    assert np.einsum("ij,ij->i", gradient, direction).min() > 0.0
    # across the border neither jumps
    wall = points_around(lower, upper, 1.0, 500, np.random.default_rng(9))
    wall[:, 0] = upper[0]
    pair = [distance_grid.interpolate(bunny.grid, wall + [step, 0, 0])[0] for step in (-1e-7, 1e-7)]
    np.testing.assert_allclose(*pair, atol=1e-6)


def test_open_mesh_is_the_solid_with_lids():
    vertices, faces = cube()
    lidless = Mesh(vertices, faces[2:], sdf_resolution=24)
    closed = Mesh(vertices, faces, sdf_resolution=24)
    assert not lidless.watertight and closed.watertight
    np.testing.assert_allclose(lidless.grid.values, closed.grid.values, atol=1e-6)


def test_skull_grid_has_a_usable_sign_and_no_jumps():
    skull = meshes.skull_like(sdf_resolution=48)
    grid = skull.grid
    for axis in range(3):
        assert np.abs(np.diff(grid.values, axis=axis)).max() <= grid.spacing * (1 + 1e-4)
    cells = (grid.values < 0).mean() * grid.values.size
    assert cells * grid.spacing**3 == pytest.approx(skull.volume, rel=0.02)
    assert distance_grid.interpolate(skull.grid, np.array([[-0.02, 0, 0.03]]))[0][0] < -0.05


def cache_files(folder):
    return sorted(folder.glob("*"))


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_RIGID_CACHE", str(tmp_path / "new" / "folder"))
    return tmp_path / "new" / "folder"


@pytest.fixture
def bakes(monkeypatch):
    """Counts how often a grid is computed."""
    calls = []
    original = distance_grid.bake

    def counted(*arguments):
        calls.append(arguments)
        return original(*arguments)

    monkeypatch.setattr(distance_grid, "bake", counted)
    return calls


def small_mesh(resolution=16):
    return Mesh(*cube(), sdf_resolution=resolution)


def test_a_grid_is_computed_at_first_use_and_then_read(empty_cache, bakes):
    mesh = small_mesh()
    _ = mesh.volume, mesh.samples(), mesh.key
    assert not bakes
    values = mesh.grid.values
    assert len(bakes) == 1 and len(cache_files(empty_cache)) == 1
    np.testing.assert_array_equal(small_mesh().grid.values, values)
    assert len(bakes) == 1
    _ = small_mesh(17).grid
    assert len(bakes) == 2 and len(cache_files(empty_cache)) == 2
    assert all(file.suffix == ".npz" for file in cache_files(empty_cache))


@pytest.mark.parametrize("damage", ["cut", "garbage", "empty", "pickle", "shape", "nan", "name"])
def test_a_file_that_does_not_fit_is_rebuilt(empty_cache, bakes, damage):
    values = small_mesh().grid.values
    (file,) = cache_files(empty_cache)
    content = file.read_bytes()
    if damage == "cut":
        file.write_bytes(content[: len(content) // 2])
    elif damage == "garbage":
        file.write_bytes(b"PK\x03\x04" + b"\x00" * 100)
    elif damage == "empty":
        file.write_bytes(b"")
    elif damage == "pickle":
        np.savez(file, values=np.array([{"a": 1}], dtype=object))
    elif damage == "shape":
        np.savez(file, values=values[1:])
    elif damage == "nan":
        np.savez(file, values=np.where(values > 0, np.nan, values).astype(np.float32))
    else:
        np.savez(file, other=values)
    np.testing.assert_array_equal(small_mesh().grid.values, values)
    assert len(bakes) == 2
    np.testing.assert_array_equal(small_mesh().grid.values, values)
    assert len(bakes) == 2, "the rebuilt file serves again"


def test_a_folder_that_cannot_be_written_is_no_error(tmp_path, monkeypatch, bakes):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    monkeypatch.setenv("WARP_RIGID_CACHE", str(blocked / "below"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _ = small_mesh().grid
        _ = small_mesh().grid
    assert len(bakes) == 2 and blocked.read_text() == "in the way"


def test_nothing_is_left_behind_when_the_disk_is_full(empty_cache, monkeypatch):
    def full(*_, **__):
        raise OSError("No space left on device")

    monkeypatch.setattr(np, "savez", full)
    _ = small_mesh().grid
    assert cache_files(empty_cache) == []


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="one core")
def test_slabs_on_several_threads_give_what_one_gives(monkeypatch):
    mesh = Mesh(*star_prism())
    layout = distance_grid.grid_layout(mesh.vertices, 24)
    device = wp.get_device("cpu")
    threaded = distance_grid.bake(mesh.vertices, mesh.faces, *layout, True, device)
    monkeypatch.setattr(distance_grid.os, "cpu_count", lambda: 1)
    single = distance_grid.bake(mesh.vertices, mesh.faces, *layout, True, device)
    np.testing.assert_array_equal(threaded, single)
