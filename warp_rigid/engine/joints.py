"""Joints on the device: their arrays, and the launches of their kernels in a step."""

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np

from warp_rigid.engine import loading
from warp_rigid.engine.mechanisms import Mechanisms, find_mechanisms
from warp_rigid.kernels import declare
from warp_rigid.kernels.common import team
from warp_rigid.kernels.enums import JointNumber, SolverPart
from warp_rigid.kernels.joints.arrays import Joints
from warp_rigid.scene.joints import Drive, JointEntry
from warp_rigid.scene.scene import Motion, Scene

NAME = "joints"

FROM_BODIES = "joined"
"""The symbol of the bodies that joints may join: all bodies if any environment has joints."""


def mechanisms_of(scene: Scene) -> Mechanisms:
    """The mechanisms of a scene."""
    ends = tuple((entry.body_a, entry.body_b) for entry in scene.joints)
    return find_mechanisms(ends, tuple(body.motion == Motion.DYNAMIC for body in scene.bodies) if ends else ())


def counts(scene: Scene) -> dict[str, int]:
    """Rows of an environment, by the symbol that counts them, but for FROM_BODIES."""
    found = mechanisms_of(scene)
    return {
        "joints": len(scene.joints),
        "mechanisms": len(found.members),
        "members": sum(len(bodies) for bodies in found.members),
        "ends": sum(map(len, _joints_of_members(scene, found))),
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
        JointNumber.ARMATURE: entry.armature,
    }
    return [values[number] for number in JointNumber]


def upload(layout: Any, device: Any) -> Any:
    """The arrays of all environments.

    Args:
        layout: the engine.layout.Layout of the environments.
        device: the Warp device.
    """
    arrays = declare.allocate(Joints, layout.sizes, device)
    if not layout.sizes["joints"]:
        return arrays
    fields = declare.LAYOUTS["Joints"]
    parts = [{**_attributes(scene), **_indices(scene)} for scene in layout.scenes]
    for name in parts[0]:
        values = _of_environments(layout, [part[name] for part in parts], fields[name])
        if len(values):
            getattr(arrays, name).assign(values)
    return arrays


def _of_environments(layout: Any, parts: Sequence[np.ndarray], field: declare.Field) -> np.ndarray:
    """Rows of each scene copied to its environments; indices count from the first row of the environment.

    An array with one row more than its symbol counts holds sums, and ends with their total.
    """
    is_sum = declare.is_sum(field)
    parts = [rows[:-1] for rows in parts] if is_sum else parts
    lengths = [len(rows) for rows in parts]
    values = np.concatenate(parts)[layout.copies(lengths)]
    if not field.index_of:
        return values
    first = np.repeat(layout.starts[field.index_of][:-1], np.array(lengths)[layout.scene_of])
    values = values + np.where(values >= 0, first, 0)
    if is_sum:
        values = np.append(values, layout.sizes[field.index_of])
    return values.astype(np.int32)


def _attributes(scene: Scene) -> dict[str, np.ndarray]:
    """What the joints of one environment consist of."""
    entries = scene.joints

    def vectors(values: list, length: int) -> np.ndarray:
        return np.array(values, np.float32).reshape(-1, length)

    return {
        "to_world": np.array([entry.body_b is None for entry in entries], np.int32),
        "locked": np.array([entry.joint.locked for entry in entries], np.int32),
        "coordinate": np.array([int(entry.joint.coordinate) for entry in entries], np.int32),
        "anchor_a": vectors([entry.frame_a.position for entry in entries], 3),
        "anchor_b": vectors([entry.frame_b.position for entry in entries], 3),
        "turn_a": vectors([entry.frame_a.orientation for entry in entries], 4),
        "turn_b": vectors([entry.frame_b.orientation for entry in entries], 4),
        "numbers": vectors([numbers_of(entry) for entry in entries], len(JointNumber)),
    }


def _indices(scene: Scene) -> dict[str, np.ndarray]:
    """Indices of one environment."""
    found = mechanisms_of(scene)
    shared = np.array(found.shared, np.int32).reshape(-1, 2)
    products = np.array(found.products, np.int32).reshape(-1, 3)
    ends = _joints_of_members(scene, found)
    ends_of = [(entry.body_a, entry.body_b) for entry in scene.joints]
    moving = {body for body, entry in enumerate(scene.bodies) if entry.motion == Motion.DYNAMIC}
    mechanism = {body: m for m, members in enumerate(found.members) for body in members}
    lists = {
        "body_a": [entry.body_a for entry in scene.joints],
        "body_b": [entry.body_a if entry.body_b is None else entry.body_b for entry in scene.joints],
        "first_joint": [0, len(scene.joints)],
        "first_mechanism": [0, len(found.members)],
        "first_place": found.first_place,
        "first_member": np.cumsum([0, *map(len, found.members)]),
        "member": [body for bodies in found.members for body in bodies],
        "first_end": np.cumsum([0, *map(len, ends)]),
        "joint_of_end": [joint for joints in ends for joint in joints],
        "anchored": [any(not moving.issuperset(ends_of[joint]) for joint in joints) for joints in found.joints],
        "of_body": [mechanism.get(body, -1) if body in moving else -1 for body in range(len(scene.bodies))],
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


def _joints_of_members(scene: Scene, found: Mechanisms) -> list[list[int]]:
    """The joints that each member has in its mechanism, in the order of elimination."""
    ends = [(entry.body_a, entry.body_b) for entry in scene.joints]
    groups = zip(found.members, found.joints, strict=True)
    return [[joint for joint in joints if body in ends[joint]] for bodies, joints in groups for body in bodies]


class JointStages:
    """The launches of the kernels of joints; none where no scene has joints, and their module is not imported either.

    Args:
        of_step: the Stages of the step.
    """

    def __init__(self, of_step: Any) -> None:
        """Look up the arrays."""
        self._step, model, sizes = of_step, of_step.model, of_step.model.layout.sizes
        self.arrays, self.bodies, self.state = model.joints, model.bodies, of_step.state
        self.motions, self.pools, self.dt = of_step.motions, of_step.pools, of_step.dt
        self._joints, self._mechanisms = sizes["joints"], sizes["mechanisms"]
        self.present = self._joints > 0
        self.kernels: Any = import_module(loading.JOINTS) if self.present else None

    def bound_travel(self) -> None:
        """Cover the motion of mechanisms by the bounding boxes of their bodies."""
        if self.present:
            outputs = [self.motions, self.arrays]
            self._per_mechanism(self.kernels.bound_travel, [self.dt], [self.bodies, self.state], outputs)

    def join_islands(self) -> None:
        """Joints make one island of those of their bodies."""
        if self.present:
            inputs = [self.bodies, self.arrays]
            self._step.launch(self.kernels.join_joined_islands, self._joints, inputs, [self.pools.graph])

    def start(self) -> None:
        """Rows and factors of the step."""
        if self.present:
            changed = [self.motions, self.pools.graph, self.arrays]
            self._per_mechanism(self.kernels.start_joints, [self.dt], [self.bodies, self.state], changed)

    def solve_impacts(self, otherwise: Any) -> None:
        """Impacts; mechanisms take part as wholes. `otherwise`: the kernel where there are no joints."""
        pools = self.pools
        changed = [pools.order, pools.graph, self.motions, pools.contacts]
        if self.present:
            changed = [pools.constraints, *changed, self.arrays]
            self._per_team(self.kernels.solve_impacts_with_joints, changed, [self.dt])
        else:
            self._per_team(otherwise, changed, [self.dt])

    def solve_contacts(self) -> None:
        """Contact solver with mechanisms, whose initial impulses are applied before the first sweep."""
        step, kernels, pools = self._step, self.kernels, self.pools
        graph, motions = pools.graph, self.motions
        changed = [pools.order, graph, motions, pools.contacts, self.arrays, pools.visits]
        self._per_mechanism(kernels.move_untouched, [self.dt], [self.bodies, self.state], [motions, self.arrays])
        self._settle(after_push=0)
        self._per_team(kernels.warm_start_with_joints, [pools.constraints, *changed])
        self._per_team(kernels.sweep_with_joints, changed, [kernels.Launch.BEFORE_SHOCK, 0, self.dt])
        step.solve_parts(SolverPart.REST)
        for k in range(step.repetitions):
            repetition = range(k, k + 1)
            self._per_team(kernels.store_joint_start, [graph, self.arrays], [k])
            step.solve_parts(SolverPart.PASSES, repetition)
            self._per_team(kernels.sweep_with_joints, changed, [kernels.Launch.AFTER_PASSES, k, self.dt])
            step.solve_parts(SolverPart.ENERGY, repetition)
            self._per_team(kernels.add_energy_of_joints, [graph, motions, self.arrays], [k, self.dt])
            step.solve_parts(SolverPart.STEP_LENGTH, repetition)
            self._per_team(kernels.blend_joints, [graph, motions, self.arrays], [k])
        self._per_team(kernels.sweep_with_joints, changed, [kernels.Launch.AFTER_SHOCK, 0, self.dt])
        step.solve_parts(SolverPart.CALM)

    def _settle(self, after_push: int) -> None:
        """Solve the mechanisms for the pose that the step ends with, before the sweeps or after the push-out."""
        inputs, changed = [self.bodies, self.state], [self.motions, self.arrays]
        self._per_mechanism(self.kernels.settle_joints, [after_push, self.dt], inputs, changed)

    def push_out(self) -> None:
        """Separate the contacts of mechanisms."""
        if self.present:
            pools = self.pools
            changed = [pools.order, pools.graph, self.motions, pools.contacts, self.arrays, pools.visits]
            self._per_team(self.kernels.push_joined, changed)
            self._settle(after_push=1)

    def join_courses(self) -> None:
        """Before an iteration of continuous collision detection: the bodies of a mechanism move on alike after one."""
        if self.present:
            self._per_mechanism(self.kernels.join_courses, [], [self.bodies], [self.motions, self.arrays])

    def share_impacts(self) -> None:
        """After an iteration: the impact of a body is that of its mechanism."""
        if self.present:
            inputs = [self._step.model.shapes, self.bodies, self.state, self.pools.pairs]
            self._per_mechanism(self.kernels.share_impacts, [self.dt], inputs, [self.motions, self.arrays])

    def close_stopped(self) -> None:
        """After the last iteration: close the joints that stopped."""
        if self.present:
            outputs = [self.motions, self.arrays]
            self._per_mechanism(self.kernels.close_stopped, [self.dt], [self.bodies, self.state], outputs)

    def end(self) -> None:
        """Coordinates, forces and breaking, after the position update."""
        if self.present:
            inputs = [self.dt, self._step.envs, self.bodies, self.motions]
            self._step.launch(self.kernels.end_joints, self._joints, inputs, [self.arrays, self.pools.graph])
            self._per_mechanism(self.kernels.note_coordinates, [self.dt], [self.state, self.motions], [self.arrays])

    def support(self) -> None:
        """Sleeping: islands that hang from the world are supported."""
        if self.present:
            inputs = [self.bodies, self.motions, self.pools.graph, self.arrays]
            self._step.launch(self.kernels.support_joined, self._joints, inputs, [self._step.sleep_state])

    def _per_mechanism(self, kernel: Any, before: list, inputs: list, outputs: list) -> None:
        lanes = int(team.MECHANISM_LANES) if self._step.device.is_cuda else 1
        self._step.launch(kernel, self._mechanisms * lanes, [*before, lanes, *inputs], outputs)

    def _per_team(self, kernel: Any, changed: list, before: Sequence = ()) -> None:
        self._step.per_team(kernel, [], changed, before)
