"""PyBullet on one core of the CPU; meshes as convex parts."""

import tempfile
from pathlib import Path

import numpy as np
import pybullet
from problem import PeerProblem, as_obj, timed_one_by_one


def run(problem: PeerProblem) -> tuple:
    """Step one client per environment."""
    parts = None if problem.vertices is None else problem.convex_parts()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "parts.obj"
        if parts is not None:
            path.write_text(as_obj(parts))
        worlds = [_world(problem, path, env) for env in range(problem.num_envs)]

    def advance(env: int, frames: int) -> None:
        for _ in range(frames * problem.substeps):
            pybullet.stepSimulation(physicsClientId=worlds[env][0])

    seconds = timed_one_by_one(problem, advance)
    poses = [[pybullet.getBasePositionAndOrientation(b, physicsClientId=c) for b in bodies] for c, bodies in worlds]
    speeds = [[pybullet.getBaseVelocity(b, physicsClientId=c)[0] for b in bodies] for c, bodies in worlds]
    # The eighth item of a contact is its gap.
    touching = sum(point[8] <= 0.0 for c, _ in worlds for point in pybullet.getContactPoints(physicsClientId=c) or ())
    figures = {
        "version": str(pybullet.getAPIVersion()),
        "collider": "box" if parts is None else f"{len(parts)} convex parts",
        "device": "cpu",
        **seconds,
        "contacts": touching,
    }
    places, orientation = (np.array([[pose[k] for pose in row] for row in poses]) for k in (0, 1))
    return figures, places, orientation, speeds


def _world(problem: PeerProblem, path: Path, env: int) -> tuple[int, list[int]]:
    """Client and its bodies, without sleeping and damping."""
    client = pybullet.connect(pybullet.DIRECT)
    own = {"physicsClientId": client}
    pybullet.setGravity(*problem.gravity, **own)
    pybullet.setPhysicsEngineParameter(fixedTimeStep=problem.dt, deterministicOverlappingPairs=1, **own)
    # Bullet multiplies the coefficients of the two bodies.
    surface = {"lateralFriction": problem.friction**0.5, "restitution": problem.restitution}
    still = [pybullet.createMultiBody(0, pybullet.createCollisionShape(pybullet.GEOM_PLANE, **own), **own)]
    for part in problem.fixed:
        shape = _fixed(part, own)
        still.append(pybullet.createMultiBody(0, shape, basePosition=part["position"], **own))
    for body in still:
        pybullet.changeDynamics(body, -1, **surface, **own)
    if problem.vertices is None:
        half = problem.half_extents.tolist()
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, **own)
    else:
        shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, fileName=str(path), **own)
    bodies = []
    for place, orientation in zip(problem.position[env].tolist(), problem.orientation[env].tolist(), strict=True):
        body = pybullet.createMultiBody(problem.mass, shape, basePosition=place, baseOrientation=orientation, **own)
        pybullet.changeDynamics(
            body,
            -1,
            **surface,
            localInertiaDiagonal=problem.inertia.tolist(),
            linearDamping=0,
            angularDamping=0,
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            **own,
        )
        bodies.append(body)
    return client, bodies


def _fixed(part: dict, own: dict) -> int:
    if part["kind"] == "box":
        return pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=part["half_extents"], **own)
    sizes = {"radius": part["radius"], "height": 2.0 * part["half_height"]}
    return pybullet.createCollisionShape(pybullet.GEOM_CYLINDER, **sizes, **own)
