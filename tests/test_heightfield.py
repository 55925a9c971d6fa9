"""Height fields: exact distances however steep, against plain float64 distances to their triangles."""

import math

import numpy as np
import pytest
from pxr import Usd

import warp_rigid as wr
from tests.geometry_oracles import distance_to_triangles
from tests.test_distance import measure
from warp_rigid.engine.simulator import Simulator
from warp_rigid.render.film import film_from_recording
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, HarmonicMotion, Heightfield, PartKind, Sphere

GENERATOR = np.random.default_rng(5)
FIELDS = {
    "gentle": Heightfield(0.1 * GENERATOR.normal(size=(7, 9)), (3.0, 2.0)),
    "alps": Heightfield(2.0 * GENERATOR.normal(size=(8, 6)), (2.0, 2.5)),
    "cliff": Heightfield(np.where(np.arange(12)[:, None] < 6, 3.0, 0.0) * np.ones((12, 5)), (3.0, 1.0)),
    "cone": Heightfield(4.0 * np.hypot(*np.meshgrid(np.linspace(-1, 1, 15), np.linspace(-1, 1, 15))), (2.0, 2.0)),
}


def oracle(field, points):
    """Signed distance from the triangles and the height of the one below or above the point."""
    vertices, faces = field.surface()
    triangles = vertices[faces]
    distance = distance_to_triangles(points, triangles)
    under = np.zeros(len(points), bool)
    for a, b, c in triangles:
        # In the triangle's plan, by its barycentric coordinates.
        plan = np.linalg.solve(np.column_stack([b[:2] - a[:2], c[:2] - a[:2]]), (points[:, :2] - a[:2]).T)
        covers = (plan >= 0.0).all(axis=0) & (plan.sum(axis=0) <= 1.0)
        height = a[2] + plan[0] * (b[2] - a[2]) + plan[1] * (c[2] - a[2])
        under |= covers & (points[:, 2] < height)
    return np.where(under, -distance, distance)


def points_within(field, count=1500):
    """Points above and below a field, clear of its border's sides."""
    lower, upper = field.bounds
    generator = np.random.default_rng(2)
    points = generator.uniform(-1, 1, (count, 3)) * (0.499 * field.extent[0], 0.499 * field.extent[1], 1.0)
    points[:, 2] = generator.uniform(lower[2] - 0.3, upper[2] + 0.5, count)
    return points.astype(np.float32).astype(np.float64)


@pytest.mark.parametrize("name", FIELDS)
def test_distance_is_exact_however_steep(device, name):
    """Within reach the kernels' distance is exact, beyond a lower bound; the host's is exact everywhere."""
    field = FIELDS[name]
    points = points_within(field)
    expected = oracle(field, points)
    side = (np.abs(points[:, :2]) - 0.5 * field.extent).max(axis=1)
    expected = np.where((expected < 0.0) & (side > expected), side, expected)
    told, normal = field.signed_distance(points)
    np.testing.assert_allclose(told, expected, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)
    found, direction = measure(field, points, device)
    bound = np.abs(found) < np.abs(expected) - 3e-6
    assert (np.abs(found) <= np.abs(expected) + 3e-6).all()
    assert (np.abs(expected[bound]) > 0.5).all(), "exact up to the reach at least"
    assert (np.sign(found) == np.sign(expected))[np.abs(expected) > 1e-5].all()
    np.testing.assert_allclose(found[~bound], expected[~bound], atol=3e-6)
    landed = points - found[:, None] * direction
    far_from_ridge = ~bound & (np.abs(expected) > 1e-3)
    np.testing.assert_allclose(oracle(field, landed)[far_from_ridge & (side < expected)], 0.0, atol=2e-5)


def test_distance_on_a_slope_and_at_the_border():
    x = np.linspace(-1, 1, 9)
    slope = Heightfield(np.repeat(0.75 * x[:, None], 5, axis=1), (2, 2))
    distance, gradient = slope.signed_distance([[0.1, 0.2, 0.5], [0.3, -0.2, 0.2], [1.25, 0, 0.5], [0.99, 0, -2]])
    normal = np.array([-0.6, 0, 0.8])
    np.testing.assert_allclose(distance[:2], [0.8 * 0.5 - 0.06, 0.8 * 0.2 - 0.18], atol=1e-12)
    np.testing.assert_allclose(gradient[:2], [normal, normal], atol=1e-12)
    # Beside the solid, and inside it near its upright side.
    np.testing.assert_allclose(distance[2:], [0.25, -0.01], atol=1e-12)
    np.testing.assert_allclose(gradient[2:], [[1, 0, 0], [1, 0, 0]], atol=1e-12)
    vertices, faces = slope.surface()
    edge = vertices[faces]
    assert len(faces) == 2 * 8 * 4
    assert (np.cross(edge[:, 1] - edge[:, 0], edge[:, 2] - edge[:, 0])[:, 2] > 0).all()
    part = slope.parts()[0]
    assert part.kind == PartKind.HEIGHTFIELD and part.size == (2.0, 2.0, 0.75, 0.0)
    assert part.grid.values.shape == (9, 5, 1)
    np.testing.assert_allclose(part.grid.origin, (-1, -1, 0))
    assert slope.size == math.inf


def test_a_ball_at_the_foot_of_a_cliff_touches_it(device):
    """Its centre lies far above the floor: only a true distance tells that the cliff is near."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(FIELDS["cliff"], friction=0.0)
    # The cliff's face falls by 3 m over one cell, from x = -3/22 to +3/22.
    slant = np.array([3.0, 0.0, 3.0 / 11.0]) / math.hypot(3.0, 3.0 / 11.0)
    scene.add_body(Sphere(0.2), position=np.array([0, 0, 1.5]) + 0.3 * slant, linear_velocity=-slant, friction=0.0)
    sim = Simulator(scene, device=device)
    sim.step(48)
    gap = (sim.get("position")[0, 1] - [0, 0, 1.5]) @ slant - 0.2
    # Without restitution an impact ends the approach up to a step before the surfaces meet.
    assert -1e-4 < gap < 1.0 / 240.0 + 1e-5


def test_a_box_slides_off_the_border_and_falls(device):
    scene = Scene()
    scene.add_static(Heightfield(np.zeros((3, 3)), (1.0, 1.0)), friction=0.0)
    scene.add_body(Box((0.1, 0.1, 0.1)), position=(0.3, 0, 0.1), linear_velocity=(1, 0, 0), friction=0.0)
    sim = Simulator(scene, device=device)
    sim.step(40)
    assert sim.get("position")[0, 1, 2] == pytest.approx(0.1, abs=1e-4)
    sim.step(200)
    assert sim.get("position")[0, 1, 2] < -1.0
    assert np.linalg.norm(sim.get("linear_velocity")[0, 1, :2]) < 3.0


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: HarmonicMotion(1.0, 2.0) and Heightfield(np.zeros((2, 2)), (1, 1), motion=3), "motion"),
        (lambda: Heightfield(np.zeros((2, 2)), (1, 1), HarmonicMotion(np.zeros(3), 1.0)), "amplitude"),
        (lambda: Heightfield(np.zeros((2, 2)), (1, 1), HarmonicMotion(np.nan, 1.0)), "amplitude"),
        (lambda: Heightfield(np.zeros((2, 2)), (1, 1), HarmonicMotion(1.0, -1.0)), "angular_frequency"),
        (lambda: Heightfield(np.zeros((2, 2)), (1, 1), HarmonicMotion(1.0, 1.0, np.zeros((3, 2)))), "phase"),
    ],
)
def test_bad_motions_are_refused(make, field):
    with pytest.raises(ValueError, match=f"^{field}: "):
        make()


def test_moving_ground_is_drawn_at_the_time_of_its_environment(tmp_path):
    """Of three environments, the second one was reset before the recording, and the third one is reset within it."""
    motion = HarmonicMotion(0.1, 2.0 * np.pi)
    scene = wr.Scene()
    scene.add_kinematic(Heightfield(np.zeros((2, 2)), (2, 2), motion), name="sea")
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 5))
    sim = wr.Simulator(scene, num_envs=3, settings=wr.Settings(dt=1 / 240), device="cpu")
    sim.step(60)
    sim.reset(envs=[1])
    recording = wr.record(sim, 2, on_frame=lambda index, sim: sim.reset(envs=[2]) if index == 1 else None)
    times = np.array([[60, 0, 60], [64, 4, 64], [68, 8, 4]]) / 240
    np.testing.assert_allclose(recording.times, times)
    recording.save(tmp_path / "film.npz")
    heights = 0.1 * np.sin(2.0 * np.pi * times)
    for one in (recording, wr.Recording.load(tmp_path / "film.npz")):
        film = film_from_recording(one)
        drawn = [[film.meshes[film.mesh[2 * env]].frames[frame][0, 2] for env in range(3)] for frame in range(3)]
        np.testing.assert_allclose(drawn, heights, atol=1e-6)
    for profile in ("animation", "scene"):
        wr.export_usd(recording, tmp_path / f"{profile}.usda", profile=profile)
        stage = Usd.Stage.Open(str(tmp_path / f"{profile}.usda"))
        for env in range(3):
            below = Usd.PrimRange(stage.GetPrimAtPath(f"/World/env_{env:04}/sea"), Usd.TraverseInstanceProxies())
            (points,) = (prim.GetAttribute("points") for prim in below if prim.GetTypeName() == "Mesh")
            np.testing.assert_allclose([points.Get(code)[0][2] for code in range(3)], heights[:, env], atol=1e-6)
    sim.reset()
    sim.step(4)
    with (
        pytest.raises(ValueError, match="^sim: an environment was reset apart"),
        wr.UsdStream(sim, tmp_path / "s.usdc") as stream,
    ):
        sim.reset(envs=[0])
        stream.capture(sim)
    back = wr.import_usd(tmp_path / "scene.usda", "/World/env_0001")
    assert back.bodies[0].shape.phase == pytest.approx(np.zeros((2, 2)), abs=1e-6)
