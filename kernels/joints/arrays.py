"""Declaration of the arrays of joints, and what their symbols count."""

import warp as wp

from warp_rigid.kernels.declare import Field, Lifetime, Remembered, Reused, Scratch, Setting, layout

mat33d = wp.types.matrix(shape=(3, 3), dtype=wp.float64)
mat66d = wp.types.matrix(shape=(6, 6), dtype=wp.float64)
mat63d = wp.types.matrix(shape=(6, 3), dtype=wp.float64)
vec6d = wp.types.vector(length=6, dtype=wp.float64)

JOINT_SYMBOLS = {
    "joints": "joints of all environments",
    "joined": "bodies of all environments; 0 if none of them has joints",
    "mechanisms": "groups of joints that dynamic bodies connect",
    "members": "bodies of the mechanisms",
    "ends": "members of the mechanisms, once for each joint that they have",
    "blocks": "blocks below the diagonal in the factors of the mechanisms",
    "eliminations": "updates of a block during factorization",
    "visits": "capacity for pairs; 0 if no environment has joints",
}
"""What the symbols in the shapes of these arrays count, besides schema.SYMBOLS."""

Joints = layout(
    "Joints",
    "Joints, and the mechanisms that they form. Each joint has six rows: three translations, then three rotations.",
    lifetime=Lifetime.SCENE,
    body_a=Field(int, "joints", "", "first body", "bodies"),
    body_b=Field(int, "joints", "", "second body; the first one again for a joint with the world", "bodies"),
    to_world=Field(int, "joints", "", "1: the second frame is fixed to the world"),
    locked=Field(int, "joints", "", "bit mask of the rows that the joint prevents"),
    coordinate=Field(int, "joints", "", "a Coordinate: what limits, drive and friction act on"),
    anchor_a=Field(wp.vec3, "joints", "m", "origin of the first frame, in the first body's frame"),
    anchor_b=Field(wp.vec3, "joints", "m", "origin of the second frame, in the second body's frame"),
    turn_a=Field(wp.quat, "joints", "", "orientation of the first frame, in the first body's frame"),
    turn_b=Field(wp.quat, "joints", "", "orientation of the second frame, in the second body's frame"),
    numbers=Setting(float, "joints, 11", "SI", "parameters, by JointNumber"),
    broken=Remembered(int, "joints", "", "1: broken, without effect"),
    position=Remembered(float, "joints", "SI", "coordinate after the last step; angles count full turns"),
    speed=Scratch(wp.float64, "joints", "SI", "velocity of the coordinate at the start of the step"),
    drift=Scratch(wp.float64, "joints", "SI", "predicted change of that velocity by free motion, without impulses"),
    impulse=Remembered(wp.vec3, "joints", "N s", "impulse of the last step on the first body at its anchor"),
    angular_impulse=Remembered(wp.vec3, "joints", "N m s", "angular impulse of the last step on the first body"),
    first_joint=Field(int, "envs + 1", "", "first joint of each environment", "joints"),
    first_mechanism=Field(int, "envs + 1", "", "first mechanism of each environment", "mechanisms"),
    first_place=Field(int, "mechanisms + 1", "", "first place of each mechanism in `sequence`", "joints"),
    first_member=Field(int, "mechanisms + 1", "", "first member of each mechanism", "members"),
    member=Field(int, "members", "", "bodies of the mechanisms", "bodies"),
    first_end=Field(int, "members + 1", "", "first entry of each member in `joint_of_end`", "ends"),
    joint_of_end=Field(int, "ends", "", "joints of each member, in the order of elimination", "joints"),
    anchored=Field(int, "mechanisms", "", "1: a joint holds it to the world, or to a body that is not dynamic"),
    of_body=Field(int, "joined", "", "mechanism of a dynamic body; negative if it has none", "mechanisms"),
    sequence=Field(int, "joints", "", "joints in the order of elimination, mechanism by mechanism", "joints"),
    column=Field(int, "joints + 1", "", "first block of the joint at each place of `sequence`", "blocks"),
    elimination=Field(int, "joints + 1", "", "first elimination of the joint at each place", "eliminations"),
    row=Field(int, "blocks", "", "joint of the block's rows; the later one of its two joints", "joints"),
    shared=Field(int, "blocks", "", "body that the two joints share; negative if the block is only fill-in", "bodies"),
    shared_too=Field(int, "blocks", "", "second body that they share; negative if there is none", "bodies"),
    left=Field(int, "eliminations", "", "first factor", "blocks"),
    right=Field(int, "eliminations", "", "second factor", "blocks"),
    target=Field(int, "eliminations", "", "block that is updated", "blocks"),
    active=Scratch(int, "joints", "", "bit mask of the rows in the factors"),
    mode=Scratch(wp.vec3i, "joints", "", "of the coordinate: a Mode, sliding direction, direction of drive saturation"),
    linear=Scratch(mat63d, "joints", "", "rows: coefficients of the relative linear velocity"),
    angular_a=Scratch(mat63d, "joints", "", "rows: coefficients of the first body's angular velocity"),
    angular_b=Scratch(mat63d, "joints", "", "rows: coefficients of the second body's angular velocity"),
    allowed=Scratch(vec6d, "joints", "SI", "errors that may remain after the step"),
    bias=Scratch(vec6d, "joints", "SI", "predicted errors and coordinate over dt, less the velocities along the rows"),
    total=Scratch(vec6d, "joints", "SI", "impulses of the rows in this step"),
    start=Scratch(vec6d, "joints", "SI", "the same before shock propagation, or before `settle_mechanism`"),
    solution=Scratch(
        vec6d,
        "joints, 7",
        "SI",
        "residuals of the rows, then the changes of their impulses: all at once; for each unit impulse on a body",
    ),
    pivot=Scratch(mat66d, "joints", "SI", "inverse of the diagonal block of the factorization"),
    lower=Scratch(mat66d, "blocks", "SI", "block of the factor below the diagonal"),
    factorizations=Reused(int, "mechanisms", "", "number of factorizations so far", start=0),
    activity=Scratch(int, "mechanisms", "", "in this step: STILL, UNTOUCHED or IN_CONTACT"),
    parts=Remembered(
        int, "mechanisms", "", "equal parts in which it was moved in the last step; 0 where they lose energy"
    ),
    loaded=Scratch(int, "mechanisms", "", "how its contacts are solved: SWEPT, TOUCHED, LOADED or CRUSHED"),
    weight=Scratch(float, "mechanisms", "kg", "mass of its dynamic bodies"),
    unsettled=Scratch(int, "mechanisms", "", "1: the solutions at predicted poses did not converge in this step"),
    touching=Scratch(int, "mechanisms", "", "pairs in contact that have a body of it"),
    terms=Scratch(wp.vec2d, "joints", "J", "contributions to the two sums of a line search"),
    swept=Scratch(int, "joined", "", "at an island's index: 1 if it has contacts that are solved in sweeps"),
    answered=Reused(int, "joined", "", "factorization of the mechanism to which `response` belongs", start=-1),
    pushed=Scratch(vec6d, "joined", "SI", "impulse and angular impulse of a visit on the body"),
    response=Reused(mat66d, "joined", "SI", "velocity of a body per impulse and angular impulse where the joints hold"),
    cross_response=Scratch(
        mat66d,
        "mechanisms",
        "SI",
        "of a pair of its bodies: velocity of the second per impulse and angular impulse on the first",
    ),
    inverse_mass=Scratch(wp.float64, "joined", "1/kg", "inverse mass for the joints; 0 unless free"),
    inverse_inertia=Scratch(
        mat33d, "joined", "1/(kg m^2)", "inverse inertia in the world for the joints; 0 unless free"
    ),
    base_position=Scratch(wp.vec3d, "joined", "m", "position at the start of the step, or of a part of it"),
    base_turn=Scratch(wp.quatd, "joined", "", "orientation at the start of the step, or of a part of it"),
    linear_before=Scratch(wp.vec3, "joined", "m/s", "velocity before the impulses of a part of the step"),
    angular_before=Scratch(wp.vec3, "joined", "rad/s", "angular velocity before the impulses of a part of the step"),
    balance=Scratch(wp.vec4d, "joined", "SI", "contributions to the energies of `balance_of`"),
    pose_spin=Scratch(wp.vec3d, "joined", "rad/s", "angular velocity predicted for the end of the step"),
    pose_position=Scratch(wp.vec3d, "joined", "m", "position at the start of the step, or predicted for its end"),
    pose_turn=Scratch(wp.quatd, "joined", "", "orientation at the start of the step, or predicted for its end"),
)

COLOR_WORDS = 8
"""Words of 32 colours in which the colours of a body are marked; later ones follow one another."""

VisitOrder = layout(
    "VisitOrder",
    "The pairs of mechanisms whose contacts are solved where the joints hold, colour by colour.",
    entries=Field(int, "visits", "", "their indices in `Order.entries`, colour by colour", "pairs"),
    end=Field(int, "visits", "", "from the first entry of an environment on: one past the last pair of each colour"),
    count=Field(int, "envs", "", "number of colours"),
    taken=Field(wp.uint32, f"joined, {COLOR_WORDS}", "", "bit masks of the colours of a body, or of its mechanism"),
)
