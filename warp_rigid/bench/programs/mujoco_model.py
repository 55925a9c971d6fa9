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
    body = "".join(
        f'<body pos="{_list(place)}" quat="{_list(turned)}"><freejoint/>{inertial}{geometry}</body>'
        for place, turned in zip(problem.position[0], problem.real_first[0], strict=True)
    )
    solref = max(TIME_CONSTANT, 2.0 * problem.dt)
    text = f"""<mujoco>
      <compiler boundinertia="1e-6"/>
      <option timestep="{problem.dt}" gravity="{_list(problem.gravity)}"><flag multiccd="enable"/></option>
      <size memory="1G"/>
      <default><geom friction="{problem.friction} 0.005 0.0001" condim="3" solref="{solref} 1"/></default>
      <asset>{named}</asset>
      <worldbody><geom type="plane" size="50 50 .1"/>{"".join(_fixed(f) for f in problem.fixed)}{body}</worldbody>
    </mujoco>"""
    return mujoco.MjModel.from_xml_string(text, assets), collider


def starts(problem: PeerProblem) -> np.ndarray:
    """Generalised positions of all environments, (envs, 7 * bodies)."""
    poses = np.concatenate([problem.position, problem.real_first], axis=-1)
    return poses.reshape(problem.num_envs, -1)


def final(positions: np.ndarray, velocities: np.ndarray, problem: PeerProblem) -> tuple[np.ndarray, ...]:
    """Positions, orientations (x, y, z, w) and velocities, (envs, bodies, ...)."""
    poses = positions.reshape(problem.num_envs, problem.num_bodies, 7)
    speeds = velocities.reshape(problem.num_envs, problem.num_bodies, 6)
    return poses[..., :3], poses[..., [4, 5, 6, 3]], speeds[..., :3]


def _fixed(part: dict) -> str:
    size = part["half_extents"] if part["kind"] == "box" else [part["radius"], part["half_height"]]
    return f'<geom type="{part["kind"]}" size="{_list(size)}" pos="{_list(part["position"])}"/>'


def _list(values) -> str:
    return " ".join(f"{value:.12g}" for value in values)
