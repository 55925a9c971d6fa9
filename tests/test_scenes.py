"""The built-in scenes: what they hold, that nothing overlaps at the start, and what they refuse."""

import collections
import itertools
import warnings
from functools import cache

import numpy as np
import pytest

from tests.fakes import FakeSimulator
from tests.scene_oracles import StillSimulator, about, body_separation, rotation
from warp_rigid import scenes
from warp_rigid.engine.hints import hints_on
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import Box, Heightfield, Mesh, Plane
from warp_rigid.scenes import balance_bird, domino_spiral, nut_and_bolt, rings_on_poles
from warp_rigid.scenes.builders import meshes, piles, screw_threads
from warp_rigid.scenes.demo import clearance

NAMES = scenes.names()

VARIED = [
    ("box_stack", {"height": 1}),
    ("box_stack", {"height": 50}),
    ("leaning_tower", {"height": 50, "offset": 0.01}),
    ("leaning_tower", {"offset": 0.45}),
    ("incline", {"angle": 0}),
    ("incline", {"angle": 40}),
    ("plank_launch", {"blocks": 20, "drop": 5}),
    ("plank_launch", {"drop": 0.1}),
    ("showcase", {"bodies": 30, "seed": 3}),
    ("planet", {"bodies": 70, "seed": 1}),
    ("rings_on_poles", {"rings": 60, "poles": 25}),
    ("rings_on_poles", {"rings": 1, "poles": 1}),
    ("bone_pile", {"bones": 40, "seed": 5}),
    ("bunny_pile", {"bodies": 20, "seed": 7}),
    ("domino_spiral", {"dominoes": 300, "spacing": 0.1, "lean": 8}),
    ("domino_spiral", {"spacing": 0.2, "lean": 0}),
    ("wrecking_ball", {"rows": 5, "pyramids": 5}),
]


def test_names():
    """The order gives the viewer's keys. A new scene may be added anywhere."""
    public = [
        "box_stack",
        "leaning_tower",
        "incline",
        "plank_launch",
        "seesaw",
        "skull_and_brain",
        "showcase",
        "terrain",
        "carpet",
        "planet",
        "rings_on_poles",
        "bone_pile",
        "bunny_pile",
        "domino_spiral",
        "balance_bird",
        "nut_and_bolt",
        "wrecking_ball",
    ]
    assert [name for name in NAMES if name in public] == public


@cache
def built(name):
    """A scene as it is by default, which is built without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return scenes.load(name)


@pytest.mark.parametrize("name", NAMES)
def test_demo_is_complete(name):
    demo = scenes.get(name)
    assert demo.name == name
    assert demo.summary and "\n" not in demo.summary and len(demo.summary) < 100
    assert demo.duration > 0.0
    assert next(iter(demo.variants.items())) == ("default", {})
    for variant in demo.variants.values():
        assert "dt" not in variant, "one simulator has one dt"
        Settings(**{**demo.settings, **variant})
    assert hints_on([built(name)], 1 / 60) == []


def gap_above_plane(body, plane):
    points = np.asarray(body.shape.surface()[0]) @ rotation(body.orientation).T
    heights = (points + np.array(body.position)) @ plane.normal - plane.offset
    return heights.min()


@pytest.mark.parametrize(("name", "parameters"), [(name, {}) for name in NAMES] + VARIED)
def test_nothing_overlaps_at_the_start(name, parameters):
    scene = scenes.load(name, **parameters) if parameters else built(name)
    reach = {shape: np.linalg.norm(shape.surface()[0], axis=1).max() for shape in {b.shape for b in scene.bodies}}
    for first, second in itertools.combinations(scene.bodies, 2):
        if Motion.DYNAMIC not in (first.motion, second.motion):
            continue
        if isinstance(first.shape, Plane):
            gap = gap_above_plane(second, first.shape)
        elif isinstance(first.shape, Heightfield):
            gap = first.shape.signed_distance(second.position)[0][0] - reach[second.shape]
        else:
            gap = np.linalg.norm(np.subtract(first.position, second.position))
            gap -= reach[first.shape] + reach[second.shape]
            if gap <= 0.0:
                gap = body_separation(first, second)
            if gap <= -1e-12 and isinstance(first.shape, Mesh):
                # The axes of the frames do not separate every two bodies; their samples are in single precision.
                gap = clearance(StillSimulator(scene), scene.bodies.index(first), scene.bodies.index(second))[0] + 1e-7
        assert gap > -1e-12, (first.name, second.name, gap)


def test_the_overlap_test_sees_an_overlap():
    scene = Scene()
    for position, orientation in (
        ((0, 0, 0), (0, 0, 0, 1)),
        ((0.99, 0.99, 0), (0, 0, 0, 1)),
        ((1.001, 0, 0), (0, 0, 0, 1)),
        # Turned by 45 degrees, its edge reaches sqrt(1/2) toward the first.
        ((1.2, 0, 0), about((0, 0, 1), 45)),
        ((1.21, 0, 0), about((0, 0, 1), 45)),
    ):
        scene.add_body(Box((0.5, 0.5, 0.5)), position=position, orientation=orientation)
    gaps = [body_separation(scene.bodies[0], body) for body in scene.bodies[1:]]
    expected = [-0.01, 0.001, 1.2 - 0.5 - 0.5**0.5, 1.21 - 0.5 - 0.5**0.5]
    np.testing.assert_allclose(gaps, expected, atol=1e-12)
    scene.add_static(Plane(normal=(0, 0, 1), offset=-0.4))
    assert gap_above_plane(scene.bodies[0], scene.bodies[-1].shape) == pytest.approx(-0.1)


@pytest.mark.parametrize("name", NAMES)
def test_builders_are_deterministic(name):
    first, second = built(name), scenes.load(name)
    assert first.bodies == second.bodies
    assert first.gravity == second.gravity


def test_leaning_tower_leans_by_its_offset():
    boxes = scenes.load("leaning_tower", height=4, offset=0.25).bodies[2:]
    np.testing.assert_allclose([body.position[0] for body in boxes], [0.0, 0.05, 0.1, 0.15])
    np.testing.assert_allclose([body.position[2] for body in boxes], [0.6, 0.8, 1.0, 1.2])


def test_box_stack_lands_one_after_another():
    boxes = [body for body in scenes.load("box_stack").bodies if body.name.startswith("box_")]
    fall = np.array([body.position[2] - 0.6 - 0.2 * i for i, body in enumerate(boxes)])
    landing = np.sqrt(2.0 * fall / 9.81)
    assert (np.diff(landing) > 1.0 / 60.0).all()
    assert landing[-1] < 2.0


def test_block_on_the_incline_is_flush_and_tilted_by_the_angle():
    platform, block = scenes.load("incline", angle=20, friction=0.3, restitution=0.9).bodies[1:]
    assert body_separation(platform, block) == pytest.approx(0.0, abs=1e-12)
    normal = rotation(block.orientation)[:, 2]
    assert np.degrees(np.arctan2(normal[0], normal[2])) == pytest.approx(20.0)
    for body in (platform, block):
        assert (body.friction, body.restitution) == (0.3, 0.9)


def test_seesaw_starts_as_one_rigid_body():
    for body in scenes.load("seesaw").bodies[2:]:
        arm = np.array(body.position) - [0, 0, 0.35]
        np.testing.assert_allclose(body.linear_velocity, np.cross((0, 0.2, 0), arm), atol=1e-15)
        assert body.angular_velocity == (0.0, 0.2, 0.0)


def test_bunnies_start_at_the_benchmarks_lattice():
    # Written down from an independent program that fills the same box (seed 1000 + environment).
    position, orientation = piles.starts(8, 1000)
    np.testing.assert_allclose(position[0], [-0.18914457, -0.185846326, 0.248837672], atol=1e-9)
    np.testing.assert_allclose(position[-1], [0.176157295, 0.197963571, 0.627889658], atol=1e-9)
    np.testing.assert_allclose(orientation[0], [0.741349809, 0.131383825, -0.625464517, 0.204775214], atol=1e-9)
    position, orientation = piles.starts(8, 1003)
    np.testing.assert_allclose(position[5], [0.1745904231257773, -0.18857666197610481, 0.6311208090925049], rtol=1e-12)
    position, _ = piles.starts(100, 1000)
    np.testing.assert_allclose(position[-1], [0.570765429, -0.554429619, 2.511820688], atol=1e-9)


def test_own_meshes_take_the_places_of_skull_and_brain(tmp_path):
    vertices, faces = meshes.tetrahedron(radius=3.0).surface()
    lines = [f"v {x} {y} {z}" for x, y, z in vertices + 5.0]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    file = tmp_path / "solid.obj"
    file.write_text("\n".join(lines) + "\n")
    scene = scenes.load("skull_and_brain", skull=str(file), brain=file)
    skull, brain = scene.bodies[-2:]
    assert (skull.name, brain.name) == ("skull_own", "brain_own")
    for body, size in ((skull, 0.25), (brain, 0.18)):
        lower, upper = body.shape.bounds
        assert (upper - lower).max() == pytest.approx(size)
    skull_world = skull.shape.surface()[0] + skull.position
    brain_world = brain.shape.surface()[0] + brain.position
    assert skull_world[:, 2].min() == pytest.approx(0.13)
    assert brain_world[:, 2].min() - skull_world[:, 2].max() == pytest.approx(0.3)
    middle = 0.5 * (brain_world.min(axis=0) + brain_world.max(axis=0))
    np.testing.assert_allclose(middle[:2], (0.02, 0.0), atol=1e-12)


BAD = [
    ("box_stack", {"height": 0}, r"^height: must be a whole number from 1 to 50, got 0$"),
    ("box_stack", {"height": 51}, "^height: "),
    ("box_stack", {"height": 2.5}, "^height: "),
    ("box_stack", {"height": "ten"}, "^height: "),
    ("leaning_tower", {"height": 1}, "^height: must be a whole number from 2 to 50"),
    ("leaning_tower", {"offset": -0.1}, "^offset: must be a number from 0 to 0.45"),
    ("leaning_tower", {"offset": 0.5}, "^offset: "),
    ("leaning_tower", {"offset": float("nan")}, "^offset: "),
    ("incline", {"angle": 41}, "^angle: must be a number from 0 to 40"),
    ("incline", {"friction": -1}, "^friction: must be a finite number >= 0"),
    ("incline", {"restitution": 1.5}, "^restitution: must be a number from 0 to 1"),
    ("plank_launch", {"blocks": 0}, "^blocks: must be a whole number from 1 to 20"),
    ("plank_launch", {"drop": 0}, "^drop: must be a number from 0.1 to 5"),
    ("seesaw", {"large_mass": 0}, "^large_mass: must be a finite number > 0"),
    ("seesaw", {"small_mass": float("inf")}, "^small_mass: must be a finite number > 0"),
    ("skull_and_brain", {"brain": "brain.txt"}, r"^brain: brain\.txt: must be a mesh file"),
    ("skull_and_brain", {"skull": 3}, "^skull: must be the path of a mesh file, got 3$"),
    ("showcase", {"bodies": 0}, "^bodies: must be a whole number from 1 to 20000"),
    ("showcase", {"seed": -1}, "^seed: must be a whole number from 0 to 4294967295"),
    ("terrain", {"bodies": 1001}, "^bodies: must be a whole number from 1 to 1000"),
    ("terrain", {"seed": -1}, "^seed: "),
    ("carpet", {"bodies": 0}, "^bodies: must be a whole number from 1 to 400"),
    ("carpet", {"amplitude": 1.5}, "^amplitude: must be a number from 0 to 1"),
    ("carpet", {"seed": -1}, "^seed: "),
    ("planet", {"bodies": 5001}, "^bodies: must be a whole number from 1 to 5000"),
    ("planet", {"seed": 0.5}, "^seed: must be a whole number"),
    ("rings_on_poles", {"rings": 0}, "^rings: must be a whole number from 1 to 2000"),
    ("rings_on_poles", {"poles": 24}, "^poles: must be a square number from 1 to 49, got 24$"),
    ("rings_on_poles", {"seed": -1}, "^seed: "),
    ("bone_pile", {"bones": 2001}, "^bones: must be a whole number from 1 to 2000"),
    ("bone_pile", {"seed": "x"}, "^seed: "),
    ("bunny_pile", {"bodies": 0}, "^bodies: must be a whole number from 1 to 4096"),
    ("bunny_pile", {"seed": -1}, "^seed: must be a whole number from 0 to 4294967295"),
    ("bunny_pile", {"speed": 1}, "^speed: no parameter of bunny_pile, which has bodies, seed$"),
    ("card_house", {}, "^scene: must be a built-in scene, got 'card_house'; all names: warp-rigid scenes$"),
]


def test_a_missing_mesh_is_named():
    with pytest.raises(FileNotFoundError, match=r"^skull: nowhere\.obj: no such file$"):
        scenes.load("skull_and_brain", skull="nowhere.obj")


@pytest.mark.parametrize(("name", "parameters", "message"), BAD)
def test_bad_parameters_are_refused_in_one_line(name, parameters, message):
    with pytest.raises(ValueError, match=message) as refusal:
        scenes.load(name, **parameters)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "prefix", "parameters"),
    [
        ("bunny_pile", "bunny_", {"bodies": 3, "seed": 5}),
        ("showcase", "body_", {"bodies": 5, "seed": 2}),
        ("planet", "body_", {"bodies": 5, "seed": 2}),
        ("terrain", "body_", {"bodies": 5, "seed": 2}),
        ("carpet", "body_", {"bodies": 5, "amplitude": 0.3, "seed": 2}),
        ("rings_on_poles", "ring_", {"rings": 3, "poles": 1, "seed": 7}),
        ("bone_pile", "bone_", {"bones": 4, "seed": 1}),
    ],
)
def test_environments_of_a_batch_start_each_in_their_own_way(name, prefix, parameters):
    """Environment e starts as the scene of seed + e; comparisons leave all starts alike."""
    demo = scenes.get(name)
    sim = Simulator(demo.build(**parameters), num_envs=3, device="cpu")
    demo.vary(sim, **parameters)
    first = [i for i, body in enumerate(sim.scene.bodies) if body.name.startswith(prefix)]
    for env in range(3):
        single = demo.build(**{**parameters, "seed": parameters["seed"] + env})
        expected = [body.position for body in single.bodies if body.name.startswith(prefix)]
        np.testing.assert_allclose(sim.get("position")[env, first], expected, atol=1e-5)
    assert not np.allclose(sim.get("position")[0], sim.get("position")[1])


def test_the_papers_counts():
    """500 rings between 30 and 330 m over 25 poles; 300 craniums, 150 pelvises and 50 femurs."""
    rings, _ = rings_on_poles.starts(500, 25, 0)
    assert 30.0 <= rings[:, 2].min() < 32.0 and 328.0 < rings[:, 2].max() <= 330.0
    assert 19.0 < np.linalg.norm(rings[:, :2], axis=1).max() <= 20.0
    feet = [body.position[:2] for body in scenes.load("rings_on_poles", rings=1, poles=25).bodies[1:26]]
    assert sorted(feet)[0] == (-14.0, -14.0) and sorted(feet)[1] == (-14.0, -7.0)
    kinds = collections.Counter(body.name.rpartition("_")[2] for body in scenes.load("bone_pile", bones=500).bodies[6:])
    assert kinds == {"cranium": 300, "pelvis": 150, "femur": 50}


def test_dominoes_stand_at_equal_distances_and_the_first_one_on_its_edge():
    scene = scenes.load("domino_spiral", dominoes=50, spacing=0.15, lean=6.0)
    dominoes = scene.bodies[1:]
    place = np.array([body.position for body in dominoes])
    steps = np.linalg.norm(np.diff(place[1:, :2], axis=0), axis=1)
    # A chord is shorter than its arc, by less than a percent.
    assert (steps < 0.15).all() and (steps > 0.1485).all()
    corners = [
        np.asarray(body.shape.surface()[0]) @ rotation(body.orientation).T + body.position for body in dominoes[:3]
    ]
    np.testing.assert_allclose([points[:, 2].min() for points in corners], 0.0, atol=1e-12)
    axis = rotation(dominoes[0].orientation)[:, 2]
    assert np.degrees(np.arccos(axis[2])) == pytest.approx(6.0)
    assert axis @ (place[1] - place[0]) > 0.0, "it leans toward the second"
    assert pytest.approx(5.079, abs=1e-3) == domino_spiral.TOPPLING_ANGLE


def test_bird_has_its_centre_of_mass_under_the_tip():
    for droop in (0.03, 0.075):
        center = balance_bird.bird(droop).center_of_mass
        np.testing.assert_allclose(center[:2], 0.0, atol=2e-4)
    assert balance_bird.bird(0.075).center_of_mass[2] < -0.02 < 0.0 < balance_bird.bird(-0.05).center_of_mass[2]


def test_thread_of_the_nut_fits_the_bolt_at_any_turn():
    """Moved along the thread, the nut stays clear of the bolt; moved across it, it does not."""
    thread = screw_threads.Thread()
    bolt, nut = screw_threads.bolt(thread, 0.16, 0.02, 0.12), screw_threads.nut(thread, 0.06, 0.12)
    for turn, rise, fits in (
        (0.0, 0.0, True),
        (0.3, 0.3, True),
        (0.7, 0.7, True),
        (0.3, 0.0, False),
        (0.0, 0.2, False),
    ):
        scene = Scene()
        scene.add_static(bolt)
        scene.add_body(nut, position=(0, 0, (1 + rise) * thread.pitch), orientation=about((0, 0, 1), 360.0 * turn))
        gap = clearance(StillSimulator(scene), 0, 1)[0]
        assert (gap > 0.0) == fits, (turn, rise, gap)
        if fits:
            assert gap < thread.clearance, "the flanks are as near as the clearance"


def test_nut_accelerates_as_on_an_inclined_plane():
    """Without inertia about the axis and friction it falls freely; with a large one it follows the energy balance."""
    assert nut_and_bolt.acceleration(0.0, 0.0) == pytest.approx(9.81)
    k = nut_and_bolt.THREAD.pitch / (2.0 * np.pi)
    assert nut_and_bolt.acceleration(0.0, 1e-3) == pytest.approx(9.81 / (1.0 + 1e-3 / k**2))
    assert nut_and_bolt.acceleration(1.05 * nut_and_bolt.CRITICAL_FRICTION, 1e-3) == 0.0
    assert nut_and_bolt.acceleration(0.95 * nut_and_bolt.CRITICAL_FRICTION, 1e-3) > 0.0


class FallingSimulator(FakeSimulator):
    """No overlaps."""

    def penetration(self):
        return np.zeros(self.num_envs)


def test_nut_passes_half_way_at_the_time_of_free_fall_and_may_be_observed_twice_at_one_time():
    sim = FallingSimulator(nut_and_bolt.build())
    outcome = nut_and_bolt.outcome(sim.scene)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(120):
            outcome.observe(sim)
            outcome.observe(sim)
            sim.step(4)
    # Between two observations the drop is taken as linear in time.
    times = np.arange(120) / 60.0
    expected = np.interp(nut_and_bolt.HALF_WAY, 0.5 * sim.GRAVITY * times**2, times)
    assert outcome.passed_at == pytest.approx(expected, rel=1e-6)
