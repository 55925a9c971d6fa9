"""Ground that moves: bodies follow it, are thrown by it and carried on it, each environment by its own time."""

import math

import numpy as np
import pytest

from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.render.film import film_from_recording, film_from_usd
from warp_rigid.render.framing import fit_camera, points_to_see
from warp_rigid.render.raycast import RayCaster
from warp_rigid.runs.recording import Recording, record
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import Box, HarmonicMotion, Heightfield, Sphere
from warp_rigid.usd import export_usd

DT = 1.0 / 240.0
FREQUENCY = 2.0 * math.pi * 2.0


def table(amplitude, frequency=FREQUENCY, phase=0.0, size=2.0, vertices=5):
    """A flat plate that vibrates up and down."""
    return Heightfield(np.zeros((vertices, vertices)), (size, size), HarmonicMotion(amplitude, frequency, phase))


def on_table(shape, height, device, amplitude, restitution=0.0, friction=0.5, phase=0.0, **options):
    scene = Scene()
    scene.add_kinematic(table(amplitude, phase=phase), restitution=restitution, friction=friction)
    scene.add_body(shape, position=(0.13, -0.21, height), restitution=restitution, friction=friction)
    return Simulator(scene, device=device, **options)


@pytest.mark.parametrize("shape", [Sphere(0.1), Box((0.1, 0.1, 0.1))])
@pytest.mark.parametrize("restitution", [0.0, 0.8])
def test_a_body_follows_the_plate_while_it_falls_slower_than_free(device, shape, restitution):
    """Amplitude times frequency squared below g: it stays on, to a tenth of a millimetre, bouncy or not."""
    amplitude = 0.8 * 9.81 / FREQUENCY**2
    # At a phase of a quarter turn the plate starts at its top, at rest.
    sim = on_table(shape, 0.1 + amplitude, device, amplitude, restitution, phase=0.5 * math.pi)
    for _ in range(240):
        sim.step(1)
        plate = amplitude * math.cos(FREQUENCY * sim.time)
        # A bouncy body may leave by what the plate's acceleration changes within a step.
        assert sim.get("position")[0, 1, 2] - 0.1 - plate == pytest.approx(0.0, abs=1e-4 if restitution == 0 else 3e-4)
    assert abs(sim.get("position")[0, 1, :2] - [0.13, -0.21]).max() < 1e-4


def test_a_body_is_thrown_when_the_plate_falls_faster(device):
    """It leaves where the plate's acceleration reaches -g, and flies a parabola of the speed it has there."""
    ratio = 2.0
    amplitude = ratio * 9.81 / FREQUENCY**2
    start = -0.5 * math.pi
    sim = on_table(Box((0.1, 0.1, 0.1)), 0.1 - amplitude, device, amplitude, phase=start)
    leaving = (math.asin(1.0 / ratio) - start) / FREQUENCY
    speed = amplitude * FREQUENCY * math.cos(math.asin(1.0 / ratio))
    top = 0.1 + amplitude / ratio + speed**2 / (2.0 * 9.81)
    heights = []
    while sim.time < leaving + speed / 9.81 + 2 * DT:
        sim.step(1)
        heights.append(sim.get("position")[0, 1, 2])
    # The step in which it leaves is known to a step's part of its fall.
    assert max(heights) == pytest.approx(top, abs=0.5 * 9.81 * DT * DT + 0.005 * speed**2 / (2.0 * 9.81))
    assert max(heights) > 0.1 + amplitude


def test_a_falling_ball_rebounds_from_the_plates_own_velocity(device):
    """An impact at the restitution e turns the relative velocity: v' = w + e (w - v), w the plate's velocity."""
    amplitude, e = 0.02, 0.6
    scene = Scene(gravity=(0, 0, 0))
    scene.add_kinematic(table(amplitude), restitution=e, friction=0.0)
    scene.add_body(Sphere(0.1), position=(0.1, 0.1, 0.1 + 0.06), linear_velocity=(0, 0, -1), restitution=e, friction=0)
    sim = Simulator(scene, device=device)
    while sim.get("linear_velocity")[0, 1, 2] < 0.0:
        hit = sim.time
        sim.step(1)
    low, high = (amplitude * FREQUENCY * math.cos(FREQUENCY * t) for t in (hit + DT, hit - DT))
    expected = sorted(w + e * (w + 1.0) for w in (low, high))
    assert expected[0] - 1e-4 <= sim.get("linear_velocity")[0, 1, 2] <= expected[1] + 1e-4
    assert abs(expected[0] - e) > 0.1, "the plate's velocity must matter"


def wave_scene(friction, slope=0.0):
    """A wave that travels along x over 8 m, and a box on it."""
    x = np.linspace(-4, 4, 81)
    length, frequency, amplitude = 2.0, 6.0, 0.05
    phase = np.broadcast_to(-2.0 * math.pi / length * x[:, None], (81, 5))
    field = Heightfield(np.zeros((81, 5)), (8.0, 2.0), HarmonicMotion(amplitude, frequency, phase))
    scene = Scene()
    scene.add_kinematic(field, friction=friction)
    scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 0.11 + amplitude), friction=friction)
    return scene, field


def test_a_box_rides_a_travelling_wave(device):
    """Never inside it, never off it by more than a throw; material moves up and down only, so friction holds it."""
    scene, field = wave_scene(friction=1.0)
    sim = Simulator(scene, device=device)
    heights = []
    for _ in range(120):
        sim.step(4)
        assert sim.penetration()[0] < 2e-3
        x, z = sim.get("position")[0, 1, [0, 2]]
        heights.append(z)
        here = field.amplitude[0, 0] * math.sin(6.0 * sim.time - math.pi * x)
        assert -5e-3 < z - 0.1 - here < 0.06
    assert np.ptp(heights[30:]) > 0.05, "it goes up and down with the wave"
    assert abs(sim.get("position")[0, 1, 0]) < 1.0


def test_each_environment_has_its_own_time(device):
    """After a reset one environment's ground starts anew, bit for bit, while the other's goes on."""
    scene, _ = wave_scene(friction=0.5)
    sim, fresh = (Simulator(scene, num_envs=2, device=device) for _ in range(2))
    sim.step(100)
    np.testing.assert_array_equal(sim.get("position")[0], sim.get("position")[1])
    sim.reset(envs=[1])
    sim.step(50)
    fresh.step(50)
    np.testing.assert_array_equal(sim.get("position")[1], fresh.get("position")[1])
    fresh.step(100)
    np.testing.assert_array_equal(sim.get("position")[0], fresh.get("position")[0])
    assert not np.array_equal(sim.get("position")[0], sim.get("position")[1])


def test_either_order_of_stages_follows_the_plate(device):
    sim = on_table(
        Box((0.1, 0.1, 0.1)), 0.1 + 0.01, device, 0.01, phase=0.5 * math.pi, settings=Settings(collision_first=False)
    )
    for _ in range(60):
        sim.step(2)
        assert sim.get("position")[0, 1, 2] - 0.1 == pytest.approx(0.01 * math.cos(FREQUENCY * sim.time), abs=2e-4)


def test_heights_speed_and_slope_bounds():
    generator = np.random.default_rng(4)
    motion = HarmonicMotion(generator.normal(size=(6, 4)), 3.0, generator.uniform(0, 6, (6, 4)))
    field = Heightfield(generator.normal(size=(6, 4)), (2.0, 1.0), motion)
    times = np.linspace(0, 2.2, 400)
    heights = np.array([field.heights_at(t) for t in times])
    np.testing.assert_allclose(heights[0], field.heights + motion.amplitude * np.sin(motion.phase))
    lower, upper = field.bounds
    assert lower[2] <= heights.min() and heights.max() <= upper[2]
    assert np.abs(np.diff(heights, axis=0)).max() / times[1] <= field.top_speed * (1 + 1e-9)
    slopes = np.hypot(np.abs(np.diff(heights, axis=1)).max() / 0.4, np.abs(np.diff(heights, axis=2)).max() * 3.0)
    assert slopes <= field.steepest_slope * (1 + 1e-9)


def test_only_kinematic_ground_moves():
    with pytest.raises(ValueError, match="^shape: a Heightfield with a motion can only be kinematic, not static$"):
        Scene().add_static(table(0.1))
    with pytest.raises(ValueError, match="^shape: a Heightfield can only be static, not dynamic$"):
        Scene().add_body(table(0.1))
    scene = Scene()
    scene.add_kinematic(table(0.1))
    scene.add_static(Heightfield(np.zeros((2, 2)), (1, 1)))
    assert [body.motion for body in scene.bodies] == [Motion.KINEMATIC, Motion.STATIC]


def test_recordings_and_films_show_the_ground_as_it_is(device, tmp_path):
    """Drawn vertices follow the closed form, from a recording, a saved one and a USD file; the picture changes."""
    scene, field = wave_scene(friction=0.5)
    recording = record(Simulator(scene, device=device), frames=6, fps=20)
    recording.save(tmp_path / "wave.npz")
    films = [film_from_recording(recording), film_from_recording(Recording.load(tmp_path / "wave.npz"))]
    for profile in ("animation", "scene"):
        for layout in ("single", "payloads", "clips"):
            path = tmp_path / f"{profile}_{layout}.usdc"
            export_usd(recording, path, profile=profile, layout=layout)
            films.append(film_from_usd(path))
    for film in films:
        (ground,) = (mesh for mesh in film.meshes if mesh.frames)
        for frame, vertices in enumerate(ground.frames):
            expected = field.heights_at(frame / 20.0).reshape(-1)
            np.testing.assert_allclose(vertices[:, 2], expected, atol=1e-6)
    camera = fit_camera(points_to_see(films[0], [0]), 1.0, 40)
    caster = RayCaster(films[0], camera)
    first, later, again = (caster.draw(frame, 40, 40).astype(int) for frame in (0, 5, 0))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - later).max() > 5


def test_nothing_falls_asleep_on_ground_that_moves(device):
    """Hardly visible as the motion is, the body on it goes on with it; on ground that rests it falls asleep."""
    for amplitude, sleeps in ((2e-5, False), (0.0, True)):
        settings = Settings(sleeping=True)
        sim = on_table(Box((0.1, 0.1, 0.1)), 0.1, device, amplitude, settings=settings)
        sim.step(480)
        assert sim.get("asleep")[0, 1] == sleeps
