"""Records of the solver, read and written sixteen bytes at a time.

On a GPU a lane waits for memory most of the time, and a record read field by field takes four times as many requests.
So the records that a visit of the solver needs are declared in rows of four words (data.py), and read by such rows.
"""

from typing import Any

import warp as wp

from warp_rigid.kernels.schema import (
    FILLER,
    RECORDS,
    ContactRecord,
    Contacts,
    ImpulseRecord,
    Motions,
    PairRecord,
    SolverBodyRecord,
)

wp.set_module_options({"enable_backward": False})

READ = """
    const float* p = (const float*)__builtin_assume_aligned((const float*)(records.data + row) + 4 * k, 16);
    return wp::vec4(p[0], p[1], p[2], p[3]);
"""

READ_WHOLE_NUMBERS = """
    const int* p = (const int*)__builtin_assume_aligned((const int*)(records.data + row) + 4 * k, 16);
    return wp::vec_t<4, int>(p[0], p[1], p[2], p[3]);
"""

WRITE = """
    float* p = (float*)__builtin_assume_aligned((float*)(records.data + row) + 4 * k, 16);
    p[0] = xyz[0]; p[1] = xyz[1]; p[2] = xyz[2]; p[3] = w;
"""


def reader(record: Any) -> Any:
    """A function that reads the k-th four words of a record in an array."""

    @wp.func_native(READ)
    def quad(records: wp.array(dtype=record), row: int, k: int) -> wp.vec4: ...

    return quad


def writer(record: Any) -> Any:
    """A function that writes the k-th four words of a record in an array."""

    @wp.func_native(WRITE)
    def put_quad(records: wp.array(dtype=record), row: int, k: int, xyz: wp.vec3, w: float): ...

    return put_quad


@wp.func_native(READ_WHOLE_NUMBERS)
def pair_quad(records: wp.array(dtype=PairRecord), row: int, k: int) -> wp.vec4i:
    """The k-th four words of an entry of the order of solving."""
    ...


contact_quad = reader(ContactRecord)
put_contact_quad = writer(ContactRecord)
impulse_quad = reader(ImpulseRecord)
put_impulse_quad = writer(ImpulseRecord)
solver_body_quad = reader(SolverBodyRecord)
put_solver_body_quad = writer(SolverBodyRecord)


def optional_words() -> dict[str, int]:
    """Where the fields of ContactRecord from `surface` to before `body_a` lie: C++ expression of a word, and its index.

    These fields are zero in most contacts.
    """
    found, end, fields = {}, 0, RECORDS["ContactRecord"]
    names = list(fields)
    for name in names[: names.index("body_a")]:
        count = wp.types.type_size_in_bytes(fields[name].dtype) // 4
        if names.index(name) >= names.index("surface") and fields[name] is not FILLER:
            found |= {f"row.{name}" + (f"[{k}]" if count > 1 else ""): end + k for k in range(count)}
        end += count
    return found


OPTIONAL = optional_words()

RECORD_START = """
    float* p = (float*)__builtin_assume_aligned((float*)(records.data + c), 16);
"""

READ_OPTIONAL = f"""
    if (row.more != 0.0f) {{
        {RECORD_START}
        {" ".join(f"{member} = p[{word}];" for member, word in OPTIONAL.items())}
    }}
"""

WRITE_OPTIONAL = RECORD_START + " ".join(f"p[{word}] = {member};" for member, word in OPTIONAL.items())

ANY_OPTIONAL = f"return ({' || '.join(f'{member} != 0.0f' for member in OPTIONAL)}) ? 1.0f : 0.0f;"


@wp.func_native(READ_OPTIONAL)
def read_optional_fields(records: wp.array(dtype=ContactRecord), c: int, row: wp.ref[ContactRecord]):
    """Read the optional fields of a contact where `more` says that one of them is not zero."""
    ...


@wp.func_native(WRITE_OPTIONAL)
def put_optional_fields(records: wp.array(dtype=ContactRecord), c: int, row: ContactRecord):
    """Store the optional fields of a contact."""
    ...


@wp.func_native(ANY_OPTIONAL)
def any_optional_field(row: ContactRecord) -> float:
    """1 if an optional field of the contact is not zero, else 0."""
    ...


IMPULSE = wp.constant(0)
ANGULAR_IMPULSE = wp.constant(1)
IMPACT_IMPULSE = wp.constant(2)
START_IMPULSE = wp.constant(3)
START_ANGULAR_IMPULSE = wp.constant(4)
VELOCITY = wp.constant(0)
PUSH = wp.constant(4)
START = wp.constant(6)
LOADED = wp.constant(8)


@wp.func
def first_three(q: wp.vec4):
    """The vector in a row of four."""
    return wp.vec3(q[0], q[1], q[2])


@wp.func
def contact_row(c: int, contacts: Contacts):
    """Read what is fixed about a contact, except its bodies. Optional fields are read only where one is not zero."""
    row = ContactRecord()
    q = contact_quad(contacts.rows, c, 0)
    row.normal = first_three(q)
    row.bias_velocity = q[3]
    q = contact_quad(contacts.rows, c, 1)
    row.tangent = first_three(q)
    row.friction = q[3]
    q = contact_quad(contacts.rows, c, 2)
    row.arm_a = first_three(q)
    row.gap = q[3]
    q = contact_quad(contacts.rows, c, 3)
    row.arm_b = first_three(q)
    row.more = q[3]
    q = contact_quad(contacts.rows, c, 4)
    row.tangent_a = first_three(q)
    row.normal_a = q[3]
    q = contact_quad(contacts.rows, c, 5)
    row.tangent_b = first_three(q)
    row.normal_b = q[3]
    q = contact_quad(contacts.rows, c, 6)
    row.coupling_a = wp.vec2(q[0], q[1])
    row.coupling_b = wp.vec2(q[2], q[3])
    read_optional_fields(contacts.rows, c, row)
    return row


@wp.func
def put_contact_row(c: int, row: ContactRecord, contacts: Contacts):
    """Store what is fixed about a contact."""
    put_contact_quad(contacts.rows, c, 0, row.normal, row.bias_velocity)
    put_contact_quad(contacts.rows, c, 1, row.tangent, row.friction)
    put_contact_quad(contacts.rows, c, 2, row.arm_a, row.gap)
    put_contact_quad(contacts.rows, c, 3, row.arm_b, any_optional_field(row))
    put_contact_quad(contacts.rows, c, 4, row.tangent_a, row.normal_a)
    put_contact_quad(contacts.rows, c, 5, row.tangent_b, row.normal_b)
    coupling = wp.vec3(row.coupling_a[0], row.coupling_a[1], row.coupling_b[0])
    put_contact_quad(contacts.rows, c, 6, coupling, row.coupling_b[1])
    put_optional_fields(contacts.rows, c, row)
    contacts.rows[c].body_a = row.body_a
    contacts.rows[c].body_b = row.body_b


@wp.func
def impulse_of(c: int, which: int, contacts: Contacts):
    """One of the vectors that a contact carries, such as IMPULSE."""
    return first_three(impulse_quad(contacts.impulses, c, which))


@wp.func
def set_impulse(c: int, which: int, value: wp.vec3, contacts: Contacts):
    """Store one of the vectors that a contact carries."""
    put_impulse_quad(contacts.impulses, c, which, value, 0.0)


@wp.func
def set_target_impulse(c: int, impulse: wp.vec3, target: float, contacts: Contacts):
    """Store an impact's or the push-out's impulse, and the velocity that it aims at."""
    put_impulse_quad(contacts.impulses, c, IMPACT_IMPULSE, impulse, target)


@wp.func
def entry_at(k: int, order: wp.array(dtype=PairRecord)):
    """An entry of the order of solving."""
    entry = PairRecord()
    q = pair_quad(order, k, 0)
    entry.pair = q[0]
    entry.body_a = q[1]
    entry.body_b = q[2]
    entry.begin = q[3]
    q = pair_quad(order, k, 1)
    entry.end = q[0]
    entry.upper_a = q[1]
    entry.upper_b = q[2]
    entry.visited = q[3]
    return entry


@wp.func
def inverse_inertia_of(b: int, motions: Motions):
    """A body's inverse inertia tensor in the world."""
    q = solver_body_quad(motions.solver_bodies, b, 2)
    r = solver_body_quad(motions.solver_bodies, b, 3)
    return wp.mat33(q[0], q[1], q[2], q[1], q[3], r[0], q[2], r[0], r[1])


@wp.func
def store_velocity(b: int, which: int, linear: wp.vec3, angular: wp.vec3, motions: Motions):
    """Store one of a body's other velocities: PUSH, START or LOADED."""
    put_solver_body_quad(motions.solver_bodies, b, which, linear, 0.0)
    put_solver_body_quad(motions.solver_bodies, b, which + 1, angular, 0.0)
