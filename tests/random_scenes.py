"""Random small scenes with every kind of state that a step can leave behind, and what a simulator shows of it.

A scene has a ground of a random kind, dynamic bodies of random shapes that start in contact or fall, and some of:
mechanisms with drives, friction, limits and joints that break, a body without colliders, moving bodies, force fields,
filtered pairs, bounds and a pool. Settings are random too, sleeping among them.
"""

import numpy as np

import warp_rigid as wr
from tests.oracles import random_quaternion
from warp_rigid.scenes.builders import meshes

STATE = (
    "position",
    "orientation",
    "linear_velocity",
    "angular_velocity",
    "force",
    "torque",
    "active",
    "asleep",
    "level",
)
OF_JOINTS = ("joint_position", "joint_force", "joint_broken")
POOL = "spare"


def random_shape(rng):
    """A shape of about 0.1 m."""
    a, b, c = rng.uniform(0.05, 0.12, 3)
    box = (wr.Box((a, b, 0.5 * c)), (0.8 * a, 0, 0), (0, 0, 0, 1))
    makers = (
        lambda: wr.Sphere(a),
        lambda: wr.Box((a, b, c)),
        lambda: wr.Capsule(0.5 * a, b),
        lambda: wr.Cylinder(a, 0.5 * b),
        lambda: wr.Compound([box, (wr.Box((0.5 * a, b, c)), (0, 0, 0.8 * c), (0, 0, 0, 1))]),
        lambda: meshes.tetrahedron(sdf_resolution=16),
    )
    return makers[rng.integers(len(makers))]()


def add_ground(scene, rng):
    """A plane, hills, waves, or a box with a wall."""
    kind = rng.integers(4)
    heights = 0.03 * rng.standard_normal((6, 6))
    if kind == 0:
        scene.add_static(wr.Plane(), friction=rng.uniform(0.1, 0.9))
    elif kind == 1:
        scene.add_static(wr.Heightfield(heights, (3.0, 3.0)), friction=0.6, restitution=rng.uniform(0, 0.8))
    elif kind == 2:
        waves = wr.HarmonicMotion(0.01, rng.uniform(0.5, 3.0), rng.uniform(0, 3))
        scene.add_kinematic(wr.Heightfield(heights, (3.0, 3.0), waves), friction=0.6)
    else:
        belt = (0.4, 0.1, 0)
        scene.add_static(wr.Box((1.5, 1.5, 0.1)), position=(0, 0, -0.1), friction=0.5, surface_velocity=belt)
        scene.add_static(wr.Box((0.05, 1.5, 0.3)), position=(0.4, 0, 0.3), orientation=(0, 0.1, 0, 1))


def add_bodies(scene, rng):
    """Bodies beside and above each other: some touch at the start, some fall or are thrown."""
    for k in range(rng.integers(2, 7)):
        thrown = rng.random() < 0.5
        scene.add_body(
            random_shape(rng),
            position=(*rng.uniform(-0.25, 0.25, 2), 0.12 + 0.17 * k),
            orientation=random_quaternion(rng) if rng.random() < 0.6 else (0, 0, 0, 1),
            linear_velocity=rng.normal(0, 2.0, 3) * thrown,
            angular_velocity=rng.normal(0, 10.0, 3) * thrown,
            density=10.0 ** rng.uniform(2, 3.5),
            friction=rng.uniform(0, 1),
            restitution=rng.choice([0.0, 0.7]),
            rolling_friction=rng.choice([0.0, 0.003]),
            spinning_friction=rng.choice([0.0, 0.003]),
        )
    if rng.random() < 0.3:
        nothing = wr.Compound([], (0, 0, 0), 0.01 * np.eye(3))
        scene.add_body(nothing, mass=1.0, position=(0, 0, 0.5))


def add_mechanism(scene, rng):
    """A chain from a point of the world, with joints of random kinds."""
    top = np.array([-0.6, 0.0, 1.2])
    before = None
    for k in range(rng.integers(1, 4)):
        at = top - [0, 0, 0.25 * k + 0.15]
        body = scene.add_body(
            wr.Box((0.04, 0.05, 0.08)), position=at, linear_velocity=rng.normal(0, 1, 3), name=f"link_{k}"
        )
        anchor = at + [0, 0, 0.125]
        limits = None if rng.random() < 0.5 else (-0.2, 0.3)
        axis = rng.normal(size=3)
        made = (
            wr.RevoluteJoint(axis, limits, friction=rng.choice([0.0, 0.05])),
            wr.PrismaticJoint(axis, limits, friction=rng.choice([0.0, 0.5])),
            wr.SphericalJoint(),
            wr.FixedJoint(),
            wr.DistanceJoint(0.0, 0.2),
        )[rng.integers(5)]
        breaks = {"break_force": rng.uniform(2, 40), "break_torque": rng.uniform(0.5, 5)} if rng.random() < 0.4 else {}
        joint = scene.add_joint(made, body, before, anchor=anchor, collide=rng.random() < 0.3, **breaks)
        if isinstance(made, wr.RevoluteJoint | wr.PrismaticJoint) and rng.random() < 0.6:
            scene.add_drive(joint, stiffness=5.0, damping=0.5, target_position=rng.uniform(-0.3, 0.3))
        before = body


def add_movers(scene, rng):
    """A turntable or a gate that follows a path, and force fields."""
    if rng.random() < 0.4:
        scene.add_kinematic(wr.Cylinder(0.2, 0.03), position=(0.3, -0.3, 0.05), angular_velocity=(0, 0, 2))
    else:
        turns = [(0, 0, 0, 1), (0, 0, 0.6, 0.8), (0, 0, 0, 1)]
        path = wr.PosePath([0.05, 0.2, 0.45], [(0.3, -0.3, 0.2), (0.2, 0.1, 0.2), (0.3, -0.3, 0.2)], turns, loop=True)
        scene.add_kinematic(wr.Box((0.2, 0.02, 0.15)), path=path, surface_angular_velocity=(0, 0, 3))
    fields = (
        wr.UniformField(tuple(rng.normal(0, 1, 3))),
        wr.PointField((0, 0, 1), rng.uniform(-1, 1)),
        wr.DragField(rng.uniform(0, 1), (0.3, 0, 0)),
    )
    for field in fields:
        if rng.random() < 0.3:
            scene.add_force_field(field)


def random_scene(rng):
    """A scene; `settings` are drawn from the same generator."""
    bounds = ((-1, -1, -1), (1, 1, 2)) if rng.random() < 0.3 else None
    scene = wr.Scene(bounds=bounds, out_of_bounds="remove")
    add_ground(scene, rng)
    add_bodies(scene, rng)
    if rng.random() < 0.5:
        add_mechanism(scene, rng)
    add_movers(scene, rng)
    if rng.random() < 0.3:
        scene.filter_pair(len(scene.bodies) - 1, len(scene.bodies) - 2)
    scene.add_pool(random_shape(rng), 2, POOL, friction=0.5)
    return scene


def random_settings(rng):
    """Settings, in a third of the cases the default ones."""
    if rng.random() < 0.3:
        return wr.Settings()
    return wr.Settings(
        dt=rng.choice([1 / 60, 1 / 120, 1 / 240]).item(),
        shock_propagation=str(rng.choice(["off", "one_pass", "two_pass"])),
        shock_iterations=int(rng.integers(1, 3)),
        collision_first=bool(rng.random() < 0.7),
        warm_starting=bool(rng.random() < 0.8),
        edge_samples=bool(rng.random() < 0.8),
        sleeping=bool(rng.random() < 0.6),
    )


def heap(rng):
    """Bodies in a bin, so many that they are solved in rounds, and that pairs are found with the hash grid."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), friction=0.6)
    for k in range(300):
        place = (0.22 * (k % 6), 0.22 * (k // 6 % 6), 0.12 + 0.21 * (k // 36))
        scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=place, orientation=random_quaternion(rng))
    return scene


def act(sim, step, rng):
    """What a user may do between two steps: push, switch, break, spawn."""
    bodies = enumerate(zip(sim.scene.bodies, sim.get("active").all(axis=0), strict=True))
    movers = [index for index, (body, active) in bodies if body.motion == wr.Motion.DYNAMIC and active]
    if not movers:
        return
    body = int(rng.choice(movers))
    kind = rng.integers(6)
    if kind == 0:
        sim.set("force", rng.normal(0, 5, 3), bodies=[body])
    elif kind == 1:
        sim.set("torque", rng.normal(0, 0.1, 3), bodies=[body])
    elif kind == 2:
        sim.spawn(POOL, (0, 0, 1.0 + 0.1 * step), linear_velocity=(0, 0, -3))
    elif kind == 3:
        sim.set("active", False, bodies=[body])
    elif kind == 4 and sim.scene.joints:
        sim.set("joint_broken", True, joints=[0])
    else:
        sim.apply_impulse(rng.normal(0, 1, 3), sim.get("position")[:, body], body)


def shown_by(sim, steps=1, envs=None):
    """What a simulator shows of environments after each of some steps, as bytes by name."""
    envs = np.arange(sim.num_envs) if envs is None else np.array(envs)
    shown = {}
    for step in range(steps):
        sim.step()
        names = STATE + (OF_JOINTS if sim.scene.joints else ())
        contacts, status = sim.contacts(), sim.status()
        stats = {name: values for name, values in sim.stats().items() if "capacity" not in name}
        found = {name: sim.get(name)[envs] for name in names} | {f"stats {k}": v[envs] for k, v in stats.items()}
        found |= {f"contacts {env}": contacts[contacts["env"] == env] for env in envs.tolist()}
        found |= {f"status {name}": status[name][envs] for name in ("status", "step", "body")}
        if sim._world.watches is not None:
            found |= {f"watched {name}": values[envs] for name, values in sim.watched().items()}
        if len(envs) == sim.num_envs:
            found["warnings"] = sim.warnings()
        shown |= {f"{name} in step {step}": np.ascontiguousarray(value).tobytes() for name, value in found.items()}
    return shown


def first_difference(found, expected):
    """The first name whose bytes differ; None if all agree."""
    assert list(found) == list(expected)
    return next((name for name in found if found[name] != expected[name]), None)
