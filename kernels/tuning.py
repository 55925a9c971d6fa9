"""Thresholds of the contact solver, the contact search, continuous collision detection and sleeping.

Each has its unit, the reason for its value, and the scene that shows it. The velocity unit is `Motions.velocity_unit`:
what gravity adds to a velocity in a step, but at most 0.04 m/s. Sizes of a body are `ShapeRecord.size`. Checkpoints
store the values, and `warp-rigid doctor --json` shows them.
"""

import ast
from functools import cache
from pathlib import Path
from typing import NamedTuple

import warp as wp

# Which islands are solved how

FLIGHT = wp.constant(0.05)
"""Time without contact after which a body counts as fallen [s]."""

COMPARABLE = wp.constant(100.0)
"""Largest ratio of masses in an island that is solved in rounds: they converge slowly where heavy bodies are on light
ones."""

EVEN = wp.constant(4.0)
"""Largest ratio of masses in an even pile, which is solved by sweeps alone while it moves, and without further ones.
With these, uneven piles overlap half as much: 32 boxes, some of 200 times the mass, by 4 instead of 8 mm while they
land; in a step they gain 2e-5 of their energy at most, instead of 5e-4."""

BUSY = wp.constant(0.25)
"""Speed of a body from which an even pile is solved by sweeps alone, in sizes of the body per second. With 0.05, boxes
that have fallen on each other keep moving by 1 cm/s."""

HARDLY = wp.constant(0.05)
"""Largest speed of a body in an island that hardly moves, in sizes of the body per second."""

RESTING = wp.constant(0.01)
"""Largest speed of a body in an island at rest, in sizes of the body per second. It is swept until it has converged
(calm.py), except for an even pile, which converges over several steps."""

RESTING_SHARE = wp.constant(0.1)
"""Speed that also counts as rest, as a fraction of the velocity that gravity adds in a step. Bodies move so fast
because their contacts were not solved: a tall cylinder would rock indefinitely."""

# Sweeps

CONVERGED = wp.constant(2.5e-5)
"""Sweeps and passes end when no row changes a velocity by more than this [velocity units]. With 2e-5 m/s, a stack of 50
falls."""

SWEEPS_PER_DEPTH = wp.constant(2)
"""Additional sweeps per depth of the contact graph where an island is solved by sweeps alone, which then transmit its
load."""

LEAST_CALM = wp.constant(6)
"""Maximum sweeps with momentum over an island of so many bodies or fewer at rest (calm.py), as a multiple of
`contact_iterations`. The foot of a tall cylinder needs 30 to 50 sweeps."""

MOST_CALM = wp.constant(30)
"""The same for islands of so many bodies or more; between them, it is the number of bodies."""

MOST_IN_MOTION = wp.constant(6)
"""Maximum sweeps with momentum over several bodies that move, such as a tower that topples, as a multiple of
`contact_iterations`; an even pile has none. Without these sweeps, overlaps arise in the tower, whose push-out adds 1e-4
of its potential energy."""

CALM_CONVERGED = wp.constant(2.5e-4)
"""Sweeps with momentum end when no row changes a velocity by more than this [velocity units]."""

DIVERGED = wp.constant(10.0)
"""Momentum has diverged in an island at rest once a row changes a velocity by more than this multiple of the change
before the first sweep, or of what gravity adds in the step. With 1, an arch of 27 stones falls."""

NEGLIGIBLE = wp.constant(0.005)
"""An island in motion is near its solution, and momentum has not diverged there, if no row changes a velocity by more
than this fraction of what gravity adds in the step. With 0, momentum ends at rounding errors on a GPU, and a tower that
topples gains 2e-6 of its energy; with 0.01, a tray under 144 boxes of its mass stops 1.1 % too early."""

# Shock propagation

SLANT = wp.constant(0.05)
"""A body is supported if at least this fraction of its acceleration is along the normal, so not by vertical walls."""

SHOCK_SWEEPS = wp.constant(4)
"""Maximum sweeps of a pass, besides those for each level of depth. With two, a tower of thirty crossed layers of beams
collapses."""

SWEEPS_PER_LEVEL = wp.constant(3)
"""Further sweeps of a pass for each level of depth. With two, towers that topple gain 5e-4 of their energy, and a
ragdoll that has fallen under a plate keeps moving."""

SWEEPS_PER_LEVEL_OF_PILE = wp.constant(2)
"""The same in piles without joints. With one, a bunny rocks by 1 mrad."""

PAIR_ITERATIONS = wp.constant(4)
"""Maximum iterations over the contacts of a pair per visit, if its upper body has no other support. With one, a stack
of 50 collapses."""

SHARED_ITERATIONS = wp.constant(2)
"""The same if its upper body has several supports, and in even piles that move. With one, the tower of beams collapses,
and 14 boxes that land on each other shift by 20 instead of 2 mm; with eight, the first pair takes the whole load, and a
pyramid of 20 rows is deformed by 1 mm. With two in other piles, bumpy shapes do not come to rest, and a cube on one
of a thousandth of its mass keeps moving by 6 cm/s."""

# Rounds

PILE_ROUNDS = wp.constant(4.0)
"""Maximum number of rounds in an even pile, as a multiple of `contact_iterations`: the constant part. Such a pile
converges over several steps: five times as many rounds do not bring 1000 boxes to rest earlier."""

PILE_ROUNDS_PER_BODY = wp.constant(0.3)
"""The part of it for each body that load passes on its way to the ground: along the edge of a cube of as many bodies,
or along the height if that is larger."""

STRUCTURE_ROUNDS = wp.constant(20.0)
"""The constant part in a structure, whose bodies were placed where they are."""

STRUCTURE_ROUNDS_PER_BODY = wp.constant(2.0)
"""The part for each body that load passes there. A pyramid of 100 rows needs 3000 rounds in its first step, and a few
in later ones."""

STRUCTURE_ROUNDS_AT_REST = wp.constant(100.0)
"""The constant part in a structure that hardly moves. A tower of 400 flat bricks, whose layers are lower than its
bodies are long, needs 800 rounds in its first step; if it does not get them, it needs as many as it gets in each
step."""

PILE_CONVERGED = wp.constant(2.5e-4)
"""Rounds end when no contact changes the velocity of a body in a pile by more than this [velocity units]."""

STRUCTURE_CONVERGED = wp.constant(4.0e-7)
"""Rounds end when no contact changes the velocity of a body in a structure by more than this fraction of the velocity
that gravity adds in a step to all bodies that are stacked in it. Rounding errors were half as large in pyramids of 50
and 100 rows. Larger errors of the load deform a structure."""

STRUCTURE_ROUNDING = wp.constant(1.0e-6)
"""In a structure that moves, this fraction of its largest speed is also enough: rounding errors of velocities are half
as large where 25 boxes slide on a tray."""

LOWEST_STRUCTURE = wp.constant(4.0)
"""Least number of stacked bodies that counts for STRUCTURE_CONVERGED."""

MOST_MOMENTUM = wp.constant(0.98)
"""Maximum momentum of rounds, and of sweeps. With 0.9, a pyramid of 50 rows is not solved by 1200 rounds in its first
step, with 0.98 it is by 970, and an arch of 45 stones needs more sweeps than it gets; without a limit, both diverge."""

PLAIN_ROUNDS = wp.constant(3)
"""Rounds without momentum at the end, if the limit is reached. They do not increase the energy."""

NOTICEABLE = wp.constant(0.25)
"""A pair is solved again if the last round changed the velocity of one of its bodies by more than this share of the
change at which rounds end. So a box that slides on a heap at rest costs little more than its neighbourhood."""

# Islands at rest

STOPPED_SPEED = wp.constant(5.0e-4)
"""Largest speed of a body that is stopped, as a fraction of the velocity that gravity adds in a step."""

CLEARANCE = wp.constant(10.0)
"""How far an impulse is from its limits: the velocity that it gives there, as a multiple of the largest speed. In
islands that are solved in rounds, bodies may be that fast: the error of a pyramid of 50 rows is 1 mm/s."""

DEEP_ENOUGH = wp.constant(4)
"""Depth in bodies from which islands are stopped. In shallower ones, sweeps reduce the error fast."""

AT_ONCE = wp.constant(6)
"""Round from which a change shows that the impulses of the last step did not solve an island."""

NOT_ON_A_LINE = wp.constant(0.1)
"""Three contacts of a body at rest are not on a line: sine of the smallest angle between the directions from one to the
others."""

# Impacts

IMPACT_ITERATIONS = wp.constant(8)
"""Maximum iterations over the contacts of a pair per impact, or per sweep over a group of them. A box of 1 m that
bounces at 7 m/s off a base of a tenth of its width, 2 cm beside the middle, leaves with 4e-2 rad/s, with 16 iterations
with 2e-3; over the middle it does not turn."""

GROUP_SWEEPS = wp.constant(16)
"""Maximum sweeps over a group of simultaneous impacts. In a box that lands on two tiles, 4 sweeps leave an error of
3 mm/s, 8 of 1e-6 m/s."""

SLOWEST = wp.constant(2.5e-3)
"""Approach speed below which a contact is not an impact [velocity units]."""

# Push-out

PUSH_OUT_SWEEPS = wp.constant(6)
"""Maximum sweeps of the push-out, plus one for each level of depth."""

SLOP = wp.constant(1.0e-4)
"""Overlap that is not corrected, as a fraction of the smaller body's size."""

RECOVERY = wp.constant(0.25)
"""Fraction of the overlap at the start of the step that is removed in the step."""

UPRIGHT_NORMAL = wp.constant(0.98)
"""Cosine (11 degrees) of normal and acceleration from which the lower body of a contact is frozen."""

LIGHTER = wp.constant(10.0)
"""A lower body that is lighter than the upper one by this factor is always frozen: it would be pushed away instead."""

PUSH_OUT_CONVERGED = wp.constant(2.5e-3)
"""The push-out ends when no contact changes a pseudo-velocity by more than this [velocity units]: at 240 steps per
second by less than a micrometre per step."""

WEIGHTLESS = wp.constant(0.04)
"""Share of the smaller size by which bodies without acceleration are pushed apart in a step, at most."""

FURTHEST_PUSH = wp.constant(0.25)
"""Bodies are pushed apart in a step by at most this fraction of the smaller size: no wall is crossed by a push."""

SHARE_OF_TARGET = wp.constant(0.03)
"""Rounds of the push-out end when no pseudo-velocity changes by more than this share of the largest separation speed in
the environment, or by PUSH_OUT_CONVERGED if that is more. While bodies fall on each other, overlaps change from step to
step."""

# Contact rows

TOUCHING = wp.constant(1.0e-4)
"""Contacts with a gap up to this fraction of the smaller body's size transmit load without closing the gap. If gaps of
the size of rounding errors had to close first, the load would move from contact to contact in each step. A pyramid of
20 rows moves by 0.02 mm with this value, but by millimetres with a fifth of it."""

WIDER = wp.constant(1.05)
"""Contacts with a gap up to this factor times TOUCHING transmit load, too. Gaps that have just closed exceed TOUCHING
by rounding errors. Without this factor they would have a small bias velocity in every step, and the solver would seldom
converge in the first sweep for a stack at rest."""

SLIDING_SHARE = wp.constant(0.99)
"""Fraction of the friction limit from which a pair counts as sliding. Contacts that stick can share a load as they
like."""

PARALLEL_NORMALS = wp.constant(0.99999)
"""Cosine (0.3 degrees) above which two contact normals count as parallel."""

ON_A_LINE = wp.constant(1.0e-5)
"""Fraction of the sum of the second moments that is added to both, so that contacts on a line have a solution."""

# Contact search

CONTACT_DISTANCE = wp.constant(5.0e-4)
"""Samples closer than this fraction of the smaller body's size count as touching."""

NEAR_REACH = wp.constant(0.25)
"""Reach of contacts of fast bodies, and the largest speculative distance, as fractions of the smaller size."""

PUSHED = wp.constant(0.5)
"""The speculative distance is this fraction of the path of the faster body in the step: without restitution, two bodies
of the same mass that collide share their velocity."""

REUSE_TRAVEL = wp.constant(2.5e-4)
"""Pairs that have moved less than this fraction of the smaller size, half the contact distance, keep their contacts."""

TURNED_BACK = wp.constant(0.25)
"""Separating samples closer than this fraction of the pair's reach are kept: they may come back within the step."""

CLEARLY = wp.constant(3.0)
"""A sample clearly enters a face if it is deeper than this many contact distances."""

FURTHEST_PATH = wp.constant(16.0)
"""The path of a step is extended at most by this factor."""

SLOW_APPROACH = wp.constant(0.01)
"""Samples that approach by less than this many contact distances in a step touch without further tests."""

RIM_FLAT = wp.constant(5.0e-4)
"""Sine of the tilt below which a rim has no deepest point. Rounding errors are a thousandth of it."""

RIM_LEAN = wp.constant(0.02)
"""A rim that lies flat touches where the load points, as if it were tilted by this times the load's share along it. At
a tilt of twice this sine and more, as that of a cylinder that rolls, the load has no effect."""

# Choice of contacts

SAME_PATCH = wp.constant(0.94)
"""Cosine (20 degrees) above which two contact normals belong to the same patch."""

TIPPED_WEIGHT = wp.constant(20.0)
"""Reduction of a sample's extent per metre of gap: the sample touches first once the bodies have tilted by three
degrees."""

TURNING_WEIGHT = wp.constant(5.0)
"""Least reduction per metre of gap, for bodies that turn by a fifth of a radian or more in the step."""

UPRIGHT_WEIGHT = wp.constant(200.0)
"""Reduction per metre of gap for bodies at rest, in every other direction."""

TRAVEL_WEIGHT = wp.constant(0.5)
"""Reduction between TIPPED_WEIGHT and UPRIGHT_WEIGHT: this constant times the smaller size over the pair's travel in
the step."""

RANKED_GAP = wp.constant(0.02)
"""Overlaps beyond this fraction of the smaller size count as equal. Otherwise the deepest sample of a deep overlap
would replace those that support the body, which would then turn further in about a single contact. Gaps beyond it that
close count as equal, too, where a body is a convex solid: it has few samples, and may turn onto each of its corners."""

COMES_NEAR = wp.constant(0.5)
"""A gap closes if less than this fraction of it is left after the step. If all gaps beyond RANKED_GAP counted as equal,
the edge of a narrow tile beyond the end of a capsule would replace the contact that carries it."""

TIE = wp.constant(1.0e-6)
"""A later sample replaces an earlier one only if its score is higher by the weight of a gap of this fraction of the
size, so that rounding errors have no effect."""

SLOPING = wp.constant(0.025)
"""Share of a load along the contact from which it has a direction there: a slope of 1.4 degrees."""

# Deep overlaps

DEEP_OVERLAP = wp.constant(0.02)
"""If convex solids overlap by more than this fraction of the smaller size along every normal of their samples, these
are compared with the axis of least overlap."""

DOUBTFUL = wp.constant(0.005)
"""Depth from which this is also done where samples are less deep than the solids overlap along their normals."""

ALONG_AXIS = wp.constant(0.5)
"""In a deep overlap, samples whose normal has a cosine with the axis of least overlap below this value are dropped."""

TRUSTED = wp.constant(1.25)
"""In a deep overlap, samples deeper than this factor times the depth are dropped. Without one that is as deep as the
depth divided by it, a contact along the axis is added."""

OPPOSING_NORMALS = wp.constant(-0.8)
"""Two contact normals with a cosine below this oppose each other."""

HIDDEN_DEPTH = wp.constant(0.1)
"""Depth from which a sample that is no contact shows that two bodies are crossed, as a fraction of the radius of the
smaller one of their largest inner balls."""

# Continuous collision detection

FAST_TRAVEL = wp.constant(0.25)
"""A pair is traced if its relative motion in a step exceeds this fraction of the smaller size."""

ALLOWED_DEPTH = wp.constant(0.02)
"""Depth of penetration at which a body is stopped, as a fraction of the smaller size."""

DEPTH_OF_CONTACTS = wp.constant(0.1)
"""Depth at which touching bodies are stopped if one of them is joined to others, as a fraction of the smaller size.
They are left to the solver and the push-out. All bodies of a mechanism stop together; at a smaller depth, a heap of
mechanisms that fold up would stop in nearly every step."""

CLOSE_ENOUGH = wp.constant(2.0e-3)
"""A trace or an advancement ends when the remaining distance is below this fraction of the smaller size."""

LEFT_OF_DEPTH = wp.constant(0.25)
"""Fraction of the allowed depth by which a pair may get deeper without being traced again. After a trace, bodies get
deeper than allowed by at most their relative motion after the impact that was found, and by the changes of their
relative motion since. A pair is traced again when the sum of these bounds exceeds this fraction, so that the overlap
stays below 1 + LEFT_OF_DEPTH times the allowed depth. Bodies between two others are hit by both in turn, and each hit
changes their motion by a part of the last one: without this bound, most iterations change next to nothing."""

CARRIED = wp.constant(0.5)
"""A body that turns with its kinematic carrier at this fraction of its speed or more is carried around. Without this
condition, rollers at 2 m/s convey a plank 3 % too slowly; with 1, boxes creep on a seesaw that changes its speed."""

# Sleeping

SLEEP_SPEED = wp.constant(0.1)
"""Speed below which a body counts as slow, in body sizes per second; also applies to the rotation of its surface."""

SLEEP_TRAVEL = wp.constant(0.02)
"""Displacement allowed for a body at rest, as a fraction of its size."""

SLEEP_DELAY = wp.constant(0.5)
"""Least time for which a body must have been at rest to fall asleep [s]."""

SLEEP_FALL = wp.constant(6.0)
"""Way that the acceleration of a body would move it by in the time for which it must have been at rest, in sizes of the
body: 0.5 s for a box of 0.2 m, 3.5 s for one of 10 m. A ball on a slope of more than 0.5 % then moves too far to sleep;
without it, a ball of 10 m fell asleep on a slope of 5 %."""


class Threshold(NamedTuple):
    """A value of this file, with its unit, its reason and the scene that shows it in words."""

    value: float
    text: str


@cache
def thresholds() -> dict[str, Threshold]:
    """The thresholds by name, in the order of this file."""
    found = {}
    body = ast.parse(Path(__file__).read_text(encoding="utf-8")).body
    for node, doc in zip(body, body[1:], strict=False):
        if isinstance(node, ast.Assign) and isinstance(doc, ast.Expr) and isinstance(doc.value, ast.Constant):
            name = ast.unparse(node.targets[0])
            found[name] = Threshold(float(globals()[name]), " ".join(str(doc.value.value).split()))
    return found
