"""The data layout: every device array of the simulator, declared once.

A declaration states a field's element type, its symbolic shape, its unit and a description. From it follow the Warp
struct that kernels take as an argument, the arrays that `allocate` makes, the packing of records, slices of batches,
and the page of arrays in the documentation. All environments are stored consecutively in the same arrays: the bodies of
environment `e` are rows `first_body[e]` to `first_body[e + 1] - 1`.
"""

import math

import warp as wp

from warp_rigid.kernels.declare import (
    Field,
    Fixed,
    Lifetime,
    Remembered,
    Reused,
    Scratch,
    Setting,
    layout,
    packed_record,
)
from warp_rigid.kernels.enums import WarningKind
from warp_rigid.kernels.shape_arrays import ClusterRecord as ClusterRecord
from warp_rigid.kernels.shape_arrays import PartRecord as PartRecord
from warp_rigid.kernels.shape_arrays import SampleRecord as SampleRecord
from warp_rigid.kernels.shape_arrays import ShapeRecord as ShapeRecord
from warp_rigid.kernels.shape_arrays import Shapes as Shapes
from warp_rigid.kernels.shape_arrays import TreeRecord as TreeRecord
from warp_rigid.kernels.shape_arrays import TriangleRecord as TriangleRecord
from warp_rigid.kernels.symbols import SYMBOLS as SYMBOLS

BY_WARNING = wp.types.vector(length=len(WarningKind), dtype=wp.int32)

COLORS = 32
"""Maximum number of colours of the constraints; those of the last colour are solved serially."""

EXTREME_DIRECTIONS = 8
"""Directions in a patch's tangent plane in which the furthest sample is kept."""

PATCHES = 4
"""Maximum number of contact patches of different orientation for a pair of bodies."""

PATCH_SLOTS = EXTREME_DIRECTIONS + 1
"""Samples kept for each patch: the furthest in each direction, and the deepest."""

BALL_PLACES = 4
"""Maximum number of places where a ball touches a mesh at the same time."""

RIM_ARCS = 16
"""Number of arcs of a cylinder's rim, whose contact points with nonconvex shapes are searched for one by one."""

PAIR_SLOTS = PATCHES * PATCH_SLOTS
"""Samples kept for each pair before duplicates are removed."""

Surfaces = layout(
    "Surfaces",
    "Vertices of moving height fields, grouped by environment; their grid nodes are the last ones of the pool.",
    lifetime=Lifetime.SCENE,
    env=Field(int, "vertices", "", "environment of the vertex", "envs"),
    sample=Field(int, "vertices", "", "surface sample at the vertex"),
    around=Field(
        wp.vec4i, "vertices", "", "index offsets of the neighbouring vertices: previous and next along x, then along y"
    ),
    per_x=Field(float, "vertices", "1/m", "inverse distance between the neighbours along x"),
    per_y=Field(float, "vertices", "1/m", "inverse distance between the neighbours along y"),
    height=Field(float, "vertices", "m", "mean height"),
    amplitude=Field(float, "vertices", "m", "amplitude of the motion"),
    phase=Field(float, "vertices", "rad", "phase of the motion at time 0"),
    frequency=Field(float, "vertices", "rad/s", "angular frequency of the motion"),
    rise=Scratch(float, "vertices", "m/s", "mean vertical velocity over this step"),
    rise_before=Scratch(float, "vertices", "m/s", "mean vertical velocity over the previous step"),
)

Paths = layout(
    "Paths",
    "Kinematic bodies that follow a path, and the keyframes, which all environments of a scene share.",
    lifetime=Lifetime.SCENE,
    body=Field(int, "paths", "", "body that follows the path", "bodies"),
    first=Field(int, "paths", "", "first keyframe of the path"),
    count=Field(int, "paths", "", "number of its keyframes"),
    loop=Field(int, "paths", "", "1: the path starts again at its end"),
    time=Field(wp.float64, "keyframes", "s", "time of a keyframe"),
    position=Field(wp.vec3d, "keyframes", "m", "position of the origin of the shape's frame"),
    orientation=Field(wp.quatd, "keyframes", "", "orientation of the shape's frame"),
    turned=Field(wp.vec3d, "keyframes", "rad", "sum of the turns from the first keyframe to this one"),
)

Bodies = layout(
    "Bodies",
    "Properties of the bodies. Masses and coefficients can be changed for each environment.",
    lifetime=Lifetime.SETTING,
    env=Fixed(int, "bodies", "", "environment of the body", "envs"),
    shape=Fixed(int, "bodies", "", "index into the pool of shapes"),
    motion=Fixed(int, "bodies", "", "static, kinematic or dynamic"),
    mass=Field(float, "bodies", "kg", "mass; 0 unless dynamic"),
    inverse_mass=Field(float, "bodies", "1/kg", "inverse mass; 0 unless dynamic"),
    inertia=Field(wp.mat33, "bodies", "kg m^2", "inertia tensor about the centre of mass, in the shape's frame"),
    inverse_inertia=Field(wp.mat33, "bodies", "1/(kg m^2)", "inverse inertia tensor; 0 unless dynamic"),
    center_of_mass=Fixed(wp.vec3, "bodies", "m", "centre of mass in the shape's frame"),
    friction=Field(float, "bodies", "", "Coulomb coefficient"),
    restitution=Field(float, "bodies", "", "coefficient of restitution"),
    rolling_friction=Field(float, "bodies", "m", "rolling torque limit divided by the normal force"),
    spinning_friction=Field(float, "bodies", "m", "spinning torque limit divided by the normal force"),
    surface_velocity=Field(
        wp.vec3, "bodies", "m/s", "velocity with which the surface runs along the body, in the shape's frame"
    ),
    surface_angular_velocity=Field(
        wp.vec3, "bodies", "rad/s", "the same for a surface that turns about the origin of the shape's frame"
    ),
    filtered_start=Fixed(int, "bodies + 1", "", "first entry of the body's filtered pairs", "filtered"),
    filtered=Fixed(
        int,
        "filtered",
        "",
        "other body of a filtered pair, by its index within the environment; each pair is listed for both bodies",
    ),
)

State = layout(
    "State",
    "State of the bodies that a step changes and that users read and write.",
    lifetime=Lifetime.REMEMBERED,
    position=Field(wp.vec3, "bodies", "m", "position of the origin of the shape's frame"),
    orientation=Field(wp.quat, "bodies", "", "orientation of the shape's frame, (x, y, z, w)"),
    linear_velocity=Field(wp.vec3, "bodies", "m/s", "velocity of the centre of mass"),
    angular_velocity=Field(wp.vec3, "bodies", "rad/s", "angular velocity in the world frame"),
    force=Field(wp.vec3, "bodies", "N", "external force at the centre of mass, applied in every step until changed"),
    torque=Field(wp.vec3, "bodies", "N m", "external torque, applied in every step until changed"),
    active=Field(int, "bodies", "", "0: switched off, not simulated"),
    orientation_remainder=Field(wp.vec4, "bodies", "", "rounding error of the orientation"),
    angular_velocity_remainder=Field(wp.vec3, "bodies", "rad/s", "rounding error of the angular velocity"),
    flight_steps=Field(int, "bodies", "", "steps in free flight; 0 in contact"),
    fallen=Field(int, "bodies", "", "1: the body was in free flight at some time"),
    health=Field(
        wp.vec4d,
        "bodies",
        "",
        "kinetic energy gained without work [J], for a kinematic body 1 if it moved; and at the last health check: "
        "kinetic energy [J], deep overlap [m], number of checks in which that did not shrink",
    ),
)

SolverBodyRecord = packed_record(
    "SolverBodyRecord",
    "Solver state of a body.",
    linear=Field(wp.vec3, "", "m/s", "current velocity of the centre of mass"),
    inverse_mass=Field(float, "", "1/kg", "inverse mass; 0 unless dynamic"),
    angular=Field(wp.vec3, "", "rad/s", "current angular velocity"),
    inverse_inertia_xx=Field(wp.vec4, "", "1/(kg m^2)", "inverse inertia tensor in the world frame: xx, xy, xz, yy"),
    inverse_inertia_yz=Field(
        wp.vec3, "", "1/(kg m^2)", "inverse inertia tensor in the world frame: yz, zz; the third component is unused"
    ),
    push_linear=Field(wp.vec3, "", "m/s", "linear pseudo-velocity of the push-out"),
    push_angular=Field(wp.vec3, "", "rad/s", "angular pseudo-velocity of the push-out"),
    start_linear=Field(wp.vec3, "", "m/s", "velocity before shock propagation"),
    start_angular=Field(wp.vec3, "", "rad/s", "angular velocity before shock propagation"),
    loaded_linear=Field(wp.vec3, "", "m/s", "velocity under the load of the bodies above (shock.py)"),
    loaded_angular=Field(wp.vec3, "", "rad/s", "angular velocity under the load of the bodies above"),
    before_contacts_linear=Field(wp.vec3, "", "m/s", "velocity before the contact solver"),
    before_contacts_angular=Field(wp.vec3, "", "rad/s", "angular velocity before the contact solver"),
)

Motions = layout(
    "Motions",
    "Quantities that the prediction stage derives from the state.",
    center=Field(wp.vec3, "bodies", "m", "centre of mass in the world frame"),
    solver_bodies=Field(SolverBodyRecord, "bodies", "", "solver state of each body"),
    is_finite=Field(int, "bodies", "", "1: the state was finite at the start of the step"),
    acceleration=Field(wp.vec3, "bodies", "m/s^2", "acceleration by gravity, force fields and the external force"),
    spin_acceleration=Field(wp.vec3, "bodies", "rad/s^2", "angular acceleration by the external torque"),
    velocity_unit=Field(
        float, "bodies", "m/s", "unit of the solvers' tolerances, the same in an environment (predict.py)"
    ),
    lower=Field(wp.vec3, "bodies", "m", "lower corner of the swept bounding box of this step"),
    upper=Field(wp.vec3, "bodies", "m", "upper corner of the swept bounding box of this step"),
    radius=Field(float, "bodies", "m", "radius of the bounding sphere about the centre of mass"),
    role=Field(int, "bodies", "", "role in this step: absent, static, asleep, kinematic or free"),
    max_travel=Field(float, "bodies", "m", "largest displacement covered by the broad phase; limits the motion"),
    time_of_impact=Field(float, "bodies", "", "fraction of the step after the impacts of the last iteration (ccd.py)"),
    next_time_of_impact=Field(
        float, "bodies", "", "after the this iteration; the body rotates freely for this fraction of the step"
    ),
    course=Field(wp.vec3, "bodies", "m/s", "mean velocity over the step after the impacts of the last iteration"),
    next_course=Field(wp.vec3, "bodies", "m/s", "mean velocity over the step after the impacts of the this iteration"),
    shared_spin=Field(
        wp.vec3, "bodies", "rad/s", "mean rotation with bodies that were hit, after the impacts of the last iteration"
    ),
    next_shared_spin=Field(wp.vec3, "bodies", "rad/s", "the same after the impacts of the this iteration"),
    onward=Field(wp.vec3, "bodies", "m/s", "mean velocity with which the body's mechanism would move on"),
    carried=Field(
        int,
        "bodies",
        "",
        "not 0: moved by a kinematic body, or held by an immovable one, after an impact in this step; see `lead_of`",
    ),
    next_carried=Field(int, "bodies", "", "the same after the impacts of the this iteration"),
    joined=Field(int, "bodies", "", "1: the body stops together with others of its mechanism"),
    first_impact=Field(wp.int64, "bodies", "", "time and pair of the first impact of the this iteration (ccd.py)"),
    course_change=Field(wp.vec3, "bodies", "m/s", "change of the mean velocity by the last iteration"),
    spin_change=Field(wp.vec3, "bodies", "rad/s", "change of the mean angular velocity by the last iteration"),
    changed=Field(int, "bodies", "", "1: the motion was changed by an impact of the last iteration"),
    overlap=Field(float, "bodies", "m", "deepest of the deep overlaps, in a health check"),
)

Environments = layout(
    "Environments",
    "Bodies, rules, settings and status of each environment.",
    lifetime=Lifetime.REMEMBERED,
    first_body=Fixed(int, "envs + 1", "", "first body of each environment, then the number of bodies", "bodies"),
    friction_rule=Fixed(int, "envs", "", "a CombineRule, of the friction coefficients of a pair"),
    restitution_rule=Fixed(int, "envs", "", "a CombineRule, of the coefficients of restitution of a pair"),
    out_of_bounds=Fixed(int, "envs", "", "an OutOfBounds: what happens to a body that leaves the bounds"),
    ccd_iterations=Fixed(int, "envs", "", "iterations of continuous collision detection"),
    lower=Fixed(wp.vec3, "envs", "m", "lower corner of the bounds"),
    upper=Fixed(wp.vec3, "envs", "m", "upper corner of the bounds"),
    gravity=Setting(wp.vec3, "envs", "m/s^2", "uniform gravity"),
    collision_iterations=Setting(int, "envs", "", "maximum sweeps of the restitution stage"),
    contact_iterations=Setting(int, "envs", "", "sweeps of the contact solver (gauss_seidel.py)"),
    shock_iterations=Setting(int, "envs", "", "repetitions of shock propagation"),
    shock_propagation=Setting(int, "envs", "", "a ShockMode: off, one_pass or two_pass"),
    collision_first=Setting(int, "envs", "", "1: restitution is solved before the velocity update"),
    warm_starting=Setting(int, "envs", "", "1: the solver starts from the impulses of the last step"),
    edge_samples=Setting(int, "envs", "", "1: edge samples are used in contact detection"),
    sleeping=Setting(int, "envs", "", "1: bodies at rest are put to sleep"),
    failed=Field(int, "envs", "", "1: a non-finite state was found, the environment is halted"),
    failed_step=Field(int, "envs", "", "step in which it was found"),
    failed_body=Field(int, "envs", "", "body in which it was found"),
    outside=Field(int, "envs", "", "1: a body has left the scene's bounds"),
    outside_step=Field(int, "envs", "", "step in which the first body left the bounds"),
    outside_body=Field(int, "envs", "", "first body that left the bounds"),
    moving=Field(int, "envs", "", "1 + the last step in which a body was free or kinematic"),
    broken=Field(
        int, "envs", "", "rank of the first non-finite body in this step (integrate.find_non_finite); 0 if none"
    ),
    strayed=Field(int, "envs", "", "rank of the first body that left the bounds in this step; 0 if none"),
    driven=Remembered(int, "envs", "", "1: a joint has stored or given energy at the last check"),
    health=Field(
        wp.vec2d, "envs", "J", "least sum of the energies gained without work, and recent largest kinetic energy"
    ),
    stuck=Field(int, "envs", "", "rank of the first body whose overlap does not shrink; 0 outside a health check"),
    coarse=Field(int, "envs", "", "the same for a body whose position is coarse"),
    overloaded=Field(int, "envs", "", "the same for a body with a load that is too heavy"),
    recent_residual=Remembered(float, "envs", "m/s", "largest residual of the last steps, halved in each step"),
    unsolved=Remembered(int, "envs", "", "number of the last checks that found a large residual"),
    warned_step=Field(BY_WARNING, "envs", "", "for each WarningKind the step of the first warning, 0 if there is none"),
    warned_body=Field(BY_WARNING, "envs", "", "bodies of these warnings"),
    step=Field(int, "envs", "", "number of completed steps"),
)

Cells = layout(
    "Cells",
    "The order of bodies for the broad phase and, in large environments, their fat boxes, hash grid and candidates.",
    lifetime=Lifetime.REUSED,
    order=Fixed(int, "bodies", "", "bodies of an environment in the order of pairs, by their index within it"),
    rank=Fixed(int, "bodies", "", "place of each body in that order"),
    listed=Field(int, "bodies", "", "number of candidates in the list of each body; -1: all later bodies", start=-1),
    stale=Scratch(int, "envs", "", "1: the candidates are computed again in this step"),
    width=Fixed(float, "envs", "m", "cell width at the lowest level of the grid"),
    first_bucket=Fixed(int, "envs + 1", "", "first bucket of each environment, which has none or a power of two"),
    levels=Scratch(int, "envs", "", "bit mask of the levels of the grid that have bodies"),
    dynamic_levels=Scratch(int, "envs", "", "bit mask of the levels that have dynamic bodies"),
    lower=Field(wp.vec3, "boxed", "m", "lower corner of the fat box", start=math.inf),
    upper=Field(wp.vec3, "boxed", "m", "upper corner of the fat box"),
    cell=Field(wp.vec4i, "boxed", "", "cell of the centre of the fat box, along x, y and z, and its level"),
    bucket_count=Field(int, "buckets + 1", "", "bodies that are still to be entered in each bucket", start=0),
    bucket_start=Field(int, "buckets + 1", "", "first member of each bucket"),
    member=Field(int, "boxed", "", "bodies by bucket, in any order within one"),
    candidates=Field(int, "candidates", "", "lists of equal capacity of the candidates of each body, in that order"),
)

FieldForces = layout(
    "FieldForces",
    "Force fields besides gravity. Their parameters can be changed for each environment.",
    start=Fixed(int, "envs + 1", "", "first force field of each environment", "fields"),
    kind=Fixed(int, "fields", "", "a FieldKind"),
    parameters=Setting(
        float, "fields, field_parameters", "SI", "attributes of the host class, in order of declaration"
    ),
)

SlotRecord = packed_record(
    "SlotRecord",
    "The sample of a patch that is furthest in a direction of its tangent plane, or will be deepest.",
    place=Field(int, "", "", "place of the sample in the list of near samples, -1 if the slot is empty"),
    score=Field(float, "", "m", "extent of the sample in the slot's direction, less a part of its gap"),
    gap=Field(float, "", "m", "gap at the start of the step"),
    left=Field(float, "", "m", "gap at the end of the step if the bodies move on as before"),
)

Pairs = layout(
    "Pairs",
    "Pairs of bodies with overlapping swept boxes, sorted by first body, and their touching samples.",
    count=Field(int, "bodies + 1", "", "number of pairs of each first body"),
    start=Field(int, "bodies + 1", "", "first pair of each first body (exclusive sums of count)"),
    body_a=Field(int, "pairs", "", "first body"),
    body_b=Field(int, "pairs", "", "second body"),
    contact_count=Field(int, "pairs + 1", "", "number of contacts of each pair"),
    contact_start=Field(int, "pairs + 1", "", "first contact of each pair (exclusive sums of contact_count)"),
    last=Field(int, "pairs", "", "the pair's row in the history, -1 if it is new; not set for dormant pairs"),
    candidates=Field(int, "pairs", "", "pairs whose samples are tested in this step, in any order"),
    candidate_count=Field(int, "1", "", "number of candidates"),
    fast=Field(int, "pairs", "", "pairs that are traced by continuous collision detection, in any order"),
    fast_count=Field(int, "1", "", "number of these"),
    patch_count=Field(int, "pairs", "", "number of contact patches"),
    patch_normal=Field(wp.vec3, f"pairs, {PATCHES}", "", "normal of a patch in the second body's frame"),
    dormant=Field(int, "pairs", "", "1 + the pair's row in the history if its bodies sleep, 0 otherwise"),
    slots=Field(SlotRecord, f"pairs, {PAIR_SLOTS}", "", "samples that may become contacts, by patch and direction"),
    kept=Field(
        int,
        f"pairs, {PAIR_SLOTS}",
        "",
        "places of the samples that become contacts in the list of near samples; negative: identity of another contact",
    ),
    searched=Field(
        int,
        "pairs",
        "",
        "edge_samples + 1 at the last contact search; 0 if the next step must search again, as after one in motion",
    ),
    searched_orientation=Field(wp.quat, "pairs", "", "relative orientation at the last contact search"),
    searched_position=Field(wp.vec3, "pairs", "m", "relative position at the last contact search"),
    axis=Field(
        wp.vec3,
        "pairs",
        "",
        "last axis that separates two convex bodies or along which they touch, or the direction in which two others "
        "come apart, in the second body's frame, or 0",
    ),
)

ContactRecord = packed_record(
    "ContactRecord",
    "Constant data of a contact row during the solve. The normal points from the second body to the first.",
    normal=Field(wp.vec3, "", "", "unit normal in the world frame"),
    bias_velocity=Field(float, "", "m/s", "approach speed that is still allowed because of the gap"),
    tangent=Field(wp.vec3, "", "", "first unit tangent in the world frame; the second is normal x tangent"),
    friction=Field(float, "", "", "friction coefficient of the pair"),
    arm_a=Field(wp.vec3, "", "m", "contact point relative to the first body's centre of mass"),
    gap=Field(float, "", "m", "distance at the start of the step, negative for overlap"),
    arm_b=Field(wp.vec3, "", "m", "contact point relative to the second body's centre of mass"),
    more=Field(float, "", "", "0 if all members from `surface` on are 0"),
    tangent_a=Field(wp.vec3, "", "1/kg", "the first body's tangential inverse effective mass: entries 11, 12, 22"),
    normal_a=Field(float, "", "1/kg", "the first body's inverse effective mass along the normal"),
    tangent_b=Field(wp.vec3, "", "1/kg", "the second body's tangential inverse effective mass"),
    normal_b=Field(float, "", "1/kg", "the second body's inverse effective mass along the normal"),
    coupling_a=Field(wp.vec2, "", "1/kg", "the first body's tangential velocity change per unit normal impulse"),
    coupling_b=Field(wp.vec2, "", "1/kg", "the second body's tangential velocity change per unit normal impulse"),
    surface=Field(
        wp.vec3,
        "",
        "m/s",
        "relative velocity of the surfaces beyond that of the bodies; 0 unless these move, run or turn",
    ),
    rolling_friction=Field(float, "", "m", "rolling friction coefficient of the pair"),
    spinning_friction=Field(float, "", "m", "spinning friction coefficient of the pair"),
    restitution=Field(float, "", "", "coefficient of restitution of the pair"),
    surface_spin=Field(float, "", "rad/s", "relative spin of running surfaces about the normal"),
)

ImpulseRecord = packed_record(
    "ImpulseRecord",
    "Impulses of a contact row. Components are along the normal and the two tangents.",
    impulse=Field(wp.vec3, "", "N s", "accumulated impulse"),
    start_impulse=Field(wp.vec3, "", "N s", "impulse before shock propagation"),
    angular_impulse=Field(wp.vec3, "", "N m s", "accumulated angular impulse"),
    impact_impulse=Field(wp.vec3, "", "N s", "impulse of an impact, or pseudo-impulse of the push-out"),
    target=Field(float, "", "m/s", "target normal velocity of an impact or of the push-out"),
    start_angular_impulse=Field(wp.vec3, "", "N m s", "angular impulse before shock propagation"),
)

Contacts = layout(
    "Contacts",
    "Contact points. Values that the solver reads together are stored in one record.",
    rows=Field(ContactRecord, "contacts", "", "constant data of the rows"),
    impulses=Field(ImpulseRecord, "contacts", "", "impulses that the solver changes"),
    pair=Field(int, "contacts", "", "pair of bodies in contact"),
    key=Field(int, "contacts", "", "identity within the pair: 2 * sample + side"),
    position=Field(wp.vec3, "contacts", "m", "contact point in the world frame"),
    impact=Field(wp.vec3, "pairs", "N s", "impulse of all impacts of a pair in this step, on the first body"),
)

Watches = layout(
    "Watches",
    "What watches have recorded of an environment, one of its bodies, or a pair of them, since the last reset.",
    lifetime=Lifetime.REMEMBERED,
    first=Setting(int, "envs, watches", "", "first body by its index in the environment; -1: all bodies, -2: none"),
    second=Setting(int, "envs, watches", "", "second body by its index in the environment; -1: any body, -2: none"),
    peak=Field(float, "envs, watches", "N s", "largest impulse of a pair in a step"),
    total=Field(wp.float64, "envs, watches", "N s", "sum of the impulses over pairs and steps"),
    largest=Field(float, "envs, watches", "N s", "largest impulse of a pair in this step; 0 between steps"),
    sum=Field(wp.int64, "envs, watches", "", "sum of the impulses of this step, in multiples of 2^-40 `largest`"),
    overlap=Field(float, "envs, watches", "m", "largest overlap at a contact"),
    first_contact=Field(int, "envs, watches", "", "number of the first step with a contact; 0: none yet"),
    touching=Field(int, "envs, watches", "", "1: there was a contact in the last step"),
    impacts=Field(int, "envs, watches", "", "number of steps with a contact after one without"),
    moving_step=Field(int, "envs, watches", "", "number of the last step in which a body was not at rest"),
)

History = layout(
    "History",
    "Contacts of the last step and of sleeping bodies, for warm starting and for reuse where a pair has hardly moved.",
    lifetime=Lifetime.REMEMBERED,
    pair_start=Field(int, "bodies + 1", "", "first pair of each first body"),
    body_b=Field(int, "pairs", "", "second body"),
    contact_start=Field(int, "pairs + 1", "", "first contact of each pair"),
    searched=Field(int, "pairs", "", "as in Pairs"),
    searched_orientation=Field(wp.quat, "pairs", "", "as in Pairs"),
    searched_position=Field(wp.vec3, "pairs", "m", "as in Pairs"),
    axis=Field(wp.vec3, "pairs", "", "as in Pairs"),
    key=Field(int, "contacts", "", "identity within the pair"),
    impulse=Field(wp.vec3, "contacts", "N s", "impulse in the world frame"),
    angular_impulse=Field(wp.vec3, "contacts", "N m s", "angular impulse in the world frame"),
    position=Field(wp.vec3, "contacts", "m", "contact point in the world frame"),
    normal=Field(wp.vec3, "contacts", "", "unit normal in the world frame"),
    gap=Field(float, "contacts", "m", "distance, negative for overlap"),
)

SleepState = layout(
    "SleepState",
    "Sleep state of the bodies.",
    lifetime=Lifetime.REMEMBERED,
    asleep=Field(int, "bodies", "", "1: asleep until its island is disturbed"),
    still_steps=Field(int, "bodies", "", "consecutive steps in which the body has hardly moved"),
    position=Field(
        wp.vec3, "bodies", "m", "reference position for measuring motion; for a sleeping body, its position"
    ),
    orientation=Field(wp.quat, "bodies", "", "reference orientation; for a sleeping body, its orientation"),
    force=Field(wp.vec3, "bodies", "N", "external force when the body fell asleep"),
    torque=Field(wp.vec3, "bodies", "N m", "external torque when the body fell asleep"),
    island=Field(int, "bodies", "", "of a sleeping body: lowest body index of the island that fell asleep"),
    level=Field(int, "bodies", "", "of a sleeping body: its level in the contact graph"),
    disturbed=Field(int, "bodies", "", "1: changed by the user since the last step"),
    wake=Field(int, "bodies", "", "1: the sleeping island with this index is woken"),
    keeps_awake=Field(int, "bodies", "", "1: the island with this index has a body that is not ready to sleep"),
    supported=Field(int, "bodies", "", "1: the island with this index is in contact with a static body"),
)

Constraints = layout(
    "Constraints",
    "Constraints of this step: the contacts of each pair.",
    start=Field(int, "envs + 1", "", "first constraint of each environment; the last entry is their number"),
    start_before=Reused(int, "envs + 1", "", "`start` of the last step"),
    body_a=Field(int, "pairs", "", "first body"),
    body_b=Field(int, "pairs", "", "second body"),
    first_row=Field(int, "pairs", "", "first contact"),
    row_count=Field(int, "pairs", "", "number of contacts; 0: not active in this step"),
    row_count_before=Field(int, "pairs", "", "`row_count` of the last step"),
    last=Field(int, "pairs", "", "index of the same constraint in the last step, -1 if it is new"),
)

OrderRecord = packed_record(
    "OrderRecord",
    "An active constraint in solving order.",
    body_a=Field(int, "", "", "first body"),
    body_b=Field(int, "", "", "second body"),
    begin=Field(int, "", "", "first row"),
    end=Field(int, "", "", "one past the last row"),
    upper_a=Field(int, "", "", "0: the first body has a lower level than the second, 1: it has not"),
    upper_b=Field(int, "", "", "0: the second body has a lower level than the first, 1: it has not"),
    visited=Field(
        int,
        "",
        "",
        "colour visit in which restitution or shock propagation last solved it; 0: none yet, from SKIPPED on: none",
    ),
)

Graph = layout(
    "Graph",
    "The contact graph: supports, levels, islands and colours, and data that the solver stages share.",
    lifetime=Lifetime.REUSED,
    supports=Field(
        int, "pairs", "", "bit mask: 1 if the second body supports the first, 2 if the first supports the second"
    ),
    supports_before=Field(int, "pairs", "", "`supports` of the last step"),
    active=Field(int, "envs", "", "number of active constraints"),
    active_before=Field(
        int, "envs", "", "1 + number of active constraints of the last step; 0: its graph is not available", start=0
    ),
    altered=Field(int, "envs", "", "1: the rows or supports of a constraint differ from those of the last step"),
    unchanged=Field(
        int, "envs", "", "1: the graph, and the islands that are solved in rounds, are the same as in the last step"
    ),
    touching=Field(int, "bodies", "", "active constraints of the body"),
    tied=Field(int, "bodies", "", "1: the body has a joint"),
    island_bodies=Field(int, "bodies", "", "at an island's index: number of its bodies"),
    island_pairs=Field(
        int, "bodies", "", "at an island's index: its constraints, those between two of its bodies counted twice"
    ),
    needs_sweeps=Field(int, "bodies", "", "at an island's index: 1 if it cannot be solved in rounds"),
    solver=Field(int, "bodies", "", "an IslandSolver: how the body's island is solved; 0 for bodies without an island"),
    swept=Field(int, "envs", "", "1: at least one island with constraints is solved in sweeps"),
    sweeps_per_level=Field(
        int, "envs", "", "maximum sweeps of shock propagation for each level; 0: no island is solved with it"
    ),
    level=Remembered(
        int, "bodies", "", "0 for statics, else 1 + the highest level of the supports; bodies of a cycle share a level"
    ),
    waiting=Field(int, "bodies", "", "at a cycle's index: 1 if one of its supports has no level yet"),
    highest=Field(int, "bodies", "", "at a cycle's index: highest known level of its supports"),
    cycle=Field(
        int,
        "bodies",
        "",
        "index of the body's cycle, one of the bodies in it; the body itself if it is in no known cycle",
    ),
    within=Field(int, "bodies", "", "1: the body's cycle is known; it may consist of this body alone"),
    depth=Field(int, "bodies", "", "0 for statics, else 1 + the smallest depth of the supports; 2^30 if unsupported"),
    max_depth=Field(int, "envs", "", "largest depth of the supported bodies"),
    island=Field(int, "bodies", "", "lowest body index among the bodies connected through dynamic bodies"),
    numerator=Field(wp.int64, "bodies", "", "numerator of an island's line search, in multiples of 2^-40 `largest`"),
    denominator=Field(
        wp.int64, "bodies", "", "denominator of an island's line search, in multiples of 2^-40 `largest`"
    ),
    largest=Field(float, "bodies", "J", "largest summand of the numerator and denominator"),
    accepted=Field(float, "bodies", "", "share of shock propagation accepted by the line search of the body's island"),
    bouncing_votes=Field(int, "bodies", "", "at an island's index: bodies with restitution"),
    fallen_votes=Field(int, "bodies", "", "at an island's index: bodies that were in free flight at some time"),
    island_mass=Field(float, "bodies", "kg", "at an island's index: largest mass of a body"),
    island_inverse_mass=Field(float, "bodies", "1/kg", "at an island's index: largest inverse mass of a body"),
    island_size=Field(float, "bodies", "m", "at an island's index: largest size of a body"),
    island_low=Field(float, "bodies", "m", "at an island's index: largest coordinate of a body along gravity"),
    island_high=Field(float, "bodies", "m", "at an island's index: largest coordinate of a body against gravity"),
    island_speed=Field(float, "bodies", "1/s", "at an island's index: largest speed of a body, divided by its size"),
    energy_terms=Field(
        wp.vec2, "pairs", "J", "summands of the line search of each active constraint, in solving order"
    ),
    level_count=Remembered(int, "envs", "", "highest level of a body with an active constraint"),
    colors=Field(wp.uint32, "bodies", "", "bit mask of the colours used at a body"),
    bid=Field(wp.int64, "bodies", "", "highest priority of the constraints that bid for a colour at a body"),
    color=Field(int, "pairs", "", "colour; -1 for a constraint that is not active or not coloured yet"),
    color_before=Field(int, "pairs", "", "`color` of the last step"),
    tally=Field(int, f"envs, {COLORS}", "", "constraints of a colour, then the next free place of the colour"),
    support_count=Field(int, "bodies", "", "active constraints in which the body is not the lower one"),
    changed=Field(
        int, "bodies", "", "colour visit in which restitution or shock propagation last changed the velocity"
    ),
    converged=Field(int, "envs", "", "1: the solver has converged, shock propagation is not needed"),
    pressed=Field(int, "bodies", "", "1: three contacts with a body below, not on a line, press (rest.py)"),
    stuck=Field(int, "bodies", "", "1: two contacts with a body below stick (rest.py)"),
    restless=Field(int, "bodies", "", "at an island's index: 1 if it is solved in rounds and not at rest (rest.py)"),
    resting=Field(int, "bodies", "", "at an island's index: 1 if it is stopped, without shock propagation (rest.py)"),
    overlapping=Field(int, "envs", "", "1: at least one contact needs push-out"),
    further_sweeps=Field(int, "bodies", "", "maximum sweeps with momentum of the body's island (calm.py)"),
    sweeps=Field(int, "envs", "", "solver sweeps in the last step"),
    impact_sweeps=Field(int, "envs", "", "sweeps with impacts in the last step"),
    impact_rounds=Field(int, "envs", "", "rounds with impacts in the last step"),
    shock_sweeps=Field(int, "envs", "", "sweeps of shock propagation in the last step"),
    push_out_sweeps=Field(int, "envs", "", "sweeps of the push-out in the last step"),
    rounds=Field(int, "envs", "", "rounds of the solver in the last step"),
    push_out_rounds=Field(int, "envs", "", "rounds of the push-out in the last step"),
    residual=Field(float, "envs", "m/s", "largest velocity change by a row in the last sweep or round"),
)

Order = layout(
    "Order",
    "Active constraints in solving order, colour by colour.",
    lifetime=Lifetime.REUSED,
    entries=Field(OrderRecord, "pairs", "", "active constraints"),
    color_start=Field(int, f"envs, {COLORS + 1}", "", "first entry of each colour, and the end of the last"),
    color_count=Field(int, "envs", "", "number of colours in use; 32 if some constraints are solved serially"),
)
