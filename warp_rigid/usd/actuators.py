"""Actuators of MuJoCo: position and velocity servos of joints, which become drives."""

import math
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd

from warp_rigid.usd.prims import value_of
from warp_rigid.usd.usd_file import UsdFile

ACTUATOR = "MjcActuator"
"""Type of the prims."""


@dataclass(frozen=True)
class Servo:
    """A torque `offset - stiffness * q - damping * v` of a joint, with q and v as in MuJoCo.

    Attributes:
        offset: [N or N m].
        stiffness: [N/m or N m/rad].
        damping: [N s/m or N m s/rad].
        largest: largest force or torque [N or N m].
    """

    offset: float
    stiffness: float
    damping: float
    largest: float


def read_servos(file: UsdFile) -> dict[str, Servo]:
    """The servos of a file, by the paths of their joints; their controls are zero.

    Actuators that do not become drives are left out.
    """
    found: dict[str, Servo] = {}
    for prim in file.stage.Traverse():
        if prim.GetTypeName() == ACTUATOR:
            targets = prim.GetRelationship("mjc:target").GetTargets() if prim.HasRelationship("mjc:target") else []
            try:
                found[str(targets[0])] = _servo(prim, targets, found)
            except _NoServo as error:
                file.leave_out(prim.GetPath(), f"{ACTUATOR}: {error}")
    return found


class _NoServo(Exception):
    """Why an actuator does not become a drive."""


def _servo(prim: Usd.Prim, targets: list[Sdf.Path], found: dict[str, Servo]) -> Servo:
    """The servo with a control of zero; see MuJoCo, "Actuation model"."""
    gain, bias, dynamics = (str(value_of(prim, f"mjc:{name}Type", "")) for name in ("gain", "bias", "dyn"))
    target = prim.GetStage().GetPrimAtPath(targets[0]) if len(targets) == 1 else None
    if not target or target.GetTypeName() not in ("PhysicsRevoluteJoint", "PhysicsPrismaticJoint"):
        raise _NoServo("it acts on no hinge or slider: not supported")
    if gain not in ("", "fixed") or bias not in ("", "none", "affine"):
        raise _NoServo(f"gain {gain or 'fixed'} with bias {bias or 'none'}: not supported")
    if bias != "affine":
        raise _NoServo("a motor whose force is its control: not imported")
    if dynamics not in ("", "none"):
        raise _NoServo(f"dynamics {dynamics}: not supported")
    if str(targets[0]) in found:
        raise _NoServo("another actuator drives this joint")
    gear = _numbers(prim, "mjc:gear", 1, 1.0)[0]
    offset, position, velocity = _numbers(prim, "mjc:biasPrm", 3, 0.0)
    stiffness, damping = -gear * gear * position, -gear * gear * velocity
    if stiffness < 0.0 or damping < 0.0:
        raise _NoServo("its feedback is positive: not supported")
    ends = [abs(_numbers(prim, f"mjc:forceRange:{end}", 1, 0.0)[0]) for end in ("min", "max")]
    limited = str(value_of(prim, "mjc:forceLimited", "")) != "false" and max(ends) > 0.0
    largest = max(ends) * abs(gear) if limited else math.inf
    return Servo(gear * offset, stiffness, damping, largest)


def _numbers(prim: Usd.Prim, name: str, count: int, default: float) -> list[float]:
    """The first numbers of an attribute; the default for those that it lacks."""
    given = np.ravel(value_of(prim, name, ())).astype(np.float64).tolist()
    return (given + [default] * count)[:count]
