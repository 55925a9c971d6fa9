"""The coordinate of a joint: limits, drive and friction as one row, whose impulse depends on its velocity.

The impulse is a monotonic function of the velocity, made of straight pieces. In each mode the row follows one piece: it
is held at a limit or by friction, it has the compliance of the drive, or its impulse is constant. After each solution
the mode is checked, and changed where velocity and impulse do not lie on the piece.
"""

from enum import IntEnum

import warp as wp

from warp_rigid.kernels.enums import JointNumber
from warp_rigid.kernels.joints.arrays import Joints
from warp_rigid.kernels.joints.poses import free_row

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

TOLERANCE = wp.constant(wp.float64(1.0e-7))
"""Distance from a limit that counts as none [m or rad]."""

NEAR_LIMIT = wp.constant(wp.float64(1.0e-5))
"""Distance from a limit at which a coordinate that approaches it is stopped before the step's forces act."""


class Mode(IntEnum):
    """What determines the impulse of a joint's coordinate."""

    LAW = 0
    """Drive and friction; it may depend on the velocity."""
    AT_LOWER = 1
    """The lower limit holds it."""
    AT_UPPER = 2
    """The upper limit holds it."""
    STUCK = 3
    """Friction holds it."""
    IDLE = 4
    """The armature alone, before the step's forces are known."""


@wp.func
def number_of(j: int, which: int, joints: Joints):
    """A parameter of a joint, by JointNumber."""
    return wp.float64(joints.numbers[j, which])


@wp.func
def drive_impulse(j: int, dt: wp.float64, value: wp.float64, speed: wp.float64, joints: Joints):
    """Impulse of the drive without its limit, at the end of a step with this value and speed."""
    spring = number_of(j, JointNumber.STIFFNESS, joints) * (number_of(j, JointNumber.TARGET_POSITION, joints) - value)
    damper = number_of(j, JointNumber.DAMPING, joints) * (number_of(j, JointNumber.TARGET_VELOCITY, joints) - speed)
    return dt * (spring + damper)


@wp.func
def drive_slope(j: int, dt: wp.float64, joints: Joints):
    """Decrease of the impulse of drive and armature per velocity [kg or kg m^2]."""
    armature = number_of(j, JointNumber.ARMATURE, joints)
    if joints.mode[j][2] != 0 or joints.mode[j][0] == Mode.IDLE:
        return armature
    return (
        dt * (dt * number_of(j, JointNumber.STIFFNESS, joints) + number_of(j, JointNumber.DAMPING, joints)) + armature
    )


@wp.func
def armature_impulse(j: int, speed: wp.float64, joints: Joints):
    """Impulse of the inertia that a rotor adds to the coordinate, from the change of its velocity in the step."""
    return number_of(j, JointNumber.ARMATURE, joints) * (joints.speed[j] - joints.drift[j] - speed)


@wp.func
def damping_slope(j: int, dt: wp.float64, joints: Joints):
    """Decrease of the damping's impulse per velocity [kg m^2]."""
    return dt * number_of(j, JointNumber.DAMPING, joints)


@wp.func
def limited_drive(j: int, dt: wp.float64, value: wp.float64, speed: wp.float64, joints: Joints):
    """Impulse of the drive, within its limit, and of the armature."""
    most = dt * number_of(j, JointNumber.MAX_FORCE, joints)
    drive = wp.clamp(drive_impulse(j, dt, value, speed, joints), -most, most)
    return drive + armature_impulse(j, speed, joints)


@wp.func
def law_impulse(j: int, dt: wp.float64, value: wp.float64, speed: wp.float64, joints: Joints):
    """Impulse of drive, armature and sliding friction in the present mode."""
    mode = joints.mode[j]
    impulse = drive_impulse(j, dt, value, speed, joints)
    if mode[2] != 0:
        impulse = wp.float64(mode[2]) * dt * number_of(j, JointNumber.MAX_FORCE, joints)
    friction = wp.float64(mode[1]) * dt * number_of(j, JointNumber.FRICTION, joints)
    return impulse + armature_impulse(j, speed, joints) - friction


@wp.func
def is_held(mode: wp.vec3i):
    """Whether the coordinate is held at a limit or by friction."""
    return mode[0] != Mode.LAW and mode[0] != Mode.IDLE


@wp.func
def excess_of(j: int, value: wp.float64, joints: Joints):
    """How far a value is beyond the limits [m or rad], negative below the lower one."""
    over = wp.max(value - number_of(j, JointNumber.UPPER, joints), wp.float64(0.0))
    return over + wp.min(value - number_of(j, JointNumber.LOWER, joints), wp.float64(0.0))


@wp.func
def mode_before_forces(j: int, value: wp.float64, speed: wp.float64, joints: Joints):
    """Mode in which the velocities at the start of a step are made to obey the joints."""
    if joints.numbers[j, JointNumber.LOWER] == joints.numbers[j, JointNumber.UPPER]:
        return wp.vec3i(Mode.AT_LOWER, 0, 0)
    if value > number_of(j, JointNumber.UPPER, joints) - NEAR_LIMIT and speed > wp.float64(0.0):
        return wp.vec3i(Mode.AT_UPPER, 0, 0)
    if value < number_of(j, JointNumber.LOWER, joints) + NEAR_LIMIT and speed < wp.float64(0.0):
        return wp.vec3i(Mode.AT_LOWER, 0, 0)
    return wp.vec3i(Mode.IDLE, 0, 0)


@wp.func
def without_limit(j: int, joints: Joints):
    """Mode of a coordinate between its limits, before its direction of motion is known."""
    if joints.numbers[j, JointNumber.FRICTION] > 0.0:
        return wp.vec3i(Mode.STUCK, 0, 0)
    return wp.vec3i(Mode.LAW, 0, 0)


@wp.func
def limit_beyond(j: int, value: wp.float64, joints: Joints):
    """Mode.AT_LOWER or Mode.AT_UPPER if a value is beyond a limit, else Mode.LAW."""
    if value < number_of(j, JointNumber.LOWER, joints) - TOLERANCE:
        return Mode.AT_LOWER
    return wp.where(value > number_of(j, JointNumber.UPPER, joints) + TOLERANCE, Mode.AT_UPPER, Mode.LAW)


@wp.func
def first_mode(j: int, value: wp.float64, joints: Joints):
    """Mode with which a step begins, from the predicted value of the coordinate."""
    if joints.numbers[j, JointNumber.LOWER] == joints.numbers[j, JointNumber.UPPER]:
        return wp.vec3i(Mode.AT_LOWER, 0, 0)
    beyond = limit_beyond(j, value, joints)
    if beyond != Mode.LAW:
        return wp.vec3i(beyond, 0, 0)
    return without_limit(j, joints)


@wp.func
def sign_of(x: wp.float64):
    """1 for positive numbers, else -1."""
    return wp.where(x > wp.float64(0.0), 1, -1)


@wp.func
def next_mode(j: int, dt: wp.float64, value: wp.float64, speed: wp.float64, joints: Joints):
    """Mode after a solution with this value and speed; the same one if they lie on its piece."""
    mode = joints.mode[j]
    if joints.numbers[j, JointNumber.LOWER] == joints.numbers[j, JointNumber.UPPER]:
        return mode
    impulse = joints.total[j][free_row(joints.coordinate[j])]
    rest = impulse - limited_drive(j, dt, value, speed, joints)
    if mode[0] == Mode.AT_LOWER or mode[0] == Mode.AT_UPPER:
        pulls = wp.where(mode[0] == Mode.AT_LOWER, -rest, rest)
        if pulls > wp.float64(0.0):
            return without_limit(j, joints)
        return mode
    beyond = limit_beyond(j, value, joints)
    if beyond != Mode.LAW:
        return wp.vec3i(beyond, 0, 0)
    if mode[0] == Mode.STUCK:
        if wp.abs(rest) > dt * number_of(j, JointNumber.FRICTION, joints):
            return wp.vec3i(Mode.LAW, -sign_of(rest), 0)
        return mode
    if mode[1] != 0 and speed * wp.float64(mode[1]) < wp.float64(0.0):
        return wp.vec3i(Mode.STUCK, 0, 0)
    drive = drive_impulse(j, dt, value, speed, joints)
    if wp.abs(drive) <= dt * number_of(j, JointNumber.MAX_FORCE, joints):
        return wp.vec3i(Mode.LAW, mode[1], 0)
    return wp.vec3i(Mode.LAW, mode[1], sign_of(drive))


@wp.func
def held_residual(j: int, dt: wp.float64, value: wp.float64, speed: wp.float64, joints: Joints):
    """Velocity to be removed from a held coordinate [m/s or rad/s]."""
    mode = joints.mode[j][0]
    if mode == Mode.STUCK:
        return speed
    limit = number_of(j, wp.where(mode == Mode.AT_LOWER, JointNumber.LOWER, JointNumber.UPPER), joints)
    return (value - limit - joints.allowed[j][free_row(joints.coordinate[j])]) / dt
