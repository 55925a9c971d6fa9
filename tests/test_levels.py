"""Fifth stage: who rests on whom, levels against networkx's condensation, islands against connected components."""

import networkx as nx
import numpy as np
import pytest
import warp as wp

from tests.oracles import (
    GROUND,
    add_uneven_stack,
    find_contacts,
    ground_scene,
    moving,
    opened,
    pair_list,
    random_pile,
    stages_of,
)
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.common import team
from warp_rigid.kernels.graph import islands, support
from warp_rigid.scene.fields import PointField
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import Box, Sphere
from warp_rigid.scenes.builders import stacks
from warp_rigid.scenes.builders.bodies import add_bodies

A_ON_B, B_ON_A = 1, 2


class HandMadeGraph:
    """Active constraints and support relations of several environments, put straight into the arrays.

    Args:
        motions: kind of motion of each body of an environment.
        envs: for each environment a list of (a, b, rests, touches).
    """

    def __init__(self, motions, envs, device):
        self.per_env, self.count, self.device = len(motions), len(envs), device
        rows = [
            (e * self.per_env + a, e * self.per_env + b, supports, touches)
            for e, pairs in enumerate(envs)
            for a, b, supports, touches in sorted(pairs)
        ]
        sizes = {"envs": self.count, "bodies": self.count * self.per_env, "filtered": 0, "pairs": max(1, len(rows))}
        self.bodies = declare.allocate(schema.Bodies, sizes, device)
        self.envs = declare.allocate(schema.Environments, sizes, device)
        self.constraints = declare.allocate(schema.Constraints, sizes, device)
        self.graph = declare.allocate(schema.Graph, sizes, device)
        self.order = declare.allocate(schema.Order, sizes, device)
        self.bodies.motion.assign(np.tile(np.array(motions, np.int32), self.count))
        a, b, supports, touches = (np.array(column, np.int32) for column in zip(*rows, strict=True))
        count = [0, *(len(constraints) for constraints in envs)]
        self.envs.first_body.assign(self.per_env * np.arange(self.count + 1, dtype=np.int32))
        self.constraints.start.assign(np.cumsum(count).astype(np.int32))
        self.constraints.body_a.assign(a)
        self.constraints.body_b.assign(b)
        self.constraints.row_count.assign(touches)
        self.constraints.first_row.assign(np.arange(len(rows), dtype=np.int32))
        self.graph.supports.assign(supports * touches)
        self.graph.swept.fill_(1)

    def launch(self, kernel, *arrays, before=()):
        """One team an environment; on the GPU it has more lanes than a small environment has bodies."""
        lanes = 32 if wp.get_device(self.device).is_cuda else 1
        inputs = [*before, lanes, self.envs, *arrays]
        wp.launch(kernel, self.count * lanes, inputs=inputs, block_dim=team.block_of(lanes), device=self.device)

    def solve(self):
        """Levels and islands, (envs, bodies) each."""
        self.launch(support.find_structure, self.bodies, self.constraints, self.graph)
        rows = self.count * self.per_env
        wp.launch(islands.start_islands, rows, inputs=[self.bodies, self.graph], device=self.device)
        inputs = [1, self.bodies, self.constraints, self.graph]
        wp.launch(islands.join_islands, 1, inputs=inputs, device=self.device)
        state, shapes, motions = schema.State(), schema.Shapes(), schema.Motions()
        state.flight_steps = wp.zeros(rows, dtype=int, device=self.device)
        state.fallen = wp.zeros(rows, dtype=int, device=self.device)
        state.position = wp.zeros(rows, dtype=wp.vec3, device=self.device)
        state.linear_velocity = wp.zeros(rows, dtype=wp.vec3, device=self.device)
        shapes.shapes = wp.zeros(1, dtype=schema.ShapeRecord, device=self.device)
        motions.role = wp.zeros(rows, dtype=int, device=self.device)
        inputs = [1 / 240, shapes, self.bodies, self.envs, motions, self.graph, state]
        wp.launch(islands.vote, rows, inputs=inputs, device=self.device)
        shape = (self.count, self.per_env)
        return self.graph.level.numpy().reshape(shape), self.graph.island.numpy().reshape(shape)

    def heights(self):
        """Depths (envs, bodies) after `solve`, 2^30 where a body is unsupported, and the greatest of each."""
        return self.graph.depth.numpy().reshape(self.count, self.per_env), self.graph.max_depth.numpy()


def supports(pairs, motions):
    """Edges (upper, lower) of an environment; only what is dynamic rests on anything."""
    for a, b, supports, touches in pairs:
        if touches and supports & A_ON_B and motions[a] == Motion.DYNAMIC:
            yield a, b
        if touches and supports & B_ON_A and motions[b] == Motion.DYNAMIC:
            yield b, a


def oracle_levels(pairs, motions):
    """Longest path over the condensation: 0 for what is not dynamic, else one more than the highest support."""
    graph = nx.DiGraph()
    graph.add_nodes_from(range(len(motions)))
    graph.add_edges_from(supports(pairs, motions))
    condensed = nx.condensation(graph)
    level = {}
    for node in reversed(list(nx.topological_sort(condensed))):
        members = condensed.nodes[node]["members"]
        if any(motions[body] != Motion.DYNAMIC for body in members):
            level[node] = 0
        else:
            level[node] = 1 + max((level[below] for below in condensed.successors(node)), default=0)
    return [level[condensed.graph["mapping"][body]] for body in range(len(motions))]


def oracle_heights(pairs, motions):
    """Shortest path to anything that is not dynamic; None where there is none."""
    graph = nx.DiGraph()
    graph.add_nodes_from(range(len(motions)))
    graph.add_edges_from((lower, upper) for upper, lower in supports(pairs, motions))
    ground = {body for body, motion in enumerate(motions) if motion != Motion.DYNAMIC}
    height = nx.multi_source_dijkstra_path_length(graph, ground)
    return [height.get(body) for body in range(len(motions))]


def oracle_islands(pairs, motions):
    """Lowest body of each component of touching dynamic bodies."""
    graph = nx.Graph()
    graph.add_nodes_from(range(len(motions)))
    dynamic = [motion == Motion.DYNAMIC for motion in motions]
    graph.add_edges_from((a, b) for a, b, _, touches in pairs if touches and dynamic[a] and dynamic[b])
    lowest = {body: min(component) for component in nx.connected_components(graph) for body in component}
    return [lowest[body] for body in range(len(motions))]


def random_pairs(generator, motions, density, upward):
    """Random touching pairs; with `upward` the later body rests on the earlier one, otherwise either or both."""
    pairs = []
    for a in range(len(motions)):
        for b in range(a + 1, len(motions)):
            if generator.random() < density and Motion.DYNAMIC in (motions[a], motions[b]):
                supports = B_ON_A if upward else int(generator.integers(4))
                supports &= (A_ON_B if motions[a] == Motion.DYNAMIC else 0) | (
                    B_ON_A if motions[b] == Motion.DYNAMIC else 0
                )
                pairs.append((a, b, supports, int(generator.random() < 0.8)))
    return pairs


@pytest.mark.parametrize("upward", [True, False], ids=["acyclic", "cyclic"])
@pytest.mark.parametrize("density", [0.02, 0.05, 0.15])
def test_levels_and_islands_of_random_graphs(device, density, upward):
    generator = np.random.default_rng(int(1000 * density) + upward)
    motions = [Motion.STATIC, Motion.KINEMATIC, *[Motion.DYNAMIC] * 46, Motion.STATIC, *[Motion.DYNAMIC] * 11]
    envs = [random_pairs(generator, motions, density, upward) for _ in range(8)]
    made = HandMadeGraph(motions, envs, device)
    level, island = made.solve()
    height, max_depth = made.heights()
    deepest = lower = 0
    for env, pairs in enumerate(envs):
        expected = oracle_levels(pairs, motions)
        assert level[env].tolist() == expected
        first = env * len(motions)
        assert (island[env] - first).tolist() == oracle_islands(pairs, motions)
        shortest = oracle_heights(pairs, motions)
        assert [None if h == 2**30 else h for h in height[env].tolist()] == shortest
        assert max_depth[env] == max(h for h in shortest if h is not None)
        deepest = max(deepest, *expected)
        lower += sum(h is not None and h < level for h, level in zip(shortest, expected, strict=True))
    assert deepest > 2 and (lower > 0 or density < 0.1)


def test_cycles_share_a_level(device):
    """0 static; 1, 2, 3 rest on each other in a ring, of which 1 also rests on 0; 4 rests on the ring."""
    motions = [Motion.STATIC, *[Motion.DYNAMIC] * 4]
    ring = [(0, 1, B_ON_A, 1), (1, 2, A_ON_B, 1), (2, 3, A_ON_B, 1), (1, 3, B_ON_A, 1), (3, 4, B_ON_A, 1)]
    level, island = HandMadeGraph(motions, [ring], device).solve()
    assert level[0].tolist() == [0, 1, 1, 1, 2]
    assert island[0].tolist() == [0, 1, 1, 1, 1]


def test_a_long_chain_needs_no_recursion(device):
    """A tower of 3000 bodies, listed from the top down: the longest path a depth-first search can meet."""
    count = 3000
    motions = [*[Motion.DYNAMIC] * count, Motion.STATIC]
    tower = [(k, k + 1, A_ON_B, 1) for k in range(count)]
    level, island = HandMadeGraph(motions, [tower, tower[::2]], device).solve()
    assert level[0].tolist() == [count - k for k in range(count + 1)]
    assert set(level[1].tolist()) == {0, 1, 2}
    assert (island[0][:-1] == 0).all()


def support_of(scene, device):
    """Directed edges (upper, lower) that the stage finds in a scene, and the levels."""
    sim, stages = opened(scene, device)
    find_contacts(stages)
    stages.build_graph()
    supports = stages.pools.graph.supports.numpy()
    edges = set()
    for (a, b), bits in zip(pair_list(stages).tolist(), supports, strict=False):
        edges |= ({(a, b)} if bits & A_ON_B else set()) | ({(b, a)} if bits & B_ON_A else set())
    return edges, sim.get("level")[0].tolist()


def test_a_tower_rests_downwards(device):
    scene = Scene()
    add_bodies(scene, stacks.CUBE, stacks.column(4)[[3, 1, 0, 2]])
    scene.add_static(GROUND)
    edges, level = support_of(scene, device)
    assert edges == {(2, 4), (1, 2), (3, 1), (0, 3)}
    assert level == [4, 2, 1, 3, 0]


def test_neighbours_do_not_carry_each_other(device):
    scene = ground_scene()
    for k in range(3):
        scene.add_body(Box((0.1, 0.1, 0.1)), position=(0.2 * k, 0, 0.1))
    edges, level = support_of(scene, device)
    assert edges == {(1, 0), (2, 0), (3, 0)}
    assert level == [0, 1, 1, 1]


def test_a_bridge_is_above_the_higher_pillar(device):
    """Pillars of one and of two bodies carry one beam: it counts from the longer way."""
    scene = ground_scene()
    scene.add_body(Box((0.1, 0.1, 0.2)), position=(-0.5, 0, 0.2))
    scene.add_body(Box((0.1, 0.1, 0.1)), position=(0.5, 0, 0.1))
    scene.add_body(Box((0.1, 0.1, 0.1)), position=(0.5, 0, 0.3))
    scene.add_body(Box((0.7, 0.1, 0.05)), position=(0, 0, 0.45))
    edges, level = support_of(scene, device)
    assert edges == {(1, 0), (2, 0), (3, 2), (4, 1), (4, 3)}
    assert level == [0, 1, 1, 2, 3]


def test_support_follows_any_force_field(device):
    """Around a planet everything rests toward its centre."""
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(Sphere(1.0))
    scene.add_force_field(PointField(center=(0, 0, 0), strength=10.0))
    directions = ((1, 0, 0), (0, -1, 0), (0, 0, -1), (0.6, 0, 0.8))
    for direction in directions:
        for radius in (1.1, 1.3):
            scene.add_body(Sphere(0.1), position=radius * np.array(direction))
    edges, level = support_of(scene, device)
    assert edges == {(k, 0) for k in (1, 3, 5, 7)} | {(k + 1, k) for k in (1, 3, 5, 7)}
    assert level == [0, 1, 2, 1, 2, 1, 2, 1, 2]


def test_without_acceleration_the_approach_decides(device):
    scene = Scene(gravity=(0, 0, 0))
    scene.add_static(Box((0.1, 0.1, 0.1)))
    scene.add_body(Sphere(0.1), position=(0.2, 0, 0), linear_velocity=(-1, 0, 0))
    scene.add_body(Sphere(0.1), position=(-0.2, 0, 0), linear_velocity=(-1, 0, 0))
    scene.add_body(Sphere(0.1), position=(0, 0.2, 0))
    edges, _ = support_of(scene, device)
    assert edges == {(1, 0)}


def test_a_tilted_tower_still_rests_on_its_base(device):
    """On an incline the weight is not along the normals; the order is the same."""
    scene = Scene(gravity=(9.81 * np.sin(np.radians(30)), 0, -9.81 * np.cos(np.radians(30))))
    scene.add_static(GROUND)
    add_uneven_stack(scene, 3, twist=np.radians(20))
    edges, level = support_of(scene, device)
    assert edges == {(1, 0), (2, 1), (3, 2)}
    assert level == [0, 1, 2, 3]


@pytest.mark.parametrize("sleeping", [False, True])
def test_a_graph_that_has_not_changed_is_not_found_again(device, sleeping):
    """A pile comes to rest, to the same bits as one whose graph is found anew in each step, and is then disturbed."""
    scene = random_pile(np.random.default_rng(5))
    reused, anew = (Simulator(scene, settings=Settings(sleeping=sleeping), device=device) for _ in range(2))
    dynamic = np.flatnonzero(moving(scene))
    found_again = []
    for k in range(500):
        if k == 450:
            highest = dynamic[reused.get("position")[0, dynamic, 2].argmax()]
            for sim in (reused, anew):
                sim.set("linear_velocity", [[(0.0, 0.0, 2.0)]], bodies=[highest])
        reused.step()
        stages_of(anew).pools.forget_graph()
        anew.step()
        assert stages_of(anew).pools.graph.unchanged.numpy().sum() == 0
        found_again.append(1 - stages_of(reused).pools.graph.unchanged.numpy()[0])
        for name in ("position", "orientation", "linear_velocity"):
            np.testing.assert_array_equal(reused.get(name), anew.get(name))
    assert np.sum(found_again[350:450]) < 50 and np.sum(found_again[450:]) > 0
