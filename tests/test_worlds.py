"""Environments of different scenes in one batch: the bits of their own batches, and how bodies are addressed."""

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid import scenes
from warp_rigid.engine import hash_grid
from warp_rigid.engine.quantities import READABLE, owner_of
from warp_rigid.scenes.builders import meshes
from warp_rigid.sweep.batch_size import SizedRun, batch_bytes, footprint_of, split_into_batches
from warp_rigid.sweep.design import Run
from warp_rigid.sweep.environment_view import EnvironmentView

STATE = ("position", "orientation", "linear_velocity", "angular_velocity")


def pile(half=0.1, count=2, friction=0.5, bounds=None, rule="min", gravity=(0, 0, -9.81)):
    """Boxes of one size above a plane, one over the other and turned."""
    scene = wr.Scene(gravity=gravity, bounds=bounds, out_of_bounds="remove", friction_combine=rule)
    scene.add_static(wr.Plane(), friction=0.9, name="ground")
    for i in range(count):
        at = (0.3 * half * i, 0, (1.2 + 2.3 * i) * half)
        scene.add_body(wr.Box((half,) * 3), position=at, orientation=(0, 0.1, 0, 1), friction=friction, name=f"box_{i}")
    return scene


def swaying():
    """A ball on ground that moves, below a point that attracts it."""
    scene = pile(count=1)
    waves = wr.HarmonicMotion(0.01, 2.0, 0.0)
    scene.add_kinematic(wr.Heightfield(np.zeros((4, 3)), (3.0, 2.0), waves), position=(3, 0, 0), name="carpet")
    scene.add_body(wr.Sphere(0.1), position=(3, 0, 0.11), name="ball")
    scene.add_force_field(wr.PointField((0, 0, 3), 2.0))
    return scene


def different():
    """Scenes that differ in everything that a scene states."""
    filtered = pile(0.05, 5, bounds=((-1, -1, -1), (1, 1, 1)), rule="max")
    filtered.filter_pair(1, 3)
    filtered.add_force_field(wr.UniformField((1.0, 0, 0)))
    filtered.add_force_field(wr.PointField((0, 0, 5), 3.0))
    return [pile(), filtered, swaying(), pile(0.2, 3, 0.1, rule="average", gravity=(0, 0, -1.6))]


def assert_alone(mixed, made, steps, settings=None):
    """Every environment of a batch of different scenes has the bits of a batch of its scene alone."""
    mixed.step(steps)
    count = mixed.num_envs // len(made)
    contacts, deepest, status, stats = mixed.contacts(), mixed.penetration(), mixed.status(), mixed.stats()
    for index, scene in enumerate(made):
        alone = wr.Simulator(scene, num_envs=count, settings=settings, device=mixed.device)
        alone.step(steps)
        own, bodies = slice(index, None, len(made)), len(scene.bodies)
        for name in (*STATE, "active", "asleep", "level", "mass", "kinetic_energy", "potential_energy"):
            np.testing.assert_array_equal(mixed.get(name)[own, :bodies], alone.get(name), f"{index} {name}")
        np.testing.assert_array_equal(deepest[own], alone.penetration())
        for name in ("status", "step", "body"):
            np.testing.assert_array_equal(status[name][own], alone.status()[name])
        for name in ("islands", "contacts", "residual"):
            np.testing.assert_array_equal(stats[name][own], alone.stats()[name])
        found, expected = contacts[contacts["env"] == index], alone.contacts()
        expected = expected[expected["env"] == 0]
        for name in ("body_a", "body_b", "position", "impulse"):
            np.testing.assert_array_equal(found[name], expected[name])


@pytest.mark.parametrize("sleeping", [False, True])
def test_different_scenes_have_the_bits_of_their_own_batches(device, sleeping):
    settings = wr.Settings(sleeping=sleeping)
    made = different()
    assert_alone(wr.Simulator(made, num_envs=3, settings=settings, device=device), made, 150, settings)


@pytest.mark.parametrize("running", [{"surface_velocity": (0.4, 0.1, 0)}, {"surface_angular_velocity": (0, 0, 2)}])
def test_belts_do_not_depend_on_moving_ground_of_others(device, running):
    scene = wr.Scene()
    scene.add_static(wr.Box((1.5, 1.5, 0.1)), position=(0, 0, -0.1), friction=0.5, **running)
    for k in range(3):
        at, spin = (0.5 * k - 0.5, 0.3, 0.2 + 0.02 * k), (3 - 2 * k, 5, 4)
        scene.add_body(
            wr.Capsule(0.05, 0.1), position=at, orientation=(0.5, 0.15, 0, 1), angular_velocity=spin, friction=0.6
        )
    made = [scene, swaying()]
    assert_alone(wr.Simulator(made, num_envs=2, device=device), made, 60)


def test_environments_with_and_without_a_grid_share_a_batch(device, monkeypatch):
    monkeypatch.setattr(hash_grid, "TRY_ALL_UP_TO", 3)
    made = [pile(0.1, 2), pile(0.05, 6), pile(0.2, 4)]
    assert_alone(wr.Simulator(made, num_envs=2, device=device), made, 60)


@pytest.mark.parametrize("steps", [pytest.param(8, marks=pytest.mark.short), pytest.param(40, marks=pytest.mark.long)])
def test_built_in_scenes_share_a_batch(device, steps):
    """All of them for a sixth of a second; every fifth one for the short form."""
    sizes = {"bodies": 12, "rings": 6, "bones": 6, "height": 4}
    made = []
    for name in scenes.names()[:: 1 if steps > 8 else 5]:
        known = scenes.get(name).parameters
        made.append(scenes.load(name, **{key: value for key, value in sizes.items() if key in known}))
    assert_alone(wr.Simulator(made, num_envs=2, device=device), made, steps)


def test_shapes_are_shared_by_content(device):
    """Two scenes with a mesh each, read separately, take the memory of one distance grid."""
    scene = [wr.Scene(), wr.Scene()]
    for index, one in enumerate(scene):
        one.add_body(meshes.tetrahedron(sdf_resolution=16), position=(0, 0, index))
    alone, both = (wr.Simulator(made, device=device)._world.model.shapes for made in (scene[0], scene))
    assert both.grid_value.shape == alone.grid_value.shape
    assert both.samples.shape == alone.samples.shape


def test_quantities_of_environments_that_differ(device):
    sim = wr.Simulator([pile(count=1), pile(count=3)], num_envs=2, device=device)
    assert (sim.num_envs, sim.num_bodies) == (4, 4)
    assert sim.exists.sum(axis=1).tolist() == [2, 4, 2, 4]
    assert sim.first_body.tolist() == [0, 2, 6, 8, 12]
    assert sim.scene_of.tolist() == [0, 1, 0, 1]
    for name in (*STATE, "friction", "mass", "kinetic_energy", "center_of_mass", "inertia"):
        values = sim.get(name)
        assert values.shape[:2] == (4, 4)
        assert np.isnan(values[~sim.exists]).all() and np.isfinite(values[sim.exists]).all(), name
    assert not sim.get("active")[0, 2:].any() and sim.get("active")[1].all()
    assert (sim.get("level")[0, 2:] == -1).all()
    flat = sim.array("position").numpy()
    assert len(flat) == 12
    for env in range(4):
        own = flat[sim.first_body[env] : sim.first_body[env + 1]]
        np.testing.assert_array_equal(own, sim.get("position")[env][sim.exists[env]])
    sim.set("position", sim.get("position"))
    np.testing.assert_array_equal(sim.array("position").numpy(), flat)
    with pytest.raises(ValueError, match="scene: the environments have 2 scenes; see scenes and scene_of"):
        _ = sim.scene


def test_bodies_are_chosen_by_name(device):
    """A name is another index in each scene."""
    low, high = wr.Scene(), wr.Scene()
    high.add_static(wr.Plane(), name="ground")
    for scene in (low, high):
        scene.add_body(wr.Sphere(0.1), position=(0, 0, 3), name="ball", mass=2.0)
        scene.add_body(wr.Sphere(0.1), position=(1, 0, 3), name="other")
    sim = wr.Simulator([low, high], device=device)
    sim.set("friction", 0.25, bodies="ball")
    sim.set("mass", [[5.0, 7.0]], bodies=["other", "ball"])
    sim.apply_impulse((14.0, 0, 0), (0, 0, 3), "ball")
    assert sim.get("friction")[[0, 1], [0, 1]].tolist() == [0.25, 0.25]
    assert sim.get("mass")[[0, 0, 1, 1], [0, 1, 1, 2]].tolist() == [7, 5, 7, 5]
    assert sim.get("linear_velocity")[[0, 1], [0, 1], 0].tolist() == [2.0, 2.0]
    assert sim.get("linear_velocity")[[0, 1], [1, 2], 0].tolist() == [0.0, 0.0]


def hung(count):
    """Balls above a plane, each on a string from the world."""
    scene = pile(count=count)
    for i in range(count):
        scene.add_joint(wr.DistanceJoint(maximum=5.0), f"box_{i}", anchor=(0, 0, 5), name=f"string_{i}")
    scene.add_force_field(wr.PointField((0, 0, 3), 2.0))
    scene.add_force_field(wr.UniformField((0, 0, 1)))
    scene.add_force_field(wr.DragField(0.1, (1, 0, 0)))
    return scene


@pytest.mark.parametrize("name", READABLE)
def test_get_selects_as_indexing_does(device, name):
    """In a mixed batch, for each quantity; what an environment lacks is as in the whole array."""
    sim = wr.Simulator([hung(2), hung(4)], num_envs=2, device=device)
    sim.step(2)
    whole, owner = sim.get(name), owner_of(name)
    envs = [3, 0]
    np.testing.assert_array_equal(sim.get(name, envs=envs), whole[envs])
    np.testing.assert_array_equal(sim.get(name, envs=slice(1, 3)), whole[1:3])
    np.testing.assert_array_equal(sim.get(name, envs=np.array([True, False, False, True])), whole[[0, 3]])
    if owner in ("bodies", "joints"):
        names = {"bodies": ["box_3", "box_0"], "joints": ["string_3", "string_0"]}[owner]
        rows = [
            place for one in names for place, entry in enumerate(getattr(sim.scenes[1], owner)) if entry.name == one
        ]
        for chosen in (names, rows, np.array(rows)):
            found = sim.get(name, envs=envs, **{owner: chosen})
            np.testing.assert_array_equal(found, whole[np.ix_(envs, rows)])
        np.testing.assert_array_equal(sim.get(name, **{owner: names[0]}), whole[:, rows[:1]])
        np.testing.assert_array_equal(sim.get(name, **{owner: slice(1, None, 2)}), whole[:, 1::2])
        view = EnvironmentView(sim, sim.scenes[1], np.array([1, 3]), {})
        np.testing.assert_array_equal(view.get(name, envs=[1], **{owner: names}), whole[np.ix_([3], rows)])
    else:
        with pytest.raises(ValueError, match=f"^bodies: must not be given for {name}"):
            sim.get(name, bodies=[0])


def test_a_view_refuses_a_quantity_that_does_not_exist():
    sim = wr.Simulator(pile(count=1), num_envs=2, device="cpu")
    view = EnvironmentView(sim, sim.scenes[0], np.array([1]), {})
    view.get("position")
    with pytest.raises(ValueError, match="^name: must be a quantity, got 'time'"):
        view.get("time")


def test_slices_select_what_set_changes(device):
    sim = wr.Simulator(pile(count=3), num_envs=4, device=device)
    sim.set("friction", 0.25, envs=slice(None, None, 2), bodies=slice(2, None))
    changed = sim.get("friction") == 0.25
    np.testing.assert_array_equal(changed, np.outer([True, False, True, False], [False, False, True, True]))


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ({"bodies": "moon"}, "bodies: must be names of bodies of scene 1"),
        ({"bodies": [5]}, "bodies: must be indices from 0 to 4 of scene 1"),
        ({"bodies": ["box_3"], "envs": [0]}, "bodies: must be names of bodies of scene 0"),
        ({"bodies": [1, 1]}, "bodies: must be given once each"),
        ({"joints": "string_0"}, "joints: must not be given for position"),
        ({"envs": [4]}, "envs: must be indices from 0 to 3"),
    ],
)
def test_get_refuses_what_no_environment_has(chosen, message):
    sim = wr.Simulator([hung(2), hung(4)], num_envs=2, device="cpu")
    with pytest.raises(ValueError) as error:
        sim.get("position", **chosen)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


def test_names_of_a_scene():
    """A name that is taken gets a number; pairs are filtered by names too."""
    scene = wr.Scene()
    for name in ("box", "box", None, "box", "sphere_2"):
        scene.add_body(wr.Sphere(0.1), name=name)
    assert [body.name for body in scene.bodies] == ["box", "box_1", "sphere_2", "box_2", "sphere_2_1"]
    assert scene.index("box_2") == scene.index(3) == 3
    scene.filter_pair("box_2", "box")
    assert scene.filtered_pairs == {(0, 3)}
    with pytest.raises(ValueError, match="^b: must be the index or name of a body, got 'lid'"):
        scene.filter_pair("box", "lid")


def test_a_checkpoint_holds_all_scenes(device, tmp_path):
    sim = wr.Simulator(different(), num_envs=2, device=device)
    sim.step(40)
    sim.save(tmp_path / "worlds.ckpt")
    again = wr.Simulator.load(tmp_path / "worlds.ckpt", device)
    assert again.scene_of.tolist() == sim.scene_of.tolist() and len(again.scenes) == 4
    for some in (sim, again):
        some.step(40)
    for name in STATE:
        np.testing.assert_array_equal(again.get(name), sim.get(name))


def test_environments_of_one_scene_are_recorded(device, tmp_path):
    sim = wr.Simulator([pile(count=1), pile(count=3)], num_envs=2, device=device)
    recording = wr.record(sim, frames=2, envs=[1, 3])
    assert recording.position.shape == (3, 2, 4, 3) and recording.names == ("ground", "box_0", "box_1", "box_2")
    np.testing.assert_array_equal(recording.position[-1], sim.get("position")[[1, 3]])
    wr.export_usd(recording, tmp_path / "film.usdc", envs=[3])
    with pytest.raises(ValueError, match=r"^envs: must be environments of one scene, got those of scenes \[0, 1\]"):
        wr.record(sim, frames=1)


def test_sizes_share_a_batch_of_a_sweep():
    """Rows of box sizes are those of batches of one, bit for bit, as for any other axis."""
    axes = {"half": [0.05, 0.1, 0.2], "count": [1, 4], "friction": [0.2, 0.8]}
    options = {"duration": 0.5, "metrics": ["final_pose", "drift", "contacts", "kinetic_energy"], "device": "cpu"}
    batches = []
    for size in ("auto", 1):
        rows = wr.sweep(
            lambda half=0.1, count=1, friction=0.5: pile(half, count, friction), axes, batch=size, **options
        )
        batches.append([{k: v for k, v in row.items() if k not in ("environment", "wall_time")} for row in rows.rows])
    assert batches[0] == batches[1] and len(batches[0]) == 12


def test_batches_keep_to_the_memory_and_the_order():
    """The boxes of a batch need memory each, the shapes that they share only once."""
    footprints = [footprint_of(pile(half, count)) for half in (0.1, 0.2) for count in (1, 40)]
    runs = [SizedRun(Run(i, str(i), {}, 0), footprints[i % 4]) for i in range(40)]
    whole = batch_bytes(runs)
    assert whole < sum(batch_bytes([run]) for run in runs)
    parts = split_into_batches([runs], "auto", 1000, whole // 2)
    assert [run.index for part in parts for run in part] == list(range(40)) and len(parts) > 3
    for part in parts:
        assert batch_bytes([runs[run.index] for run in part]) <= whole // 4
    assert len(split_into_batches([runs], "auto", 1000, 10 * whole)) == 1


def test_a_reset_of_some_environments(device):
    made = different()
    sim = wr.Simulator(made, num_envs=2, device=device)
    start = {name: sim.get(name) for name in STATE}
    sim.step(30)
    sim.reset(envs=[1, 6])
    for name in STATE:
        np.testing.assert_array_equal(sim.get(name)[[1, 6]], start[name][[1, 6]])
    assert (sim.get("position")[0] != start["position"][0])[sim.exists[0]].any()


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: wr.Simulator([]), "scene: must be a Scene or a list of at least one Scene, got []"),
        (
            lambda: wr.Simulator([pile(), pile()], settings=[0.01, 0.02], device="cpu"),
            "settings: must be one Settings for all environments, got [0.01, 0.02]; all but dt are set per environment "
            "with Simulator.set",
        ),
        (lambda: wr.Simulator([wr.Scene()]), "scene 0.bodies: must hold at least one body"),
        (lambda: wr.Simulator([pile(), 3]), "scene 1: must be a Scene, got 3"),
        (
            lambda: two_scenes().set("friction", 0.1, bodies=["box_2"]),
            "bodies: must be names of bodies of scene 0 (environment 0), got 'box_2'; did you mean box_0? All names: "
            "ground, box_0",
        ),
        (
            lambda: two_scenes().set("friction", 0.1, bodies=[3]),
            "bodies: must be indices from 0 to 1 of scene 0 (environment 0), got [3]",
        ),
        (
            lambda: two_scenes().set("friction", 0.1, envs=[1], bodies=["lid"]),
            "bodies: must be names of bodies of scene 1 (environment 1), got 'lid'; all names: ground, box_0, box_1, "
            "box_2",
        ),
        (
            lambda: two_scenes().set("friction", np.full((2, 3), 0.1)),
            "friction: must be numbers that broadcast to (2, 4), got shape (2, 3)",
        ),
        (
            lambda: two_scenes().set("friction", [True, True]),
            "friction: must be numbers that broadcast to (2, 4), got [True, True]",
        ),
        (
            lambda: two_scenes().set("friction", [0.1, 0.2]),
            "friction: must be numbers that broadcast to (2, 4), got shape (2,); one per environment has shape (2, 1)",
        ),
        (
            lambda: two_scenes().set("active", np.array([True, False])),
            "active: must broadcast to (2, 4), got shape (2,); one per environment has shape (2, 1)",
        ),
        (
            lambda: two_scenes().set("position", np.zeros((2, 3))),
            "position: must be numbers that broadcast to (2, 4, 3), got shape (2, 3); one per environment has shape "
            "(2, 1, 3)",
        ),
        (
            lambda: two_scenes().set("dt", 0.01),
            "name: dt is constant and the same in all environments; it is Settings(dt=...) of the simulator",
        ),
        (
            lambda: two_scenes().set("mass", 2.0, bodies=["box_0", "ground"]),
            "mass: must be 0 for ground, which is static; only dynamic bodies can have one",
        ),
        (lambda: two_scenes().set("gravity", -9.81), "gravity: must be vectors of 3 numbers, got -9.81"),
    ],
)
def test_errors_are_one_line_that_names_the_field(act, message):
    with pytest.raises(ValueError) as error:
        act()
    assert str(error.value) == message


def two_scenes():
    return wr.Simulator([pile(count=1), pile(count=3)], device="cpu")


def test_a_name_in_only_some_scenes_needs_their_environments():
    sim = two_scenes()
    sim.set("friction", 0.125, envs=[1], bodies=["box_2"])
    assert sim.get("friction")[1, 3] == 0.125
