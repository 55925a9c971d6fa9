"""Different scenes in the environments of one simulator.

Environments share the arrays of shapes, so their scenes must have the same structure: the same shapes in the same order
with the same motion types, and the same force fields, filtered pairs, constraints, bounds and combine rules. Poses,
velocities, masses, coefficients, gravity and active bodies are stored for each environment and may differ.
"""

from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from warp_rigid.engine.model import mass_arrays
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.scene import Motion, Scene

if TYPE_CHECKING:
    from warp_rigid.engine.simulator import Simulator

__all__ = ["start_each", "structure"]

POSES = ("position", "orientation", "linear_velocity", "angular_velocity")


def structure(scene: Scene) -> Hashable:
    """The properties that scenes must have in common to be environments of one simulator."""
    bodies = tuple((body.shape.key, int(body.motion), body.name) for body in scene.bodies)
    fields = tuple(repr(field) for field in scene.force_fields)
    apart = tuple(sorted(scene.filtered_pairs))
    constraints = tuple(repr(constraint) for constraint in scene.constraints)
    limits = repr(scene.bounds), scene.out_of_bounds
    return bodies, fields, apart, constraints, limits, scene.friction_combine, scene.restitution_combine


def start_each(sim: "Simulator", scenes: Sequence[Scene], which: Sequence[int] | np.ndarray) -> None:
    """Start each environment from its own scene, bit-identical to a simulator of that scene alone.

    `Simulator.reset` returns to these initial states.

    Args:
        sim: a simulator that has not stepped yet.
        scenes: scenes with the structure of the simulator's scene.
        which: (envs,) index into `scenes` for each environment.

    Raises:
        ValueError: A scene has a different structure.
    """
    for index, scene in enumerate(scenes):
        if structure(scene) != structure(sim.scene):
            raise ValueError(f"scenes: number {index} has a different structure than the simulator's scene")
    chosen = np.asarray(which)
    for name in POSES:
        rows = _rows(scenes, name)[chosen].reshape(sim.num_envs * sim.num_bodies, -1)
        for state in (sim._world.state, sim._world.start):
            getattr(state, name).assign(rows)
    active = np.array([[body.active for body in scene.bodies] for scene in scenes], np.int32)[chosen].reshape(-1)
    for state in (sim._world.state, sim._world.start):
        state.active.assign(active)
    bodies = sim._world.model.bodies
    for name in COEFFICIENTS:
        getattr(bodies, name).assign(_rows(scenes, name)[chosen].reshape(-1))
    for name, rows in _mass_rows(scenes, bodies).items():
        array = getattr(bodies, name)
        array.assign(rows[chosen].reshape(array.numpy().shape))
    sim._world.envs.gravity.assign(np.array([scene.gravity for scene in scenes], np.float32)[chosen])


def _rows(scenes: Sequence[Scene], name: str) -> np.ndarray:
    """A quantity of all bodies, (scenes, bodies, ...) float32."""
    return np.array([[getattr(body, name) for body in scene.bodies] for scene in scenes], np.float32)


def _mass_rows(scenes: Sequence[Scene], bodies) -> dict[str, np.ndarray]:
    """Masses, inertias and their inverses, each (scenes, bodies, ...) float32; zero for bodies that are not dynamic."""
    first = scenes[0].bodies
    names = ("mass", "inverse_mass", "inertia", "inverse_inertia")
    found = {name: np.zeros((len(scenes), len(first), *getattr(bodies, name).numpy().shape[1:])) for name in names}
    for column, body in enumerate(first):
        if body.motion == Motion.DYNAMIC:
            mass = np.array([scene.bodies[column].mass for scene in scenes])
            for name, values in mass_arrays(body.shape, mass).items():
                found[name][:, column] = values
    return {name: values.astype(np.float32) for name, values in found.items()}
