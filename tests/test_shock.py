"""Shock propagation and its line search: never more energy, weight felt below, and what one pass leaves out."""

import numpy as np
import pytest

from tests.oracles import (
    ContactProblem,
    add_uneven_stack,
    contact_list,
    find_contacts,
    ground_scene,
    opened,
    random_pile,
    rotate_about,
    stages_of,
)
from warp_rigid.bench.cases import find_case, moving
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.kernels.enums import IslandSolver, SolverPart
from warp_rigid.scene.shapes import Box, Sphere
from warp_rigid.scenes.builders import stacks
from warp_rigid.scenes.builders.bodies import add_bodies

DT = 1 / 240
COLD = {"collision_iterations": 0, "contact_iterations": 0, "warm_starting": False}


class Search:
    """What the line search does in the coming step of a simulator, in float64.

    Attributes:
        problem: the contact problem.
        before, after: velocities and impulses around the guarded two passes.
    """

    def __init__(self, stages, warm=True, sweeps=True):
        find_contacts(stages)
        stages.build_graph()
        stages.integrate_velocities(after_impacts=True)
        self.problem = ContactProblem(stages)
        self.free = self.problem.velocity(stages)
        if not warm:
            impulses = stages.pools.contacts.impulses.numpy()
            impulses["impulse"] = 0.0
            stages.pools.contacts.impulses.assign(impulses)
        start = contact_list(stages)["impulse"].astype(np.float64)
        self.apply(stages, self.free + self.problem.change(start))
        self.before = self.read(stages)
        stages.pools.graph.converged.zero_()
        stages.solve_parts(SolverPart.PASSES | SolverPart.ENERGY | SolverPart.STEP_LENGTH)
        self.after = self.read(stages)
        self.island = stages.pools.graph.island.numpy()

    def apply(self, stages, velocity):
        """Let the bodies have these velocities now, within the step."""
        solver_bodies = stages.motions.solver_bodies.numpy()
        solver_bodies["linear"], solver_bodies["angular"] = velocity[:, :3], velocity[:, 3:]
        stages.motions.solver_bodies.assign(solver_bodies)

    def read(self, stages):
        return self.problem.velocity(stages), contact_list(stages)["impulse"].astype(np.float64)

    def islands(self):
        """Each island as a mask over bodies, those without contacts left out."""
        busy = {*self.problem.contacts["body_a"], *self.problem.contacts["body_b"]}
        for root in np.unique(self.island):
            chosen = (self.island == root) & (self.problem.inverse_mass > 0.0)
            if chosen.any() and busy & set(np.flatnonzero(chosen)):
                yield chosen


def piles(device, count=3):
    """Piles at several stages of falling together, with impulses remembered and without; none counts as fallen."""
    for seed in range(count):
        sim, stages = opened(random_pile(np.random.default_rng(seed)), device)
        for steps in (60, 40, 40):
            sim.step(steps)
            sim_state = {name: sim.get(name) for name in ("linear_velocity", "angular_velocity")}
            for warm in (True, False):
                for name, value in sim_state.items():
                    sim.set(name, value)
                stages.state.fallen.zero_()
                yield Search(stages, warm)
            for name, value in sim_state.items():
                sim.set(name, value)


def test_energy_never_rises_in_any_island(device):
    """f = v.Mv / 2 + b.l, in float64, before and after the guarded passes."""
    moved = 0
    for search in piles(device, 5):
        for chosen in search.islands():
            before = search.problem.energy_of(*search.before, chosen)
            after = search.problem.energy_of(*search.after, chosen)
            assert after <= before + 1e-5 * abs(before)
            moved += after < 0.99 * before
    assert moved > 20


def test_the_share_taken_is_the_best_along_the_way(device):
    """The parabola's slope where the search stops: zero, or still falling at the end of the way, never rising."""
    ends = inner = 0
    for search in piles(device):
        problem = search.problem
        velocity, impulse = search.after
        change = velocity - search.before[0], impulse - search.before[1]
        for chosen in search.islands():
            rows = np.flatnonzero(chosen)
            mass = np.linalg.inv(problem.inverse_mass_matrix[rows])
            counted = np.isin(problem.contacts["body_a"], rows) | np.isin(problem.contacts["body_b"], rows)
            slope = np.einsum("bi,bij,bj->", velocity[rows], mass, change[0][rows])
            biased = problem.bias * change[1][:, 0] + np.einsum("ck,ck->c", problem.surface, change[1])
            slope += biased[counted].sum()
            bend = np.einsum("bi,bij,bj->", change[0][rows], mass, change[0][rows])
            if bend < 1e-6:
                continue
            # The velocities between which the line runs are float32 numbers, rounded at each of many visits.
            terms = np.einsum("bi,bij,bj->", *(np.abs(a) for a in (velocity[rows], mass, velocity[rows])))
            rounding = 2e-5 * max(bend, 0.1) + np.finfo(np.float32).eps * terms
            assert slope < rounding
            inner += slope > -rounding
            ends += slope <= -rounding
    assert inner > 10
    assert ends > 0


def test_velocities_stay_those_of_the_impulses(device):
    """Whatever share is taken, v = v_free + M^-1 J^T l still holds: nothing is lost between the levels."""
    for search in piles(device, count=1):
        velocity, impulse = search.after
        expected = search.free + search.problem.change(impulse)
        np.testing.assert_allclose(velocity, expected, atol=2e-4 * max(1.0, np.abs(expected).max()))


def tower(weights, friction=0.6, top_first=False):
    """Cubes of given masses on each other; they are listed from the ground up, or from the top down."""
    scene = ground_scene(friction=friction)
    order = slice(None, None, -1 if top_first else 1)
    positions = stacks.column(len(weights))[order]
    add_bodies(scene, stacks.CUBE, positions, masses=weights[order], friction=friction)
    return scene


def joints(impulses, count, top_first):
    """Normal impulse in each joint of a tower, from the ground up."""
    bodies = [0, *(range(count, 0, -1) if top_first else range(1, count + 1))]
    return [impulses[tuple(sorted(pair))] for pair in zip(bodies[:-1], bodies[1:], strict=True)]


def step_cold(device, scene, mode, **settings):
    """Velocities after one contact stage with nothing but shock propagation, and impulses by (lower, upper)."""
    _, stages = opened(scene, device, settings=Settings(shock_propagation=mode, **{**COLD, **settings}))
    find_contacts(stages)
    stages.build_graph()
    stages.integrate_velocities(after_impacts=True)
    stages.solve_contacts()
    contacts = contact_list(stages)
    impulses = {}
    for a, b, impulse in zip(contacts["body_a"], contacts["body_b"], contacts["impulse"], strict=True):
        pair = tuple(sorted((int(a), int(b))))
        impulses[pair] = impulses.get(pair, 0.0) + float(impulse[0])
    solver_bodies = stages.motions.solver_bodies.numpy()
    return np.concatenate([solver_bodies["linear"], solver_bodies["angular"]], axis=1), impulses


LISTED = pytest.mark.parametrize("top_first", [False, True], ids=["ground_up", "top_down"])


@LISTED
@pytest.mark.parametrize("weights", [(1.0, 1.0), (1.0, 1000.0), (1000.0, 1.0), (1.0, 2.0, 50.0, 3.0)])
def test_two_passes_carry_the_whole_weight_at_once(device, weights, top_first):
    """Cold, without a single sweep: every joint of a tower carries what is above it, and all is at rest."""
    velocity, impulses = step_cold(device, tower(weights, top_first=top_first), "two_pass")
    above = 9.81 * DT * np.cumsum(weights[::-1])[::-1]
    np.testing.assert_allclose(joints(impulses, len(weights), top_first), above, rtol=1e-3)
    np.testing.assert_allclose(velocity, 0.0, atol=2e-4)


@LISTED
@pytest.mark.parametrize("weights", [(1.0, 1.0), (1.0, 1000.0), (1.0, 2.0, 50.0, 3.0)])
def test_one_pass_carries_only_what_is_directly_above(device, weights, top_first):
    """The 2003 method: at rest too, but each joint carries its own body alone."""
    velocity, impulses = step_cold(device, tower(weights, top_first=top_first), "one_pass")
    np.testing.assert_allclose(joints(impulses, len(weights), top_first), 9.81 * DT * np.array(weights), rtol=1e-3)
    np.testing.assert_allclose(velocity, 0.0, atol=2e-4)


@pytest.mark.parametrize("mode", ["off", "two_pass"])
def test_one_pass_alone_leaves_the_lower_body_untouched(device, mode):
    """A ball lands on a tilted, sliding box: in one pass the box moves bit for bit as it would without the ball."""

    def lower(with_ball, passes):
        scene = ground_scene(friction=0.3)
        turn = rotate_about((0, 0, 1), 20)
        scene.add_body(
            Box((0.2, 0.2, 0.1)), position=(0, 0, 0.1), orientation=turn, linear_velocity=(0.7, 0.1, 0), friction=0.3
        )
        height = 0.25 if with_ball else 2.0
        scene.add_body(Sphere(0.05), position=(0.1, 0.05, height), mass=50.0, linear_velocity=(0, 0, -2), friction=0.3)
        return step_cold(device, scene, passes)[0]

    alone = lower(False, "one_pass")
    below = lower(True, "one_pass")
    assert below[1].tolist() == alone[1].tolist()
    assert below[2, 2] > -0.1
    if mode == "two_pass":
        assert np.abs(lower(True, mode)[1] - lower(False, mode)[1]).max() > 0.01


def test_off_and_no_iterations_do_nothing(device):
    for settings in ({"mode": "off"}, {"mode": "two_pass", "shock_iterations": 0}):
        velocity, impulses = step_cold(device, tower((1.0, 1.0)), **settings)
        assert velocity[1:, 2] == pytest.approx([-9.81 * DT] * 2, rel=1e-5)
        assert sum(impulses.values()) == 0.0


def test_modes_differ_between_the_environments_of_a_batch(device):
    """Each environment keeps to its own mode, as if it were alone."""
    scene = tower((1.0, 10.0, 1.0))
    modes = ["off", "one_pass", "two_pass"]
    sim, _ = opened(scene, device, num_envs=3)
    sim.set("shock_propagation", modes)
    sim.step(20)
    for env, mode in enumerate(modes):
        single, _ = opened(scene, device, settings=Settings(shock_propagation=mode))
        single.step(20)
        assert sim.get("position")[env].tolist() == single.get("position")[0].tolist()
        assert sim.get("linear_velocity")[env].tolist() == single.get("linear_velocity")[0].tolist()


def test_a_stack_of_a_hundred_stands(device):
    """Boxes set down 2 mm to the left and right in turn: weight has to find its way through all at each step."""
    scene = ground_scene(friction=0.6)
    add_uneven_stack(scene, 100, zigzag=0.002, friction=0.6)
    sim, _ = opened(scene, device)
    before = sim.get("position")
    sim.step(240)
    assert np.abs(sim.get("position") - before).max() < 2e-4
    assert sim.penetration()[0] < 1e-4


def test_a_tower_of_crossed_beams_stands(device):
    """Every beam stands on two, thirty layers high: no pair can be solved without its neighbour."""
    scene = ground_scene(friction=0.5)
    add_bodies(scene, *stacks.crossed_layers(30), friction=0.5)
    sim, _ = opened(scene, device)
    before = sim.get("position")
    sim.step(480)
    assert np.abs(sim.get("position") - before).max() < 2e-4


def heap_beside_a_tower(device):
    """A simulator of a heap that has come down in its bin, with a tower outside, and the bodies of both."""
    case = find_case("pile_box:140")
    scene = case.build()
    heap = moving(scene)
    tower = add_bodies(scene, stacks.CUBE, stacks.column(8) + [4.0, 0.0, 0.0])
    sim = Simulator(scene, settings=Settings(dt=1 / 120), device=device)
    sim.step(150)
    return sim, heap, tower


def test_a_large_environment_is_solved_in_rounds_but_for_heavy_on_light(device, tmp_path):
    """A tower with a top of 1000 times the mass beside a heap; a checkpoint continues with the same choice."""
    sim, heap, tower = heap_beside_a_tower(device)
    graph = stages_of(sim).pools.graph
    sim.step(5)
    assert (graph.solver.numpy()[[*heap, *tower]] == IslandSolver.ROUNDS).mean() > 0.9
    sim.set("mass", 1000.0 * sim.get("mass")[0, tower[0]], bodies=[tower[-1]])
    for _ in range(90):
        sim.step()
        solver = graph.solver.numpy()
        assert (solver[heap] == IslandSolver.ROUNDS).mean() > 0.9
        assert (solver[tower] == IslandSolver.SHOCK).all()
    path = tmp_path / "heap.checkpoint"
    sim.save(path)
    again = Simulator.load(path, device=device)
    for one in (sim, again):
        one.step(30)
    assert np.array_equal(sim.get("position"), again.get("position"))


def test_a_heavy_box_that_falls_onto_a_tower_beside_a_heap_is_carried(device):
    """What the heap goes without, the tower gets from the first step in which it needs it."""
    sim, _, tower = heap_beside_a_tower(device)
    top = sim.get("position")[0, tower[-1]]
    sim.set("mass", 1000.0 * sim.get("mass")[0, tower[0]], bodies=[tower[-1]])
    sim.set("position", [[top + (0, 0, 0.3)]], bodies=[tower[-1]])
    sim.step(60)
    placed = [sim.scene.bodies[b].position for b in tower[:-1]]
    assert np.abs(sim.get("position")[0, tower[:-1]] - placed).max() < 1e-3


def test_boxes_that_land_on_each_other_stay_on_each_other(device):
    """They shift by 0.4 mm in the median; with sweeps alone, by 3 mm."""
    scenes = []
    for seed in range(9):
        scene = ground_scene(friction=0.5)
        for k, (x, y) in enumerate(np.random.default_rng(seed).uniform(-1e-3, 1e-3, (10, 2))):
            scene.add_body(Box((0.05,) * 3), position=(x, y, 0.35 + 0.12 * k))
        scenes.append(scene)
    sim = Simulator(scenes, settings=Settings(dt=DT), device=device)
    start = sim.get("position")[:, 1:, :2]
    sim.step(400)
    assert np.median(np.abs(sim.get("position")[:, 1:, :2] - start).max(axis=(1, 2))) < 1e-3


def test_a_pile_that_moves_gets_more_sweeps_instead_of_shock_propagation(device):
    """Two more sweeps for each body of depth: the same bits as with so many contact iterations to begin with."""
    scene = ground_scene()
    tray = scene.add_body(Box((1.0, 1.0, 0.05)), position=(0, 0, 0.05), density=60.0)
    for k in range(17):
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(0.11 * k - 0.88, 0, 0.2 + 0.2 * (k % 2)))
    settings = Settings(dt=1 / 120, collision_iterations=0)
    tray_sim, plain = (Simulator(scene, settings=settings, device=device) for _ in range(2))
    for sim in (tray_sim, plain):
        sim.step(3)
        sim.set("linear_velocity", (0.0, 0.3, 0.2), bodies=[tray])
        stages_of(sim).state.fallen.fill_(1)
    tray_sim.step()
    graph = stages_of(tray_sim).pools.graph
    assert (graph.solver.numpy()[tray:] == IslandSolver.SWEEPS).all()
    max_depth = int(graph.max_depth.numpy()[0])
    assert max_depth > 1 and graph.converged.numpy()[0] == 0
    plain.set("shock_propagation", "off")
    plain.set("contact_iterations", plain.settings.contact_iterations + 2 * max_depth)
    plain.step()
    np.testing.assert_array_equal(tray_sim.get("linear_velocity"), plain.get("linear_velocity"))


def test_a_heap_of_thousands_comes_to_rest(device):
    """It sank into itself as fast as it was pushed apart, for as long as anybody watched."""
    if device == "cpu":
        pytest.skip("takes minutes on a CPU")
    case = find_case("pile_box:4096")
    sim = Simulator(case.build(), settings=Settings(dt=1 / 120), device=device)
    sim.step(720)
    speed = np.linalg.norm(sim.get("linear_velocity")[0], axis=1)
    assert (speed > 0.05).mean() < 0.01, "two thirds of them were faster"
    assert sim.penetration()[0] < 1e-3
