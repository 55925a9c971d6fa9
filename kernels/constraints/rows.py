"""Constraint rows of all kinds: the solver calls these functions, which dispatch to the functions of each kind.

Each kind of constraint is a module in this package. It declares its arrays, a KIND and the device functions called
below; see `contact` for an example. Kinds other than contacts also have the host functions listed at `OTHER_KINDS`.
"""

from types import ModuleType

import warp as wp

from warp_rigid.kernels.common.solver_body import BodyPair
from warp_rigid.kernels.constraints import contact
from warp_rigid.kernels.schema import Contacts

wp.set_module_options({"enable_backward": False})

OTHER_KINDS: tuple[ModuleType, ...] = ()
"""Kinds other than contacts. Each module has NAME, its member's name in `Rows`, ROWS, the layout of its arrays, and

`definitions(scene)`: the constraints of this kind in a scene;
`upload(scene, num_envs, device)`: its arrays, sized by the symbol NAME, environment by environment;
`build(arrays, constraints, model, state, motions, dt, device)`: launch the kernel that writes the rows and the
entries in `Constraints` (constraints/records.py) of a step.
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
