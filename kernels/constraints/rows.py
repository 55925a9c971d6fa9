"""Constraint rows of all kinds: the solver calls these functions, which dispatch to the functions of each kind.

A kind of constraint is a file beside this one. It declares its arrays and has a KIND and the device functions called
below; `contact` is the example. Kinds besides contacts also have what `OTHER_KINDS` states. CONTRIBUTING.md shows how
to add one.
"""

from types import ModuleType

import warp as wp

from warp_rigid.kernels.common.solver_body import BodyPair
from warp_rigid.kernels.constraints import contact
from warp_rigid.kernels.constraints.load_distribution import distribute_contact_load
from warp_rigid.kernels.schema import Contacts

wp.set_module_options({"enable_backward": False})

OTHER_KINDS: tuple[ModuleType, ...] = ()
"""Kinds besides contacts. Each module has the device functions called below, and

KIND: the number of the kind in `Constraints`, different for each kind;
NAME: of its member in `Rows`, and the symbol that counts its constraints in the shapes of its arrays;
ROWS: the layout of its arrays, among them `body_a` and `body_b` (with index_of="bodies"). Impulses for the warm start
are Remembered: a step leaves them to the next one, and a reset clears them;
`definitions(scene)`: the constraints of this kind in `scene.constraints`, a list;
`upload(scene, device)`: an instance of ROWS with the constraints of one environment, which the model copies to all
environments of the scene; raises a ValueError where a constraint does not fit the scene;
`build(stages, constraints, offset)`: launch a kernel of this module that writes the rows of a step, and for each
constraint its slot in `constraints` (`set_constraint` in constraints/records.py). `stages` is the Stages of the step,
with the arrays of all environments as `stages.model.constraint_rows[NAME]` and the number of their rows as
`stages.model.layout.sizes[NAME]`; `offset[env] + row` is the index of a row's constraint in `slot_of_other`.
"""


@wp.struct
class Rows:
    """The rows of all constraints, by kind."""

    contacts: Contacts


@wp.func
def solve_row(kind: int, row: int, share_a: float, share_b: float, pair: BodyPair, rows: Rows):
    """Solve one row for the velocities of a pair; a body whose share is 0 is frozen."""
    return contact.solve_row(row, share_a, share_b, pair, rows.contacts)


@wp.func
def distribute_load(kind: int, begin: int, end: int, rows: Rows):
    """Distribute the initial impulses of a pair's rows where statics does not determine them."""
    if kind == contact.KIND:
        distribute_contact_load(begin, end, rows.contacts)


@wp.func
def apply_row(kind: int, row: int, pair: BodyPair, rows: Rows):
    """The bodies after applying the initial impulse of a row (warm start)."""
    return contact.apply_row(row, pair, rows.contacts)


@wp.func
def direction_and_approach(kind: int, row: int, pair: BodyPair, rows: Rows):
    """Unit direction in which a row pushes the first body, and the approach speed along it [m/s]."""
    return contact.direction_and_approach(row, pair, rows.contacts)


@wp.func
def store_start(kind: int, row: int, rows: Rows):
    """Store the impulse at the start of the line search."""
    contact.store_start(row, rows.contacts)


@wp.func
def energy_terms(kind: int, row: int, then: BodyPair, now: BodyPair, rows: Rows):
    """Contribution of a row to the two sums of the line search [J]."""
    return contact.energy_terms(row, then, now, rows.contacts)


@wp.func
def blend_row(kind: int, row: int, t: float, rows: Rows):
    """Interpolate linearly from the stored start impulse (t = 0) to the current impulse (t = 1)."""
    contact.blend_row(row, t, rows.contacts)
