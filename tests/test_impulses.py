"""Contact impulses: the closed forms of one contact, Coulomb's law at the fixed point, and momentum."""

import numpy as np
import pytest
from scipy.optimize import nnls

from tests.oracles import (
    GROUND,
    ContactProblem,
    contact_list,
    find_contacts,
    ground_scene,
    moving,
    opened,
    random_pile,
    random_quaternion,
    rotate_about,
    rotation_matrix,
)
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Capsule, Sphere

PLAIN = {"collision_iterations": 0, "shock_propagation": "off", "warm_starting": False}


def solve(device, scene, **settings):
    """Contact problem of a scene's first step, its velocities before and after the contact stage, and impulses."""
    sim, stages = opened(scene, device, settings=Settings(**{**PLAIN, **settings}))
    return solve_stage(stages)


def solve_stage(stages):
    find_contacts(stages)
    stages.build_graph()
    stages.integrate_velocities(after_impacts=True)
    problem = ContactProblem(stages)
    before = problem.velocity(stages)
    stages.solve_contacts()
    after = problem.velocity(stages)
    return problem, before, after, contact_list(stages)["impulse"].astype(np.float64)


def impulse_2003(k, v, n, friction):
    """The inelastic impulse of Guendelman et al. 2003, section 7: stick if the cone holds it, otherwise slide."""
    stick = np.linalg.solve(k, -v)
    along = stick @ n
    if np.linalg.norm(stick - along * n) <= friction * along:
        return stick
    slip = v - (v @ n) * n
    slip /= np.linalg.norm(slip)
    pull = n - friction * slip
    return -(v @ n) / (n @ k @ pull) * pull


def one_contact(problem):
    """Matrix K and frame of the only contact."""
    (rows,) = problem.jacobian
    k = np.einsum("kbi,bij,lbj->kl", rows, problem.inverse_mass_matrix, rows)
    normal = problem.contacts["normal"][0].astype(np.float64)
    frame = np.stack([normal, rows[1, problem.contacts["body_a"][0], :3], rows[2, problem.contacts["body_a"][0], :3]])
    return frame.T @ k @ frame, frame, normal


@pytest.mark.parametrize("friction", [0.0, 0.05, 0.2, 0.5, 2.0])
def test_one_ball_sticks_or_slides_as_in_2003(device, friction):
    """One visit is exact: a ball's normal and tangential impulses do not mix."""
    generator = np.random.default_rng(int(100 * friction))
    for _ in range(5):
        scene = Scene(gravity=(0, 0, 0))
        scene.add_static(GROUND, friction=friction)
        scene.add_body(
            Sphere(0.2),
            position=(0, 0, 0.2),
            mass=3.0,
            friction=friction,
            linear_velocity=(*generator.normal(size=2), -generator.uniform(0.5, 2)),
            angular_velocity=generator.normal(scale=5, size=3),
        )
        problem, before, after, impulse = solve(device, scene, contact_iterations=1)
        k, frame, normal = one_contact(problem)
        expected = impulse_2003(k, problem.slip(before)[0] @ frame, normal, friction)
        np.testing.assert_allclose(impulse[0] @ frame, expected, atol=2e-6 * np.linalg.norm(expected))
        np.testing.assert_allclose(after, before + problem.change(impulse), atol=1e-5)


def lowest_corner(box, turn):
    """Height of a turned box's lowest corner above its centre (negative)."""
    corners = box.half_extents * (2.0 * np.array(list(np.ndindex(2, 2, 2))) - 1.0)
    return (corners @ rotation_matrix(turn).T)[:, 2].min()


def test_one_box_corner_sticks_as_in_2003(device):
    """A corner's normal and tangential impulses do mix: the sweeps converge to K^-1 of the approach."""
    generator = np.random.default_rng(7)
    sticking = 0
    for _ in range(12):
        scene = Scene(gravity=(0, 0, 0))
        scene.add_static(GROUND, friction=2.0)
        turn = random_quaternion(generator)
        box = Box((0.2, 0.3, 0.4))
        scene.add_body(
            box,
            position=(0, 0, -lowest_corner(box, turn)),
            orientation=turn,
            linear_velocity=(*generator.normal(scale=0.3, size=2), -1.0),
            friction=2.0,
            mass=2.0,
        )
        problem, before, _, impulse = solve(device, scene, contact_iterations=400)
        assert len(impulse) == 1
        k, frame, normal = one_contact(problem)
        velocity = problem.slip(before)[0] @ frame
        expected = np.linalg.solve(k, -velocity)
        if np.linalg.norm(expected - (expected @ normal) * normal) < 2.0 * expected @ normal:
            sticking += 1
            np.testing.assert_allclose(expected, impulse_2003(k, velocity, normal, 2.0))
            np.testing.assert_allclose(impulse[0] @ frame, expected, atol=1e-4 * np.linalg.norm(expected))
    assert sticking >= 6


def boxes(generator, count, friction):
    """A few boxes on each other, thrown at each other and the ground."""
    scene = ground_scene(friction=friction)
    for k in range(count):
        scene.add_body(
            Box((0.1, 0.12, 0.1)),
            position=(0.03 * (-1) ** k, 0, 0.1 + 0.2 * k),
            orientation=rotate_about((0, 0, 1), 10 * k),
            linear_velocity=(*generator.normal(scale=0.5, size=2), -0.5),
            angular_velocity=generator.normal(scale=1.0, size=3),
            mass=1.0 + 2.0 * k,
            friction=friction,
        )
    return scene


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("friction", [0.0, 0.1, 0.4, 1.0])
def test_many_sweeps_satisfy_coulomb_s_law(device, count, friction):
    """Residuals in float64 from the impulses alone: complementarity, cone, and friction that opposes the slip."""
    for seed in range(3):
        scene = boxes(np.random.default_rng(seed), count, friction)
        problem, before, after, impulse = solve(device, scene, contact_iterations=8000)
        assert len(impulse) >= 4 * count - 3
        recomputed = before + problem.change(impulse)
        np.testing.assert_allclose(after, recomputed, atol=1e-4)
        assert problem.coulomb_residual(before, 0 * impulse).max() > 0.1
        assert problem.coulomb_residual(recomputed, impulse).max() < 2e-5


@pytest.mark.parametrize("count", [1, 2, 3])
def test_frictionless_fixed_point_is_the_quadratic_program_s(device, count):
    """Without friction the velocities minimise the contact energy over impulses >= 0: solved by active sets."""
    for seed in range(3):
        scene = boxes(np.random.default_rng(seed), count, 0.0)
        problem, before, after, _ = solve(device, scene, contact_iterations=3000)
        normal = problem.jacobian[:, 0]
        flat = normal.reshape(len(normal), -1)
        whole = problem.delassus()[::3, ::3]
        linear = problem.slip(before)[:, 0] + problem.bias
        root = np.linalg.cholesky(whole + 1e-9 * np.trace(whole) * np.eye(len(whole)))
        best, _ = nnls(root.T, np.linalg.solve(root, -linear))
        change = np.einsum("bij,bj->bi", problem.inverse_mass_matrix, (best @ flat).reshape(-1, 6))
        np.testing.assert_allclose(after, before + change, atol=2e-4)


def test_the_cone_is_never_left(device):
    """After few sweeps and after many, in every mode of shock propagation, in a pile in motion."""
    for mode in ("off", "one_pass", "two_pass"):
        scene = random_pile(np.random.default_rng(3), friction=0.3)
        sim, _ = opened(scene, device, settings=Settings(shock_propagation=mode))
        sliding = 0
        for _ in range(8):
            sim.step(20)
            sliding += check_cone(sim.contacts())
        assert sliding > 20


def check_cone(records):
    """Impulses of the last step push and lie in the cone; returns how many lie on its border."""
    impulse, normal = records["impulse"].astype(np.float64), records["normal"].astype(np.float64)
    along = np.einsum("ij,ij->i", impulse, normal)
    across = np.linalg.norm(impulse - along[:, None] * normal, axis=1)
    scale = 1e-6 * max(along.max(initial=0.0), 1e-3)
    assert along.min(initial=0.0) >= -scale
    assert (across <= 0.3 * along * (1 + 1e-5) + scale).all()
    return int(((across > 0.299 * along) & (along > 1e3 * scale)).sum())


def test_momentum_is_conserved_between_free_bodies(device):
    """A swarm without ground or gravity: linear and angular momentum stay, whatever the contacts do."""
    generator = np.random.default_rng(4)
    scene = Scene(gravity=(0, 0, 0))
    for k in range(24):
        size = generator.uniform(0.08, 0.15)
        shape = (Sphere(size), Box(size * generator.uniform(0.5, 1, 3)), Capsule(0.5 * size, size))[k % 3]
        center = generator.uniform(-0.4, 0.4, 3)
        scene.add_body(
            shape,
            position=center,
            orientation=random_quaternion(generator),
            linear_velocity=-3.0 * center + generator.normal(scale=0.5, size=3),
            angular_velocity=generator.normal(scale=3.0, size=3),
            density=generator.uniform(100, 10000),
            restitution=0.5 * (k % 2),
        )
    for settings in (Settings(), Settings(shock_propagation="off", collision_first=False)):
        sim, stages = opened(scene, device, settings=settings)
        find_contacts(stages)
        stages.build_graph()
        problem = ContactProblem(stages)
        assert len(problem.contacts["gap"]) > 30
        start = momenta(problem, problem.velocity(stages))
        scale = np.abs(weighted(problem, problem.velocity(stages))).sum(axis=0)
        stages.solve_impacts()
        np.testing.assert_allclose(momenta(problem, problem.velocity(stages)), start, atol=1e-6 * scale.max())
        stages.solve_contacts()
        np.testing.assert_allclose(momenta(problem, problem.velocity(stages)), start, atol=1e-6 * scale.max())
        # Ten sweeps leave 0.012 m/s of impacts at 3 m/s.
        assert problem.coulomb_residual(problem.velocity(stages), contact_list(stages)["impulse"]).max() < 0.025


@pytest.mark.parametrize("speed", [3.0, 6.0])
@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_a_ball_that_strikes_the_ground_gains_the_spin_of_its_friction(device, restitution, dt, speed):
    """Closed form: the friction impulse acts at the radius, up to mu times the normal impulse or until the slip ends.

    In a step the ball moves by up to its radius, so that the impulse is computed while there is a gap.
    """
    radius, angles, frictions = 0.1, np.radians([10, 30, 45, 60, 80]), np.array([0.1, 0.5])
    angle, friction = (values.ravel() for values in np.meshgrid(angles, frictions))
    scene = Scene(gravity=(0, 0, 0), friction_combine="max")
    scene.add_static(GROUND, friction=0.0, restitution=restitution)
    scene.add_body(Sphere(radius), position=(0, 0, radius + 0.05), restitution=restitution)
    sim = Simulator(scene, num_envs=len(angle), settings=Settings(dt=dt), device=device)
    sim.set("friction", friction[:, None], bodies=[1])
    across, down = speed * np.sin(angle), speed * np.cos(angle)
    sim.set("linear_velocity", np.stack([across, 0 * angle, -down], axis=1)[:, None], bodies=[1])
    sim.step(round(0.5 / dt))
    stopped = np.minimum(friction * (1 + restitution) * down, across / 3.5)
    linear, angular = sim.get("linear_velocity")[:, 1], sim.get("angular_velocity")[:, 1]
    np.testing.assert_allclose(linear[:, 0], across - stopped, atol=1e-4 * speed)
    np.testing.assert_allclose(linear[:, 2], restitution * down, atol=1e-4 * speed)
    np.testing.assert_allclose(radius * angular[:, 1], stopped / 0.4, atol=1e-4 * speed)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_collisions_gain_no_energy(device, restitution):
    """Bodies of all kinds thrown at each other at once, with friction; each pair's impulse is its own."""
    generator = np.random.default_rng(8)
    for _ in range(4):
        scene = random_pile(generator, friction=0.5)
        scene.gravity = (0.0, 0.0, 0.0)
        sim, stages = opened(scene, device, settings=Settings(collision_iterations=20))
        sim.set("restitution", restitution)
        sim.set("position", generator.uniform(-0.2, 0.2, (sim.num_bodies, 3)) + [0, 0, 0.3], bodies=None)
        sim.set("linear_velocity", generator.normal(scale=2.0, size=(sim.num_bodies, 3)))
        sim.set("angular_velocity", generator.normal(scale=5.0, size=(sim.num_bodies, 3)))
        statics = np.flatnonzero(~moving(scene))
        for name in ("position", "linear_velocity", "angular_velocity"):
            sim.set(name, (0.0, 0.0, 0.0), bodies=statics)
        find_contacts(stages)
        stages.build_graph()
        problem = ContactProblem(stages)
        impulse = np.zeros((len(problem.contacts["gap"]), 3))
        before = problem.energy(problem.velocity(stages), impulse)
        stages.solve_impacts()
        after = problem.energy(problem.velocity(stages), impulse)
        assert len(impulse) > 50
        assert after < (1.0 + 1e-6) * before
        assert after < 0.999 * before or restitution == 1.0


def test_no_single_impact_gains_energy(device):
    """Eccentric blows with friction, where Newton's law of restitution alone would gain energy (Kane's paradox)."""
    count, generator = 400, np.random.default_rng(9)
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(GROUND, friction=0.6, restitution=1.0)
    rod = scene.add_body(Box((0.5, 0.1, 0.05)), friction=0.6, restitution=1.0)
    sim = Simulator(scene, num_envs=count, device=device)
    turns = random_quaternion(generator, count)
    sim.set("orientation", turns[:, None], bodies=[rod])
    heights = [-lowest_corner(scene.bodies[rod].shape, turn) for turn in turns]
    sim.set("position", np.column_stack([np.zeros((count, 2)), heights])[:, None], bodies=[rod])
    sim.set("linear_velocity", generator.normal(size=(count, 1, 3)) - [0, 0, 2], bodies=[rod])
    sim.set("angular_velocity", generator.normal(scale=3.0, size=(count, 1, 3)), bodies=[rod])
    before = sim.get("kinetic_energy")[:, rod]
    sim.step()
    after = sim.get("kinetic_energy")[:, rod]
    assert (sim.get("linear_velocity")[:, rod, 2] > 0.0).mean() > 0.5
    assert (after <= before * (1.0 + 1e-5)).all()
    assert (after > 0.999 * before).sum() > 20


def weighted(problem, velocity):
    """Linear and angular momentum of each body about the origin, (bodies, 6)."""
    linear = velocity[:, :3] / problem.inverse_mass[:, None]
    spin = np.linalg.solve(problem.inverse_inertia, velocity[:, 3:, None])[..., 0]
    return np.concatenate([linear, spin + np.cross(problem.center, linear)], axis=1)


def momenta(problem, velocity):
    return weighted(problem, velocity).sum(axis=0)
