"""The problem as a model of MuJoCo, for the program on the CPU and the one on Warp."""

import mujoco
import numpy as np
from problem import PeerProblem, as_obj

TIME_CONSTANT = 0.02
"""MuJoCo's default of solref [s]; a step may be at most half of it."""


def build(problem: PeerProblem) -> tuple[mujoco.MjModel, str]:
    """Model with its default solver, and the collider's name; meshes collide by MuJoCo's distance field."""
    assets, named, geometry, collider = {}, "", "", "box"
    if problem.vertices is None:
        geometry = f'<geom type="box" size="{_list(problem.half_extents)}"/>'
    else:
        collider = "octree of distances"
        assets["shape.obj"] = as_obj([(problem.vertices, problem.faces)]).encode()
        named = '<mesh name="shape" file="shape.obj"/>'
        geometry = '<geom type="sdf" mesh="shape"/>'
    inertial = f'<inertial pos="0 0 0" mass="{problem.mass}" diaginertia="{_list(problem.inertia)}"/>'
    filling = inertial + geometry
    bodies = "".join(_free(problem, filling)) if not problem.hinges else _tree(problem, -1, filling)
    drives = "".join(_drive(k, hinge) for k, hinge in enumerate(problem.hinges))
    integrator = "implicitfast" if problem.hinges else "Euler"  # the damping of drives is stiff
    solref = max(TIME_CONSTANT, 2.0 * problem.dt)
    text = f"""<mujoco>
      <compiler boundinertia="1e-6"/>
      <option timestep="{problem.dt}" gravity="{_list(problem.gravity)}" integrator="{integrator}">
        <flag multiccd="enable"/></option>
      <size memory="1G"/>
      <default><geom friction="{problem.friction} 0.005 0.0001" condim="3" solref="{solref} 1"/></default>
      <asset>{named}</asset>
      <worldbody><geom type="plane" size="50 50 .1"/>{"".join(_fixed(f) for f in problem.fixed)}{bodies}</worldbody>
      <actuator>{drives}</actuator>
    </mujoco>"""
    return mujoco.MjModel.from_xml_string(text, assets), collider


def starts(problem: PeerProblem) -> np.ndarray:
    """Generalised positions of all environments, (envs, 7 * bodies), or the angles of the hinges, which are 0."""
    if problem.hinges:
        return np.zeros((problem.num_envs, len(problem.hinges)))
    poses = np.concatenate([problem.position, problem.real_first], axis=-1)
    return poses.reshape(problem.num_envs, -1)


def final(
    model: mujoco.MjModel, positions: np.ndarray, velocities: np.ndarray, problem: PeerProblem
) -> tuple[np.ndarray, ...]:
    """Positions, orientations (x, y, z, w) and velocities, (envs, bodies, ...)."""
    if problem.hinges:
        return _final_of_tree(model, positions, velocities, problem)
    poses = positions.reshape(problem.num_envs, problem.num_bodies, 7)
    speeds = velocities.reshape(problem.num_envs, problem.num_bodies, 6)
    return poses[..., :3], poses[..., [4, 5, 6, 3]], speeds[..., :3]


def _final_of_tree(
    model: mujoco.MjModel, angles: np.ndarray, speeds: np.ndarray, problem: PeerProblem
) -> tuple[np.ndarray, ...]:
    """The same from the angles of the hinges."""
    state, speed = mujoco.MjData(model), np.zeros(6)
    poses, velocities = np.zeros((*problem.position.shape[:2], 7)), np.zeros(problem.position.shape)
    for env in range(problem.num_envs):
        state.qpos[:], state.qvel[:] = angles[env], speeds[env]
        mujoco.mj_forward(model, state)
        poses[env, :, :3], poses[env, :, 3:] = state.xpos[1:], state.xquat[1:]
        for body in range(problem.num_bodies):
            mujoco.mj_objectVelocity(model, state, mujoco.mjtObj.mjOBJ_BODY, body + 1, speed, 0)
            velocities[env, body] = speed[3:]
    return poses[..., :3], poses[..., [4, 5, 6, 3]], velocities


def _free(problem: PeerProblem, filling: str) -> list[str]:
    return [
        f'<body pos="{_list(place)}" quat="{_list(orientation)}"><freejoint/>{filling}</body>'
        for place, orientation in zip(problem.position[0], problem.real_first[0], strict=True)
    ]


def _tree(problem: PeerProblem, parent: int, filling: str) -> str:
    """The bodies that hang from a body, -1 for the world, and all that hang from them."""
    text = ""
    for k, hinge in enumerate(problem.hinges):
        if hinge["parent"] == parent:
            child = hinge["child"]
            place, orientation = _relative(problem, parent, child)
            anchor, frame = hinge["in_child"]
            limits = f'limited="true" range="{_list(np.degrees(hinge["limits"]))}"'
            joint = f'<joint name="hinge{k}" pos="{_list(anchor)}" axis="{_list(_rotate(frame, [1, 0, 0]))}" {limits}/>'
            inside = joint + filling + _tree(problem, child, filling)
            text += f'<body pos="{_list(place)}" quat="{_list(orientation)}">{inside}</body>'
    return text


def _drive(k: int, hinge: dict) -> str:
    limit = f'forcelimited="true" forcerange="{-hinge["max_force"]} {hinge["max_force"]}"'
    return f'<position joint="hinge{k}" kp="{hinge["stiffness"]}" kv="{hinge["damping"]}" {limit}/>'


def _relative(problem: PeerProblem, parent: int, child: int) -> tuple[np.ndarray, np.ndarray]:
    """Position and real-first orientation of a body at the start, in the frame of its parent."""
    place, orientation = problem.position[0, child], problem.real_first[0, child]
    if parent < 0:
        return place, orientation
    back, seen = np.empty(4), np.empty(4)
    mujoco.mju_negQuat(back, problem.real_first[0, parent])
    mujoco.mju_mulQuat(seen, back, orientation)
    between = np.empty(3)
    mujoco.mju_rotVecQuat(between, place - problem.position[0, parent], back)
    return between, seen


def _rotate(orientation, vector) -> np.ndarray:
    """A vector rotated by a quaternion (x, y, z, w)."""
    rotated = np.empty(3)
    mujoco.mju_rotVecQuat(rotated, np.array(vector, float), np.array(orientation, float)[[3, 0, 1, 2]])
    return rotated


def _fixed(part: dict) -> str:
    size = part["half_extents"] if part["kind"] == "box" else [part["radius"], part["half_height"]]
    return f'<geom type="{part["kind"]}" size="{_list(size)}" pos="{_list(part["position"])}"/>'


def _list(values) -> str:
    return " ".join(f"{value:.12g}" for value in values)
