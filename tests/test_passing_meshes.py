"""Narrow phase of meshes in motion: samples that reach the other surface within the step are found."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.geometry_oracles import distance_to_triangles
from tests.oracles import find_contacts, pair_list, random_quaternion, stages_of
from warp_rigid.engine.cores import shared_by, usable_cores
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Mesh

DT = 1 / 240
MAJOR, MINOR = 0.1, 0.03
"""Radii of the rings [m]."""


def passing_rings(device, ring, count=20):
    """Pairs of rings a few centimetres apart that move and tumble past each other, without gravity."""
    scene = Scene(gravity=(0, 0, 0))
    for _ in range(2):
        scene.add_body(Mesh(ring.vertices, ring.faces, sdf_resolution=128))
    generator = np.random.default_rng(5)
    with shared_by(usable_cores()):  # one core, so one shard
        sim = Simulator(scene, num_envs=count, settings=Settings(dt=DT), device=device)
    away = generator.normal(size=(count, 1, 3))
    away *= generator.uniform(1.0, 2.4, (count, 1, 1)) * MAJOR / np.linalg.norm(away, axis=-1, keepdims=True)
    sim.set("position", away, bodies=[1])
    sim.set("orientation", random_quaternion(generator, 2 * count).reshape(count, 2, 4))
    sim.set("linear_velocity", generator.normal(scale=3.5, size=(count, 2, 3)))
    sim.set("angular_velocity", generator.normal(scale=3.0, size=(count, 2, 3)))
    return sim


def reaches(vertices, way, triangles):
    """Whether vertices close their gap in the step, from its rate at the start, and touch the surface on their way."""
    start = distance_to_triangles(vertices, triangles)
    near = start < np.linalg.norm(way, axis=1)
    if not near.any():
        return False
    vertices, way, start = vertices[near], way[near], start[near]
    rate = (distance_to_triangles(vertices + 1e-4 * way, triangles) - start) / 1e-4
    places = [distance_to_triangles(vertices + share * way, triangles) for share in np.linspace(0, 1, 17)]
    return ((start + rate < 0) & (np.min(places, axis=0) < 1e-3)).any()


@pytest.mark.long
def test_vertices_that_reach_a_mesh_on_their_way_are_found(device):
    """Samples are skipped by their motion and the distance in the middle of it, but none that reaches the surface."""
    ring = trimesh.creation.torus(MAJOR, MINOR, major_sections=24, minor_sections=12)
    triangles = np.array(ring.triangles)
    sim = passing_rings(device, ring)
    stages = stages_of(sim)
    find_contacts(stages)
    contacts = stages.pools.pairs.contact_count.numpy()
    touching = {bodies[0] // 2 for bodies, count in zip(pair_list(stages), contacts, strict=False) if count > 0}
    x, v, w = (sim.get(name).astype(float) for name in ("position", "linear_velocity", "angular_velocity"))
    reached = set()
    for env, orientations in enumerate(sim.get("orientation")):
        turns = [Rotation.from_quat(q) for q in orientations]
        for own, other in ((0, 1), (1, 0)):
            world = turns[own].apply(np.array(ring.vertices)) + x[env, own]
            speed = v[env, own] + np.cross(w[env, own], world - x[env, own])
            speed -= v[env, other] + np.cross(w[env, other], world - x[env, other])
            back = turns[other].inv()
            if reaches(back.apply(world - x[env, other]), back.apply(DT * speed), triangles):
                reached.add(env)
    assert len(reached) >= 6
    assert reached <= touching
    assert len(touching) < sim.num_envs
