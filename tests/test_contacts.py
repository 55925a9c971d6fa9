"""Contact rows, compared with float64, and their initial impulses."""

import numpy as np
import pytest

from tests.oracles import (
    ContactProblem,
    contact_list,
    find_contacts,
    ground_scene,
    moving,
    opened,
    random_pile,
    rotate_about,
    rotation_matrix,
    stages_of,
    tangent_basis,
)
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.kernels.tuning import TOUCHING, WIDER
from warp_rigid.scene.scene import COMBINE_RULES, Scene
from warp_rigid.scene.shapes import Box, Compound, Mesh, Plane, Sphere
from warp_rigid.scenes.builders import meshes


def settling_pile(device, steps=150, seed=0):
    """A simulator and stages of a pile with many contacts, one body of which has its centre of mass off its origin."""
    scene = random_pile(np.random.default_rng(seed))
    lopsided = Compound(
        [(Box((0.1, 0.05, 0.05)), (0.1, 0, 0), (0, 0, 0, 1)), (Sphere(0.08), (-0.1, 0.02, 0), (0, 0, 0, 1))]
    )
    scene.add_body(lopsided, position=(0.0, 0.0, 2.8), orientation=rotate_about((1, 1, 0), 30))
    scene.add_body(meshes.torus(0.1, 0.04, sdf_resolution=16), position=(0.1, 0.1, 2.5))
    sim, stages = opened(scene, device)
    sim.step(steps)
    find_contacts(stages)
    return sim, stages


def off_surface(scene, state, body, points):
    """How far points (n, 3) of the world lie off the surfaces of their bodies (n,), in parts of what is allowed.

    A mesh's grid is exact to half a cell; where edges meet, 0.3 % of the size is allowed.
    """
    off = np.zeros(len(points))
    turn = rotation_matrix(state.orientation.numpy())
    for k, (row, point) in enumerate(zip(body, points, strict=True)):
        shape = scene.bodies[row].shape
        distance, _ = shape.signed_distance((point - state.position.numpy()[row]) @ turn[row])
        off[k] = distance[0] / (0.5 * shape.grid.spacing if isinstance(shape, Mesh) else 3e-3 * min(shape.size, 1.0))
    return off


def acting_points(stages, contacts):
    """Points of both bodies at which the impulses of contacts act: of an open gap to a fixed body, its two ends."""
    (scene,) = stages.model.layout.scenes
    pair = np.array([contacts["body_a"], contacts["body_b"]])
    size = np.array([min(body.shape.size, 1e9) for body in scene.bodies])[pair].min(axis=0)
    apart = (contacts["gap"] > WIDER * TOUCHING * size) & ~moving(scene)[pair].all(axis=0)
    reach = 0.5 * (apart * contacts["gap"])[:, None] * contacts["normal"]
    return contacts["position"] + reach, contacts["position"] - reach


def test_geometry_of_contacts(device):
    """Positions, arms and normals agree with the poses; both ends, a gap apart, lie on their bodies' surfaces."""
    sim, stages = settling_pile(device, steps=300)
    problem = ContactProblem(stages)
    contacts = problem.contacts
    assert len(contacts["gap"]) > 60
    assert len({*contacts["body_a"], *contacts["body_b"]}) > 20
    np.testing.assert_allclose(np.linalg.norm(contacts["normal"], axis=1), 1.0, atol=1e-5)
    for end, points in zip("ab", acting_points(stages, contacts), strict=True):
        expected = points - problem.center[contacts[f"body_{end}"]]
        np.testing.assert_allclose(contacts[f"arm_{end}"], expected, atol=1e-6)
    np.testing.assert_allclose(problem.center, sim.get("center_of_mass")[0], atol=1e-6)
    reach = 0.5 * contacts["gap"][:, None] * contacts["normal"]
    (scene,) = stages.model.layout.scenes
    for body, sign in (("body_a", 1.0), ("body_b", -1.0)):
        off = off_surface(scene, stages.state, contacts[body], contacts["position"] + sign * reach)
        assert np.abs(off).max() < 1.0
        assert np.quantile(np.abs(off), 0.9) < 0.01


def test_masses_seen_by_contacts(device):
    """Normal and tangential entries of K = 1/m - [r] I^-1 [r], in float64, for each body alone."""
    _, stages = settling_pile(device)
    problem = ContactProblem(stages)
    contacts = problem.contacts
    normal = contacts["normal"].astype(np.float64)
    basis = np.stack([normal, *tangent_basis(normal)], axis=1)
    for end, points in zip("ab", acting_points(stages, contacts), strict=True):
        rows = contacts[f"body_{end}"]
        arm = points - problem.center[rows]
        cross = np.cross(np.eye(3)[None], arm[:, None, :])
        k = problem.inverse_mass[rows, None, None] * np.eye(3) + np.swapaxes(cross, 1, 2) @ (
            np.swapaxes(problem.inverse_inertia[rows], 1, 2) @ cross
        )
        searched = basis @ k @ np.swapaxes(basis, 1, 2)
        expected = np.stack([searched[:, 1, 1], searched[:, 1, 2], searched[:, 2, 2]], axis=1)
        scale = np.maximum(np.trace(k, axis1=1, axis2=2), 1e-9)
        np.testing.assert_allclose(contacts[f"normal_{end}"] / scale, searched[:, 0, 0] / scale, atol=2e-5)
        np.testing.assert_allclose(contacts[f"tangent_{end}"] / scale[:, None], expected / scale[:, None], atol=2e-5)
        fixed = ~moving(stages.model.layout.scenes[0])[rows]
        assert (contacts[f"normal_{end}"][fixed] == 0.0).all()


def test_gaps_may_close_within_the_step_and_no_faster(device):
    """The approach that a contact leaves alone closes its gap, less at most a small part of the smaller body."""
    open_gaps = 0
    for steps in (60, 90, 120):
        _, stages = settling_pile(device, steps)
        contacts = contact_list(stages)
        sizes = np.array([min(body.shape.size, 1e9) for body in stages.model.layout.scenes[0].bodies])
        size = np.minimum(sizes[contacts["body_a"]], sizes[contacts["body_b"]])
        gap = np.maximum(contacts["gap"].astype(np.float64), 0.0)
        open_gaps += (gap > TOUCHING * size).sum()
        assert (contacts["bias_velocity"] <= gap / stages.dt * (1 + 1e-5)).all()
        closes = np.where(gap > WIDER * TOUCHING * size * (1 + 1e-5), gap - TOUCHING * size, 0.0)
        assert (contacts["bias_velocity"] >= closes / stages.dt * (1 - 1e-5) - 1e-6).all()
    assert open_gaps > 5


def test_gaps_that_have_just_closed_need_not_close_by_their_rounding_error(device):
    """A box that hovers a little higher than what carries load is carried; a little more, and it may sink."""
    for factor, closing in ((1.03, 0.0), (1.1, 0.1 * TOUCHING * 0.2 * 240)):
        scene = ground_scene()
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1 + factor * TOUCHING * 0.2))
        _, stages = opened(scene, device)
        find_contacts(stages)
        np.testing.assert_allclose(contact_list(stages)["bias_velocity"], closing, atol=0.02 * TOUCHING * 0.2 * 240)


COMBINE = {"min": min, "average": lambda x, y: 0.5 * (x + y), "multiply": lambda x, y: x * y, "max": max}


@pytest.mark.parametrize("friction_rule", COMBINE_RULES)
@pytest.mark.parametrize("restitution_rule", COMBINE_RULES)
def test_coefficients_combine_by_the_scene_s_rule(device, friction_rule, restitution_rule):
    scene = Scene(friction_combine=friction_rule, restitution_combine=restitution_rule)
    scene.add_static(Plane(), friction=0.3, restitution=0.9)
    scene.add_body(Sphere(0.1), position=(0, 0, 0.1), friction=0.8, restitution=0.2)
    _, stages = opened(scene, device)
    find_contacts(stages)
    contacts = contact_list(stages)
    assert contacts["friction"] == pytest.approx([COMBINE[friction_rule](0.3, 0.8)])
    assert contacts["restitution"] == pytest.approx([COMBINE[restitution_rule](0.9, 0.2)])


def by_identity(body_a, body_b, key, value):
    return {triple: row for *triple, row in zip(body_a, body_b, key, value, strict=True) for triple in [tuple(triple)]}


def world_impulse(contacts):
    """Start impulses in the world frame."""
    normal = contacts["normal"].astype(np.float64)
    u, v = tangent_basis(normal)
    j = contacts["impulse"]
    return j[:, :1] * normal + j[:, 1:2] * u + j[:, 2:] * v


def test_warm_start_hands_impulses_over_by_identity(device):
    """Also when new pairs shift every index: a body lands between the steps."""
    scene = ground_scene(friction=0.6)
    lander = scene.add_body(Sphere(0.05), position=(1, 0, 3))
    scene.add_body(Box((0.5, 0.2, 0.05)), position=(4, 0, 0.05), mass=8.0)
    for side, mass in ((-1, 3.0), (1, 13.0)):
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(4 + 0.3 * side, 0, 0.2), mass=mass)
    for k in range(4):
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1 + 0.2 * k), orientation=rotate_about((0, 0, 1), 5 * k))
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(2, 0, 0.1 + 0.2 * k))
    sim, stages = opened(scene, device)
    sim.step(30)
    last = sim.contacts()
    keys = stages.pools.history.key.numpy()[: len(last)]
    before = by_identity(last["body_a"].tolist(), last["body_b"].tolist(), keys.tolist(), last["impulse"])
    assert len(before) == len(last) >= 32
    sim.set("position", (1, 0, 0.05), bodies=[lander])
    find_contacts(stages)
    contacts = contact_list(stages)
    now = by_identity(
        contacts["body_a"].tolist(), contacts["body_b"].tolist(), contacts["key"].tolist(), world_impulse(contacts)
    )
    new = set(now) - set(before)
    assert {body for a, b, _ in new for body in (a, b)} == {0, lander}
    assert set(before) <= set(now)
    assert contacts["body_a"][0] == lander
    for identity, impulse in before.items():
        np.testing.assert_allclose(now[identity], impulse, atol=1e-5 * np.linalg.norm(impulse) + 1e-9)
    for identity in new:
        assert (now[identity] == 0.0).all()
    total = sum(impulse for (a, b, _), impulse in now.items() if 0 in (a, b))
    assert np.abs(total[2]) == pytest.approx((8 * 8.0 + 24.0) * 9.81 / 240, rel=1e-3)


@pytest.mark.parametrize("forget", ["setting", "reset"])
def test_cold_start_begins_from_zero(device, forget):
    scene = ground_scene()
    scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1))
    sim = Simulator(scene, settings=Settings(warm_starting=forget != "setting"), device=device)
    sim.step(5)
    assert sim.contacts()["impulse"][:, 2].sum() > 0.1
    if forget == "reset":
        sim.reset()
    find_contacts(stages_of(sim))
    contacts = contact_list(stages_of(sim))
    assert len(contacts["gap"]) == 4
    assert (contacts["impulse"] == 0.0).all()


def test_warm_start_turns_friction_into_the_new_tangent_plane(device):
    """A contact whose normal has turned starts from the part of the old impulse that its cone frame can hold."""
    scene = Scene()
    plane = scene.add_static(Plane(), friction=0.9)
    scene.add_body(Sphere(0.1), position=(0, 0, 0.1), friction=0.9, linear_velocity=(1, 0.3, 0))
    sim, stages = opened(scene, device)
    sim.step()
    old = sim.contacts()["impulse"][0].astype(np.float64)
    assert np.linalg.norm(old[:2]) > 1e-4
    sim.set("orientation", rotate_about((0, 1, 0), 25), bodies=[plane])
    find_contacts(stages)
    contacts = contact_list(stages)
    assert contacts["normal"][0, 2] == pytest.approx(np.cos(np.radians(25)), abs=1e-5)
    np.testing.assert_allclose(world_impulse(contacts)[0], old, atol=1e-6 * np.linalg.norm(old))
