"""Joints on the device: their arrays, and the launches of their kernels in a step."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.engine.mechanisms import Mechanisms, find_mechanisms
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.common import team
from warp_rigid.kernels.enums import JointNumber
from warp_rigid.kernels.joints import joint_stages as stages
from warp_rigid.scene.joints.joint import Drive, JointEntry
from warp_rigid.scene.scene import Motion, Scene

NAME = "joints"
ROWS = schema.Joints
KEPT = ("broken", "position", "impulse", "angular_impulse")
"""Arrays that one step leaves for the next; a reset clears them."""


def definitions(scene: Scene) -> list[JointEntry]:
    """The joints of a scene."""
    return scene.joints


def mechanisms_of(scene: Scene) -> Mechanisms:
    """The mechanisms of a scene."""
    ends = tuple((entry.body_a, entry.body_b) for entry in scene.joints)
    return find_mechanisms(ends, tuple(body.motion == Motion.DYNAMIC for body in scene.bodies))


def sizes(scene: Scene) -> dict[str, int]:
    """How long the arrays of an environment are."""
    found = mechanisms_of(scene)
    return {
        "joints": len(scene.joints),
        "joined": len(scene.bodies) if scene.joints else 0,
        "mechanisms": len(found.members),
        "members": sum(len(bodies) for bodies in found.members),
        "blocks": len(found.row),
        "eliminations": len(found.products),
    }


def numbers_of(entry: JointEntry) -> list[float]:
    """The parameters of a joint, by JointNumber."""
    drive = entry.drive or Drive()
    values = {
        JointNumber.LOWER: entry.joint.range[0],
        JointNumber.UPPER: entry.joint.range[1],
        JointNumber.FRICTION: entry.joint.resistance,
        JointNumber.STIFFNESS: drive.stiffness,
        JointNumber.DAMPING: drive.damping,
        JointNumber.MAX_FORCE: drive.max_force,
        JointNumber.TARGET_POSITION: drive.target_position,
        JointNumber.TARGET_VELOCITY: drive.target_velocity,
        JointNumber.BREAK_FORCE: entry.break_force,
        JointNumber.BREAK_TORQUE: entry.break_torque,
    }
    return [values[number] for number in JointNumber]


def upload(scene: Scene, num_envs: int, device: Any) -> Any:
    """The arrays of all environments."""
    one = sizes(scene)
    joints = declare.allocate(schema.Joints, {"envs": num_envs, **{k: num_envs * n for k, n in one.items()}}, device)
    if not scene.joints:
        return joints
    for name, values in _attributes(scene).items():
        getattr(joints, name).assign(np.tile(values, (num_envs,) + (1,) * (values.ndim - 1)))
    counted = {"bodies": len(scene.bodies), **one}
    fields = declare.LAYOUTS["Joints"]
    for name, rows in _indices(scene).items():
        array = getattr(joints, name)
        array.assign(_repeated(rows, num_envs, counted[fields[name].index_of], fields[name].shape.endswith("+ 1")))
    return joints


def _attributes(scene: Scene) -> dict[str, np.ndarray]:
    """What the joints of one environment consist of."""
    entries = scene.joints
    return {
        "to_world": np.array([entry.body_b is None for entry in entries], np.int32),
        "locked": np.array([entry.joint.locked for entry in entries], np.int32),
        "coordinate": np.array([int(entry.joint.coordinate) for entry in entries], np.int32),
        "anchor_a": np.array([entry.frame_a.position for entry in entries], np.float32),
        "anchor_b": np.array([entry.frame_b.position for entry in entries], np.float32),
        "turn_a": np.array([entry.frame_a.orientation for entry in entries], np.float32),
        "turn_b": np.array([entry.frame_b.orientation for entry in entries], np.float32),
        "numbers": np.array([numbers_of(entry) for entry in entries], np.float32),
    }


def _indices(scene: Scene) -> dict[str, np.ndarray]:
    """Indices of one environment."""
    found = mechanisms_of(scene)
    shared = np.array(found.shared, np.int32).reshape(-1, 2)
    products = np.array(found.products, np.int32).reshape(-1, 3)
    lists = {
        "body_a": [entry.body_a for entry in scene.joints],
        "body_b": [entry.body_a if entry.body_b is None else entry.body_b for entry in scene.joints],
        "first_joint": [0, len(scene.joints)],
        "first_mechanism": [0, len(found.members)],
        "first_place": found.first_place,
        "first_member": np.cumsum([0, *map(len, found.members)]),
        "member": [body for bodies in found.members for body in bodies],
        "sequence": found.sequence,
        "column": found.column,
        "elimination": found.elimination,
        "row": found.row,
        "shared": shared[:, 0],
        "shared_too": shared[:, 1],
        "left": products[:, 0],
        "right": products[:, 1],
        "target": products[:, 2],
    }
    return {name: np.array(values, np.int32) for name, values in lists.items()}


def _repeated(rows: np.ndarray, num_envs: int, step: int, sums: bool) -> np.ndarray:
    """One environment's indices for all; they increase by `step` per environment, except where they are negative."""
    own = rows[:-1] if sums else rows
    repeated = own + np.where(own >= 0, 1, 0) * step * np.arange(num_envs, dtype=np.int32)[:, None]
    flat = np.append(repeated.reshape(-1), num_envs * step) if sums else repeated.reshape(-1)
    return flat.astype(np.int32) if len(flat) else np.full(1, -1, np.int32)


class JointStages:
    """The launches of the kernels of joints; none in a scene without joints.

    Args:
        of_step: the Stages of the step.
    """

    def __init__(self, of_step: Any) -> None:
        """Look up the arrays."""
        self._step = of_step
        model = of_step.model
        self.arrays = model.constraint_rows[NAME]
        self.present = bool(model.scene.joints)
        one = sizes(model.scene)
        self._joints, self._mechanisms = (of_step.num_envs * one[name] for name in ("joints", "mechanisms"))

    def start(self) -> None:
        """Rows and factors of the step, and islands."""
        step = self._step
        if self.present:
            inputs = [step.dt, step.model.bodies, step.state]
            self._per_mechanism(stages.start_joints, inputs, [step.motions, self.arrays])
            lanes = step.teams.graph
            self._per_team(lanes, stages.join_islands, [step.model.bodies, step.pools.graph, self.arrays])

    def sweep(self, after_shock: int) -> None:
        """Sweeps over the contacts, with a direct solution of the mechanisms after each."""
        step = self._step
        before = [after_shock, step.dt]
        if after_shock == 0:
            inputs = [step.dt, step.model.bodies, step.state]
            self._per_mechanism(stages.begin_joints, inputs, [step.motions, self.arrays])
        inputs = [step.state, step.pools.order, step.pools.graph, step.motions]
        self._per_team(step.teams.color, stages.sweep_with_joints, [*inputs, step.constraint_rows, self.arrays], before)

    def before_shock(self) -> None:
        """Store the impulses."""
        if self.present:
            self._per_team(self._step.teams.color, stages.store_joint_start, [self._step.pools.graph, self.arrays])

    def after_passes(self) -> None:
        """Solve the mechanisms after the passes of shock propagation."""
        step = self._step
        if self.present:
            self._per_team(step.teams.color, stages.rejoin, [step.pools.graph, step.motions, self.arrays], [step.dt])

    def after_line_search(self) -> None:
        """Apply the step length."""
        step = self._step
        if self.present:
            self._per_team(step.teams.color, stages.blend_joints, [step.pools.graph, step.motions, self.arrays])

    def settle(self) -> None:
        """Solve the mechanisms for the pose that the step ends with."""
        step = self._step
        if self.present:
            inputs = [step.dt, step.model.bodies, step.state]
            self._per_mechanism(stages.settle_joints, inputs, [step.motions, self.arrays])

    def limit_motion(self) -> None:
        """Stop the bodies of a mechanism together."""
        if self.present:
            self._per_mechanism(stages.share_time_of_impact, [], [self._step.motions, self.arrays])

    def end(self) -> None:
        """Coordinates, forces and breaking, after the position update."""
        step = self._step
        if self.present:
            inputs = [step.dt, step.envs, step.model.bodies, step.state, step.motions]
            self._launch(stages.end_joints, self._joints, inputs, [self.arrays])
            self._per_mechanism(stages.note_coordinates, [step.state], [self.arrays])

    def support(self) -> None:
        """Sleeping: islands that hang from the world are supported."""
        step = self._step
        if self.present:
            inputs = [step.model.bodies, step.motions, step.pools.graph, self.arrays]
            self._launch(stages.support_joined, self._joints, inputs, [step.sleep_state])

    def _per_mechanism(self, kernel: Any, inputs: Sequence, outputs: Sequence) -> None:
        self._launch(kernel, self._mechanisms, inputs, outputs)

    def _per_team(self, lanes: int, kernel: Any, inputs: Sequence, before: Sequence = ()) -> None:
        step, dim, block = self._step, self._step.num_envs * lanes, team.block_of(lanes)
        inputs = [*before, lanes, step.envs, *inputs]
        wp.launch(kernel, dim=dim, inputs=inputs, block_dim=block, device=step.device)

    def _launch(self, kernel: Any, dim: int, inputs: Sequence, outputs: Sequence) -> None:
        block = team.block_of(self._step.teams.color)
        inputs, outputs = [*inputs], [*outputs]
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, block_dim=block, device=self._step.device)
