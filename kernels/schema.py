"""The data layout: every device array of the simulator, declared once.

A declaration states a field's element type, its symbolic shape, its unit and a description. From it follow the Warp
struct that kernels take as an argument, the arrays that `allocate` makes, the packing of records, slices of batches,
and the page of arrays in the documents. All environments lie one after another in the same arrays: the bodies of
environment `e` are rows `first_body[e]` to before `first_body[e + 1]`.
"""

import warp as wp

from warp_rigid.kernels.declare import Field, layout, packed_record, record

COLORS = 32
"""Colours of pairs; those of the last one are solved one after another."""

EXTREME_DIRECTIONS = 8
"""Directions in a patch's tangent plane whose furthest sample is kept."""

PATCHES = 4
"""Differently oriented touching regions that a pair of bodies can have at once."""

PATCH_SLOTS = EXTREME_DIRECTIONS + 1
"""Samples remembered a patch: the furthest each way, and the deepest."""

PAIR_SLOTS = PATCHES * PATCH_SLOTS
"""Samples remembered a pair before doubles are taken out."""

SYMBOLS = {
    "envs": "environments",
    "bodies": "bodies of all environments",
    "filtered": "bodies that a body never touches, over all bodies",
    "shapes": "shapes in the pool",
    "parts": "signed distance functions in the pool",
    "clusters": "sample clusters in the pool",
    "samples": "surface samples in the pool",
    "nodes": "grid nodes in the pool",
    "vertices": "vertices of moving height fields",
    "fields": "force fields besides gravity",
    "field_parameters": "parameters of the force field that has most",
    "small": "bodies in the hash grid",
    "oversized": "bodies outside the hash grid",
    "points": "bodies in the hash grid; 0 if every pair is tested",
    "buckets": "buckets of the hash grid, over all environments",
    "pairs": "capacity for pairs of bodies",
    "contacts": "capacity for contacts",
    "constraints": "capacity for pairs and for constraints of other kinds than contact",
}
"""What the symbols in the shapes of arrays count."""


PartRecord = record(
    "PartRecord",
    "One signed distance function of a shape.",
    kind=Field(int, "", "", "which function (distance.py)"),
    placed=Field(int, "", "", "0: its pose in the shape's frame is the identity"),
    position=Field(wp.vec3, "", "m", "its pose in the shape's frame"),
    orientation=Field(wp.quat, "", "", "its pose in the shape's frame"),
    size=Field(wp.vec4, "", "m", "dimensions, by its kind"),
    grid_start=Field(int, "", "", "first node of its grid"),
    grid_dims=Field(wp.vec3i, "", "", "nodes of its grid along x, y, z"),
    grid_origin=Field(wp.vec3, "", "m", "first node, in the part's frame"),
    grid_spacing=Field(float, "", "m", "distance between neighbouring nodes"),
)

ClusterRecord = record(
    "ClusterRecord",
    "A few neighbouring samples and the sphere that holds their reach.",
    center=Field(wp.vec3, "", "m", "centre of the sphere, in the shape's frame"),
    radius=Field(float, "", "m", "its radius"),
    kind=Field(int, "", "", "kind of its samples; rims go with points"),
    sample_start=Field(int, "", "", "first sample"),
    sample_end=Field(int, "", "", "one past the last"),
)

SampleRecord = record(
    "SampleRecord",
    "A place of the surface that is tested against other bodies.",
    point=Field(wp.vec3, "", "m", "in the shape's frame"),
    normal=Field(wp.vec3, "", "", "outward unit normal; zero for the centre of a ball"),
    slide=Field(wp.vec3, "", "m", "an edge sample may slide this far either way"),
    radius=Field(float, "", "m", "of a ball around the sample, or of a rim"),
    kind=Field(int, "", "", "point, edge, rim or face (narrowphase.py)"),
)

ShapeRecord = record(
    "ShapeRecord",
    "Where a shape's parts and clusters lie in the pool, and its box.",
    part_start=Field(int, "", "", "first part"),
    part_end=Field(int, "", "", "one past the last"),
    convex=Field(int, "", "", "1: one convex part with an exact distance"),
    cluster_start=Field(int, "", "", "first cluster"),
    cluster_end=Field(int, "", "", "one past the last"),
    lower=Field(wp.vec3, "", "m", "lower corner of the box"),
    upper=Field(wp.vec3, "", "m", "upper corner of the box"),
    size=Field(float, "", "m", "smallest extent of the box: contact tolerances scale with it"),
    rise=Field(float, "", "m/s", "largest speed of its surface relative to the body, 0 unless its ground moves"),
)

Shapes = layout(
    "Shapes",
    "The pool of shapes, shared by all environments. Records keep together what is read together.",
    shapes=Field(ShapeRecord, "shapes", "", "shapes"),
    parts=Field(PartRecord, "parts", "", "their signed distance functions"),
    clusters=Field(ClusterRecord, "clusters", "", "their sample clusters"),
    samples=Field(SampleRecord, "samples", "", "their surface samples"),
    grid_value=Field(float, "nodes", "m", "signed distance, or height, at a grid's node"),
)

Surfaces = layout(
    "Surfaces",
    "Vertices of the height fields that move, environment by environment; their nodes are the pool's last.",
    env=Field(int, "vertices", "", "environment of the vertex", "envs"),
    sample=Field(int, "vertices", "", "the sample at the vertex"),
    around=Field(wp.vec4i, "vertices", "", "steps to the neighbouring vertices: before and after along x, along y"),
    per_x=Field(float, "vertices", "1/m", "one over the distance of the neighbours along x"),
    per_y=Field(float, "vertices", "1/m", "one over the distance of the neighbours along y"),
    height=Field(float, "vertices", "m", "mean height"),
    amplitude=Field(float, "vertices", "m", "of the motion"),
    phase=Field(float, "vertices", "rad", "of the motion at time 0"),
    frequency=Field(float, "vertices", "rad/s", "of the motion"),
    rise=Field(float, "vertices", "m/s", "velocity over this step"),
    rise_before=Field(float, "vertices", "m/s", "velocity over the step before"),
)

Bodies = layout(
    "Bodies",
    "What a body is. Users may change masses and coefficients per environment.",
    env=Field(int, "bodies", "", "environment of the body", "envs"),
    shape=Field(int, "bodies", "", "index into the pool of shapes"),
    motion=Field(int, "bodies", "", "static, kinematic or dynamic"),
    oversized=Field(int, "bodies", "", "1: never in the hash grid, tested against every body of its environment"),
    mass=Field(float, "bodies", "kg", "mass; 0 unless dynamic"),
    inverse_mass=Field(float, "bodies", "1/kg", "0 unless dynamic"),
    inertia=Field(wp.mat33, "bodies", "kg m^2", "about the centre of mass, in the shape's frame"),
    inverse_inertia=Field(wp.mat33, "bodies", "1/(kg m^2)", "its inverse; 0 unless dynamic"),
    center_of_mass=Field(wp.vec3, "bodies", "m", "in the shape's frame"),
    friction=Field(float, "bodies", "", "Coulomb coefficient"),
    restitution=Field(float, "bodies", "", "coefficient of restitution"),
    rolling_friction=Field(float, "bodies", "m", "rolling torque limit divided by the normal force"),
    spinning_friction=Field(float, "bodies", "m", "spinning torque limit divided by the normal force"),
    filtered_start=Field(int, "bodies + 1", "", "first of the bodies that it never touches", "filtered"),
    filtered=Field(int, "filtered", "", "their numbers within the environment; every pair is listed both ways"),
)

State = layout(
    "State",
    "What a step changes and a user sees.",
    position=Field(wp.vec3, "bodies", "m", "origin of the shape's frame"),
    orientation=Field(wp.quat, "bodies", "", "of the shape's frame, (x, y, z, w)"),
    linear_velocity=Field(wp.vec3, "bodies", "m/s", "of the centre of mass"),
    angular_velocity=Field(wp.vec3, "bodies", "rad/s", "in the world frame"),
    force=Field(wp.vec3, "bodies", "N", "held by the user until changed, at the centre of mass"),
    torque=Field(wp.vec3, "bodies", "N m", "held by the user until changed"),
    active=Field(int, "bodies", "", "0: switched off, takes no part"),
    orientation_remainder=Field(wp.vec4, "bodies", "", "what rounding left over of the orientation"),
    angular_velocity_remainder=Field(wp.vec3, "bodies", "rad/s", "what rounding left over of the angular velocity"),
    shock_ineffective_steps=Field(int, "bodies", "", "steps in a row in which shock propagation was of no use to it"),
)

SolverBodyRecord = packed_record(
    "SolverBodyRecord",
    "A body as the solver sees it.",
    linear=Field(wp.vec3, "", "m/s", "velocity of the centre of mass in this step so far"),
    inverse_mass=Field(float, "", "1/kg", "0 unless dynamic"),
    angular=Field(wp.vec3, "", "rad/s", "angular velocity in this step so far"),
    inverse_inertia_xx=Field(wp.vec4, "", "1/(kg m^2)", "in the world: xx, xy, xz, yy"),
    inverse_inertia_yz=Field(wp.vec3, "", "1/(kg m^2)", "yz, zz, and nothing"),
    push_linear=Field(wp.vec3, "", "m/s", "pseudo-velocity of the push-out"),
    push_angular=Field(wp.vec3, "", "rad/s", "pseudo-velocity of the push-out"),
    start_linear=Field(wp.vec3, "", "m/s", "velocity before shock propagation"),
    start_angular=Field(wp.vec3, "", "rad/s", "velocity before shock propagation"),
    loaded_linear=Field(wp.vec3, "", "m/s", "velocity under the load of what lies on the body (shock.py)"),
    loaded_angular=Field(wp.vec3, "", "rad/s", "velocity under the load of what lies on the body"),
)

Motions = layout(
    "Motions",
    "What the first stage derives from the state for the rest of the step.",
    center=Field(wp.vec3, "bodies", "m", "centre of mass in the world"),
    solver_bodies=Field(SolverBodyRecord, "bodies", "", "what the solver changes"),
    is_finite=Field(int, "bodies", "", "1: its state was finite at the start of the step"),
    acceleration=Field(wp.vec3, "bodies", "m/s^2", "by gravity, fields and the held force"),
    spin_acceleration=Field(wp.vec3, "bodies", "rad/s^2", "by the held torque"),
    lower=Field(wp.vec3, "bodies", "m", "lower corner of the box swept in this step"),
    upper=Field(wp.vec3, "bodies", "m", "upper corner of the box swept in this step"),
    radius=Field(float, "bodies", "m", "of the sphere about the centre of mass that holds the body"),
    role=Field(int, "bodies", "", "part in this step: absent, fixed, asleep, driven or free"),
    max_travel=Field(float, "bodies", "m", "how far the body may move: other bodies are looked for so far around it"),
    time_of_impact=Field(float, "bodies", "", "part of the step's motion that nothing stops, as far as is known"),
    next_time_of_impact=Field(float, "bodies", "", "the same after the round at hand; the body moves by it"),
)

Environments = layout(
    "Environments",
    "Bodies, settings and status of each environment.",
    first_body=Field(int, "envs + 1", "", "first body of each environment, and the end of the last", "bodies"),
    gravity=Field(wp.vec3, "envs", "m/s^2", "uniform gravity"),
    collision_iterations=Field(int, "envs", "", "sweeps of the collision stage"),
    contact_iterations=Field(int, "envs", "", "sweeps of the contact stage"),
    shock_iterations=Field(int, "envs", "", "repetitions of shock propagation"),
    shock_propagation=Field(int, "envs", "", "off, one_pass or two_pass"),
    collision_first=Field(int, "envs", "", "1: collisions before the velocity update"),
    warm_starting=Field(int, "envs", "", "1: start from the last step's impulses"),
    edge_samples=Field(int, "envs", "", "1: edges take part in contact"),
    sleeping=Field(int, "envs", "", "1: bodies at rest fall asleep"),
    failed=Field(int, "envs", "", "1: a non-finite state was met, the environment is halted"),
    failed_step=Field(int, "envs", "", "step in which it was met"),
    failed_body=Field(int, "envs", "", "body in which it was met"),
    outside=Field(int, "envs", "", "1: a body has left the scene's bounds"),
    outside_step=Field(int, "envs", "", "step in which the first one did"),
    outside_body=Field(int, "envs", "", "body that did"),
    moving=Field(int, "envs", "", "1 + the last step in which a body was free or driven"),
    broken=Field(
        int, "envs", "", "rank of the first non-finite body in this step (integrate.find_non_finite); 0 if none"
    ),
    strayed=Field(int, "envs", "", "the same from the first one that left the bounds"),
    step=Field(int, "envs", "", "steps done"),
)

Cells = layout(
    "Cells",
    "Who looks for whom in the broad phase, and the hash grid in which they do.",
    small_start=Field(int, "envs + 1", "", "first small body of each environment, and the end of the last"),
    small=Field(int, "small", "", "bodies that enter the grid, by their numbers within the environment"),
    small_env=Field(int, "small", "", "their environments"),
    oversized_start=Field(int, "envs + 1", "", "first oversized body of each environment, and the end of the last"),
    oversized=Field(int, "oversized", "", "bodies tested against every body, by their numbers within the environment"),
    reach=Field(float, "envs", "m", "largest half-width of a small body's swept box, along any axis"),
    key=Field(int, "points + points", "", "bucket of each small body, in rising order; then room to sort"),
    member=Field(int, "points + points", "", "the bodies in the order of their buckets; then room to sort"),
    start=Field(int, "buckets + 1", "", "first member of each bucket; every environment has as many of its own"),
)

FieldForces = layout(
    "FieldForces",
    "Force fields besides gravity, the same in all environments.",
    kind=Field(int, "fields", "", "FieldKind"),
    parameters=Field(float, "fields, field_parameters", "SI", "attributes of the field's host class, in their order"),
)

Pairs = layout(
    "Pairs",
    "Pairs of bodies whose swept boxes overlap, listed by their first body, and the samples that touch.",
    count=Field(int, "bodies + 1", "", "pairs wanted by each first body"),
    start=Field(int, "bodies + 1", "", "first pair of each first body (exclusive sums of count)"),
    body_a=Field(int, "pairs", "", "first body"),
    body_b=Field(int, "pairs", "", "second body"),
    contact_count=Field(int, "pairs + 1", "", "contacts wanted by each pair"),
    contact_start=Field(int, "pairs + 1", "", "first contact of each pair (exclusive sums of contact_count)"),
    last=Field(int, "pairs", "", "the pair's row in the history, -1 if it is new; not of dormant pairs"),
    candidates=Field(int, "pairs", "", "pairs whose samples are searched in this step, in any order"),
    candidate_count=Field(int, "1", "", "how many they are"),
    patch_count=Field(int, "pairs", "", "patches in use"),
    patch_normal=Field(wp.vec3, f"pairs, {PATCHES}", "", "normal of a patch in the second body's frame"),
    dormant=Field(int, "pairs", "", "1 + the pair's row in the history if its bodies sleep, 0 if it was searched"),
    slot_score=Field(float, f"pairs, {PAIR_SLOTS}", "m", "how far out the remembered sample lies in its direction"),
    slot_gap=Field(float, f"pairs, {PAIR_SLOTS}", "m", "the gap that it is ranked by"),
    slot_key=Field(int, f"pairs, {PAIR_SLOTS}", "", "its identity: 2 * sample + side, -1 if the slot is empty"),
    kept=Field(int, f"pairs, {PAIR_SLOTS}", "", "identities of the samples that become contacts"),
    searched=Field(int, "pairs", "", "edge_samples + 1 at the last look for contacts; 0 if the next step must look"),
    searched_orientation=Field(wp.quat, "pairs", "", "relative orientation at that look"),
    searched_position=Field(wp.vec3, "pairs", "m", "relative position at that look"),
)

ContactRecord = packed_record(
    "ContactRecord",
    "What is fixed about a contact while it is solved. The normal points from the second body to the first.",
    normal=Field(wp.vec3, "", "", "unit normal in the world"),
    bias_velocity=Field(float, "", "m/s", "speed at which the bodies may still approach: the gap allows it"),
    tangent=Field(wp.vec3, "", "", "first unit tangent in the world; the second is normal x tangent"),
    friction=Field(float, "", "", "of the pair"),
    arm_a=Field(wp.vec3, "", "m", "from the first body's centre of mass"),
    gap=Field(float, "", "m", "distance at the start of the step, negative inside"),
    arm_b=Field(wp.vec3, "", "m", "from the second body's centre of mass"),
    more=Field(float, "", "", "0 if the members from `surface` on are 0"),
    tangent_a=Field(wp.vec3, "", "1/kg", "the first body's tangential inverse mass: 11, 12, 22"),
    normal_a=Field(float, "", "1/kg", "the first body's part of the inverse mass seen along the normal"),
    tangent_b=Field(wp.vec3, "", "1/kg", "the second body's"),
    normal_b=Field(float, "", "1/kg", "the second body's part"),
    coupling_a=Field(wp.vec2, "", "1/kg", "how a normal impulse moves the first body along the two tangents"),
    coupling_b=Field(wp.vec2, "", "1/kg", "the second body"),
    surface=Field(wp.vec3, "", "m/s", "the surfaces' own relative velocity, zero unless ground moves"),
    rolling_friction=Field(float, "", "m", "of the pair"),
    spinning_friction=Field(float, "", "m", "of the pair"),
    restitution=Field(float, "", "", "of the pair"),
)

ImpulseRecord = packed_record(
    "ImpulseRecord",
    "What a contact carries, as the solver changes it. Components are along the normal and the two tangents.",
    impulse=Field(wp.vec3, "", "N s", "accumulated impulse"),
    angular_impulse=Field(wp.vec3, "", "N m s", "accumulated angular impulse"),
    impact_impulse=Field(wp.vec3, "", "N s", "impulse of an impact, pseudo-impulse of the push-out"),
    target=Field(float, "", "m/s", "normal velocity that an impact or the push-out aims at"),
    start_impulse=Field(wp.vec3, "", "N s", "impulse before shock propagation"),
    start_angular_impulse=Field(wp.vec3, "", "N m s", "angular impulse before shock propagation"),
)

Contacts = layout(
    "Contacts",
    "Contact points. Records keep together what a visit of the solver reads together.",
    rows=Field(ContactRecord, "contacts", "", "what is fixed during the step"),
    impulses=Field(ImpulseRecord, "contacts", "", "what the solver changes"),
    pair=Field(int, "contacts", "", "the pair of bodies that touch"),
    key=Field(int, "contacts", "", "identity within the pair: 2 * sample + side"),
    position=Field(wp.vec3, "contacts", "m", "in the world"),
)

History = layout(
    "History",
    "Contacts of the last step, and those on which sleepers lie: for warm starting, and for pairs that hardly moved.",
    pair_start=Field(int, "bodies + 1", "", "first pair of each first body"),
    body_b=Field(int, "pairs", "", "second body"),
    contact_start=Field(int, "pairs + 1", "", "first contact of each pair"),
    searched=Field(int, "pairs", "", "as in Pairs"),
    searched_orientation=Field(wp.quat, "pairs", "", "as in Pairs"),
    searched_position=Field(wp.vec3, "pairs", "m", "as in Pairs"),
    key=Field(int, "contacts", "", "identity within the pair"),
    impulse=Field(wp.vec3, "contacts", "N s", "in the world frame"),
    angular_impulse=Field(wp.vec3, "contacts", "N m s", "in the world frame"),
    position=Field(wp.vec3, "contacts", "m", "in the world"),
    normal=Field(wp.vec3, "contacts", "", "unit normal in the world"),
    gap=Field(float, "contacts", "m", "distance, negative inside"),
)

SleepState = layout(
    "SleepState",
    "Who sleeps, and how long the others have kept still.",
    asleep=Field(int, "bodies", "", "1: at rest until something disturbs its island"),
    still_steps=Field(int, "bodies", "", "steps since the body last moved"),
    position=Field(wp.vec3, "bodies", "m", "pose from which its motion is measured; of a sleeper, the pose it has"),
    orientation=Field(wp.quat, "bodies", "", "the same"),
    force=Field(wp.vec3, "bodies", "N", "held force under which it fell asleep"),
    torque=Field(wp.vec3, "bodies", "N m", "held torque under which it fell asleep"),
    island=Field(int, "bodies", "", "of a sleeper: lowest body of those that fell asleep together"),
    level=Field(int, "bodies", "", "of a sleeper: its level in the contact graph"),
    disturbed=Field(int, "bodies", "", "1: changed from outside since the last step"),
    wake=Field(int, "bodies", "", "1: the sleeping island of this name wakes"),
    keeps_awake=Field(int, "bodies", "", "1: the island of this name has a body that is not ready to sleep"),
    supported=Field(int, "bodies", "", "1: the island of this name lies on something that does not move"),
)

Constraints = layout(
    "Constraints",
    "What ties two bodies together in this step: for each pair its contacts, then the constraints of other kinds.",
    start=Field(int, "envs + 1", "", "first constraint of each environment, and the end of the last"),
    start_before=Field(int, "envs + 1", "", "the same in the last step"),
    other_start=Field(int, "envs + 1", "", "constraints of other kinds than contact in the environments before"),
    kind=Field(int, "constraints", "", "kind of its rows (constraints/rows.py)"),
    body_a=Field(int, "constraints", "", "first body"),
    body_b=Field(int, "constraints", "", "second body"),
    first_row=Field(int, "constraints", "", "first row, among those of its kind"),
    row_count=Field(int, "constraints", "", "number of rows; 0: not active in this step"),
    last=Field(int, "constraints", "", "the same constraint in the last step, -1 if it is new"),
)

OrderRecord = packed_record(
    "OrderRecord",
    "An active constraint in the order of solving.",
    kind=Field(int, "", "", "kind of its rows"),
    body_a=Field(int, "", "", "first body"),
    body_b=Field(int, "", "", "second body"),
    begin=Field(int, "", "", "first row"),
    end=Field(int, "", "", "one past the last row"),
    upper_a=Field(int, "", "", "0: the first body is in a lower level than the second, 1: it is not"),
    upper_b=Field(int, "", "", "the same of the second body"),
    visited=Field(int, "", "", "turn in which impacts or shock propagation last solved it; 0 if not yet"),
)

Graph = layout(
    "Graph",
    "The contact graph: supports, levels, islands and colours, and what the stages of the solver pass on.",
    supports=Field(int, "constraints", "", "1: the second body supports the first, 2: the other way, 3: both"),
    supports_before=Field(int, "constraints", "", "the same in the last step; -1 for a constraint not active then"),
    active=Field(int, "envs", "", "active constraints"),
    active_before=Field(int, "envs", "", "1 + active constraints of the last step; 0: its graph is not available"),
    unchanged=Field(int, "envs", "", "1: the graph is that of the last step"),
    level=Field(int, "bodies", "", "0 for statics, else 1 + the highest support (cycles share a level)"),
    waiting=Field(int, "bodies", "", "of a cycle's name: 1 if a support of it has no level yet"),
    highest=Field(int, "bodies", "", "of a cycle's name: highest level among its supports that have one"),
    cycle=Field(int, "bodies", "", "name of its cycle, a body of it; its own while it is known to be in none"),
    within=Field(int, "bodies", "", "1: its cycle is known, which may be the body alone"),
    depth=Field(int, "bodies", "", "0 for statics, else 1 + the depth of the lowest support; 2^30 without any"),
    max_depth=Field(int, "envs", "", "greatest depth of a body that has one"),
    island=Field(int, "bodies", "", "lowest body among those connected through dynamic bodies"),
    numerator=Field(wp.int64, "bodies", "", "of an island's line search, in parts of `largest`"),
    denominator=Field(wp.int64, "bodies", "", "of an island's line search, in parts of `largest`"),
    largest=Field(float, "bodies", "J", "largest summand of either"),
    max_velocity_change=Field(float, "bodies", "m/s", "of an island: largest change by shock propagation"),
    ineffective_steps=Field(int, "bodies", "", "State.shock_ineffective_steps at the start of the step"),
    energy_terms=Field(wp.vec2, "constraints", "J", "summands of an active constraint, in the order of solving"),
    level_count=Field(int, "envs", "", "highest level of a body with an active constraint"),
    colors=Field(wp.uint32, "bodies", "", "bit mask of the colours taken at a body"),
    bid=Field(int, "bodies", "", "highest priority of the constraints that bid for a colour at a body"),
    color=Field(int, "constraints", "", "colour; -1 for a constraint that is not active or has none yet"),
    color_before=Field(int, "constraints", "", "the same in the last step"),
    tally=Field(int, f"envs, {COLORS}", "", "constraints of a colour, then where they go in the order"),
    support_count=Field(int, "bodies", "", "active constraints in which the body is not the lower one"),
    changed=Field(int, "bodies", "", "turn in which impacts or shock propagation last changed its velocity"),
    converged=Field(int, "envs", "", "1: the constraints are solved, shock propagation is not needed"),
    shock_ineffective=Field(int, "envs", "", "1: shock propagation has been of no use to an island of it"),
    overlapping=Field(int, "envs", "", "1: something is to be pushed out"),
    sweeps=Field(int, "envs", "", "sweeps over the constraints in the last step"),
    shock_sweeps=Field(int, "envs", "", "sweeps of shock propagation in the last step"),
    push_out_sweeps=Field(int, "envs", "", "sweeps of the push-out in the last step"),
    residual=Field(float, "envs", "m/s", "largest change of a velocity by a row in the last sweep"),
    gate=Field(wp.uint32, "envs, 4", "", "barrier of teams of several blocks"),
)

Order = layout(
    "Order",
    "Active constraints in the order of solving, colour by colour.",
    entries=Field(OrderRecord, "constraints", "", "active constraints"),
    color_start=Field(int, f"envs, {COLORS + 1}", "", "first entry of a colour, and the end"),
    color_count=Field(int, "envs", "", "colours in use; 32 if some are solved one after another"),
)
