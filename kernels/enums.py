"""Enumerations that the host and the kernels share. Warp kernels use their members as integer constants."""

from enum import IntEnum, IntFlag


class Motion(IntEnum):
    """How a body moves."""

    STATIC = 0
    """Never moves."""
    KINEMATIC = 1
    """Moves with its own velocity; contacts do not change it."""
    DYNAMIC = 2
    """Moves under forces and contacts."""


class Role(IntFlag):
    """Role of a body in the current step."""

    ABSENT = 0
    STATIC = 1
    ASLEEP = 2
    KINEMATIC = 4
    FREE = 8


class SolverPart(IntFlag):
    """Parts of the contact solver, in their order."""

    WARM_START = 1
    """Initial impulses."""
    SWEEPS = 2
    """Sweeps before and after shock propagation."""
    REST = 4
    """Islands at rest are stopped."""
    PASSES = 8
    """The passes of shock propagation."""
    ENERGY = 16
    """Sums of the line search."""
    STEP_LENGTH = 32
    """The step length of the line search is applied."""
    CALM = 64
    """Further sweeps over calm islands, and the second line search."""
    ALL = 127


class PartKind(IntEnum):
    """Signed distance function of a part of a shape."""

    SPHERE = 0
    BOX = 1
    CAPSULE = 2
    CYLINDER = 3
    PLANE = 4
    GRID = 5
    HEIGHTFIELD = 6


class SampleKind(IntEnum):
    """What a surface sample represents."""

    POINT = 0
    """A vertex, or the centre of a sphere."""
    EDGE = 1
    """A segment of an edge; the contact point is searched for along it."""
    RIM = 2
    """A circle; the contact point with a convex shape is searched for around it."""
    FACE = 3
    """A point inside a face, for contacts with nonconvex shapes."""
    CAP = 4
    """A point on the rim of a cylinder's cap, used when the cap lies flat; RIM is used when it is tilted."""
    CORNER = 5
    """Kind of a cluster: further places where balls touch a mesh, which in an inner corner are several."""
    ARC = 6
    """A piece of a circle; the contact point with a nonconvex shape is searched for along it."""
    SIDE = 7
    """The last segment of a cylinder's axis, searched as an edge."""


class FieldKind(IntEnum):
    """Kinds of force fields."""

    UNIFORM = 0
    POINT = 1
    DRAG = 2


class ShockMode(IntEnum):
    """Shock propagation modes."""

    OFF = 0
    ONE_PASS = 1
    TWO_PASS = 2


class WarningKind(IntEnum):
    """What a health check finds in an environment that is still simulated."""

    OVERLAP = 0
    """An overlap that does not shrink."""
    ENERGY = 1
    """Energy that was gained without work."""
    PRECISION = 2
    """A position that single precision resolves too coarsely for the size of the body."""
    LOAD = 3
    """A contact force that is too large for the mass of the body."""
    RESIDUAL = 4
    """Velocities that the solver has not solved."""


class OutOfBounds(IntEnum):
    """What happens to a body whose centre of mass leaves the bounds of its environment."""

    UNBOUNDED = 0
    """There are no bounds."""
    REPORT = 1
    REMOVE = 2


class CombineRule(IntEnum):
    """How the coefficients of two bodies are combined."""

    MIN = 0
    AVERAGE = 1
    MULTIPLY = 2
    MAX = 3


class Coordinate(IntEnum):
    """The coordinate of a joint that limits, drive and friction act on."""

    NONE = 0
    ANGLE = 1
    """Angle of the first body about the axis, relative to the second [rad]."""
    SLIDE = 2
    """Displacement of the first anchor along the axis of the second body [m]."""
    CONE = 3
    """Angle between the axis in both bodies [rad]."""
    LENGTH = 4
    """Distance of the anchors [m]."""


class JointNumber(IntEnum):
    """Columns of `Joints.numbers`."""

    LOWER = 0
    UPPER = 1
    FRICTION = 2
    STIFFNESS = 3
    DAMPING = 4
    MAX_FORCE = 5
    TARGET_POSITION = 6
    TARGET_VELOCITY = 7
    BREAK_FORCE = 8
    BREAK_TORQUE = 9
    ARMATURE = 10


class IslandSolver(IntEnum):
    """How an island is solved in a step."""

    SHOCK = 0
    """Sweeps and shock propagation."""
    SWEEPS = 1
    """Sweeps alone."""
    ROUNDS = 2
    """Rounds (rounds.py)."""
