"""Factorization of a mechanism: A = G M^-1 G^T = L D L^T, with a block of six rows and columns for each joint.

G are the rows of all joints of the mechanism, M the masses of its bodies. The order of elimination and the blocks of L
that are not zero are found on the host when the simulator is made. A pivot much smaller than the effective inverse mass
of its row belongs to a row that follows from the others, as in a closed loop. Its inverse is set to zero, so that the
row takes no impulse.

A team of lanes factorizes a mechanism. The lanes share all rows of A. Joints are eliminated one after another, and the
lanes share the rows of their blocks.
"""

import warp as wp

from warp_rigid.kernels.common.team import Team, sync_warp
from warp_rigid.kernels.joints.arrays import Joints, vec6d
from warp_rigid.kernels.joints.coordinate import Mode, damping_slope, drive_slope, is_held
from warp_rigid.kernels.joints.elements import (
    axis_row,
    block_times,
    column_of,
    component_of,
    entry_of,
    row_of,
    rows_times,
    set_component,
    set_entry,
    set_row,
)
from warp_rigid.kernels.joints.joint_rows import has_coordinate, is_damped, is_locked, present_rows
from warp_rigid.kernels.joints.poses import free_row
from warp_rigid.kernels.schema import Motions

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def active_rows(j: int, dt: float, motions: Motions, joints: Joints):
    """Rows of a joint that take part in the factorization: the locked ones, and others unless they are free."""
    rows = present_rows(j, motions, joints)
    if has_coordinate(j, motions, joints):
        if is_held(joints.mode[j]) or drive_slope(j, wp.float64(dt), joints) > wp.float64(0.0):
            rows = rows | (1 << free_row(joints.coordinate[j]))
        for k in range(4, 6):
            if is_damped(j, k, joints) and joints.mode[j][0] != Mode.IDLE:
                rows = rows | (1 << k)
    return rows


@wp.func
def masked(values: vec6d, active: int):
    """The components of active rows; zero for the others."""
    for k in range(6):
        if not is_locked(active, k):
            values[k] = wp.float64(0.0)
    return values


@wp.func
def coupling_row(j: int, i: int, k: int, a: int, b: int, joints: Joints):
    """Velocity along row i of joint j for unit impulses along the rows of joint k, through their common bodies.

    These are a and b; -1 for none.
    """
    total = vec6d()
    body = int(a)
    side = int(0)
    while side < 2:
        if body >= 0:
            total += coupling_through(body, j, i, k, joints)
        body = b
        side += 1
    return total


@wp.func
def coupling_through(b: int, j: int, i: int, k: int, joints: Joints):
    """As `coupling_row`, through one body."""
    if not is_locked(joints.active[j], i):
        return vec6d()
    push = joints.inverse_mass[b] * axis_row(joints.linear, j, i)
    spin = joints.inverse_inertia[b] * side_row(j, i, b, joints)
    if (joints.body_a[j] == b) != (joints.body_a[k] == b):
        push = -push
    turning = vec6d()
    if joints.body_a[k] != b:
        turning = rows_times(joints.angular_b, k, spin)
    else:
        turning = rows_times(joints.angular_a, k, spin)
    return masked(rows_times(joints.linear, k, push) + turning, joints.active[k])


@wp.func
def side_row(j: int, i: int, b: int, joints: Joints):
    """Coefficients of the angular velocity of one of a joint's bodies in a row."""
    if joints.body_a[j] == b:
        return axis_row(joints.angular_a, j, i)
    return axis_row(joints.angular_b, j, i)


@wp.func
def compliance_of(j: int, k: int, dt: float, joints: Joints):
    """Velocity along an active row per impulse of a drive or of damping; 0 for a row that holds."""
    step = wp.float64(dt)
    if k == free_row(joints.coordinate[j]) and not is_held(joints.mode[j]):
        return wp.float64(1.0) / drive_slope(j, step, joints)
    if is_damped(j, k, joints):
        return wp.float64(1.0) / damping_slope(j, step, joints)
    return wp.float64(0.0)


@wp.func
def diagonal_entry(j: int, i: int, row: vec6d, dt: float, joints: Joints):
    """Entry on the diagonal of A, with the compliance of the row; 1 for one that is not active."""
    if not is_locked(joints.active[j], i):
        return wp.float64(1.0)
    return row[i] + compliance_of(j, i, dt, joints)


@wp.func
def assemble_row(place: int, i: int, dt: float, joints: Joints):
    """Row i of the blocks of A in the column of the joint at a place of the sequence.

    `solution` gets the inverse of the entry on the diagonal.
    """
    j = joints.sequence[place]
    row = coupling_row(j, i, j, joints.body_a[j], wp.where(joints.to_world[j] == 0, joints.body_b[j], -1), joints)
    entry = diagonal_entry(j, i, row, dt, joints)
    set_row(joints.pivot, j, i, row)
    set_entry(joints.pivot, j, i, i, entry)
    set_component(joints.solution, j, 0, i, wp.where(entry > wp.float64(0.0), wp.float64(1.0) / entry, wp.float64(0.0)))
    for e in range(joints.column[place], joints.column[place + 1]):
        k = joints.row[e]
        set_row(joints.lower, e, i, coupling_row(k, i, j, joints.shared[e], joints.shared_too[e], joints))


@wp.func
def largest_pivot(j: int, left: int, joints: Joints):
    """Row, of those that are left, with the largest pivot as a fraction of its diagonal entry; -1 if all are too small.

    `solution` holds the inverses of the diagonal entries.
    """
    best = int(-1)
    # A row is redundant below this fraction.
    most = wp.float64(1.0e-8)
    for k in range(6):
        if is_locked(left, k):
            share = entry_of(joints.pivot, j, k, k) * component_of(joints.solution, j, 0, k)
            if share > most:
                most = share
                best = k
    return best


@wp.func
def sweep_out(k: int, j: int, team: Team, joints: Joints):
    """Apply the sweep operator for a row to a symmetric block: swept rows hold the negative of their inverse."""
    inverse = wp.float64(1.0) / entry_of(joints.pivot, j, k, k)
    row = row_of(joints.pivot, j, k)
    sync_warp(team.lanes)
    for i in range(team.lane, 6, team.lanes):
        if i == k:
            set_entry(joints.pivot, j, k, k, -inverse)
        else:
            factor = entry_of(joints.pivot, j, i, k) * inverse
            set_row(joints.pivot, j, i, row_of(joints.pivot, j, i) - factor * row)
            set_entry(joints.pivot, j, i, k, factor)
            set_entry(joints.pivot, j, k, i, factor)
    sync_warp(team.lanes)


@wp.func
def invert_without_redundant(j: int, team: Team, joints: Joints):
    """Invert the block of a joint, largest pivots first; zero in rows that are not active or have too small pivots."""
    left = int(joints.active[j])
    row = int(0)
    while row >= 0:
        row = largest_pivot(j, left, joints)
        if row >= 0:
            sweep_out(row, j, team, joints)
            left = left & ~(1 << row)
    sync_warp(team.lanes)
    taken = joints.active[j] & ~left
    for i in range(team.lane, 6, team.lanes):
        for k in range(6):
            is_taken = is_locked(taken, i) and is_locked(taken, k)
            set_entry(joints.pivot, j, i, k, wp.where(is_taken, -entry_of(joints.pivot, j, i, k), wp.float64(0.0)))
    sync_warp(team.lanes)


@wp.func
def factor_row(e: int, i: int, j: int, joints: Joints):
    """Row of the product of a block below the diagonal and the inverse, which is symmetric, of joint j."""
    return block_times(joints.pivot, j, row_of(joints.lower, e, i))


@wp.func
def eliminate(place: int, team: Team, joints: Joints):
    """Eliminate the joint at a place of the sequence."""
    j = joints.sequence[place]
    invert_without_redundant(j, team, joints)
    for i in range(team.lane, 6, team.lanes):
        for u in range(joints.elimination[place], joints.elimination[place + 1]):
            change = block_times(joints.lower, joints.right[u], factor_row(joints.left[u], i, j, joints))
            target = joints.target[u]
            set_row(joints.lower, target, i, row_of(joints.lower, target, i) - change)
        for e in range(joints.column[place], joints.column[place + 1]):
            k = joints.row[e]
            change = block_times(joints.lower, e, factor_row(e, i, j, joints))
            set_row(joints.pivot, k, i, row_of(joints.pivot, k, i) - change)
    sync_warp(team.lanes)
    for i in range(team.lane, 6, team.lanes):
        for e in range(joints.column[place], joints.column[place + 1]):
            set_row(joints.lower, e, i, factor_row(e, i, j, joints))
    sync_warp(team.lanes)


@wp.func
def factorize(m: int, dt: float, team: Team, motions: Motions, joints: Joints):
    """Factorize a mechanism with the rows that are active in the present modes."""
    first = joints.first_place[m]
    end = joints.first_place[m + 1]
    for place in range(first + team.lane, end, team.lanes):
        j = joints.sequence[place]
        joints.active[j] = active_rows(j, dt, motions, joints)
    sync_warp(team.lanes)
    for k in range(team.lane, 6 * (end - first), team.lanes):
        assemble_row(first + k / 6, k % 6, dt, joints)
    sync_warp(team.lanes)
    for place in range(first, end):
        eliminate(place, team, joints)
    if team.lane == 0:
        joints.factorizations[m] = joints.factorizations[m] + 1
    sync_warp(team.lanes)


@wp.func
def substitute(m: int, column: int, team: Team, joints: Joints):
    """Replace the right-hand side in a column of `solution` by the solution."""
    first = joints.first_place[m]
    end = joints.first_place[m + 1]
    for place in range(first, end):
        j = joints.sequence[place]
        known = joints.solution[j, column]
        # An impulse on a single body leaves most joints with zeros here.
        if not (known == vec6d()):
            sync_warp(team.lanes)
            for i in range(team.lane, 6, team.lanes):
                for e in range(joints.column[place], joints.column[place + 1]):
                    k = joints.row[e]
                    change = wp.dot(row_of(joints.lower, e, i), known)
                    set_component(joints.solution, k, column, i, component_of(joints.solution, k, column, i) - change)
                set_component(joints.solution, j, column, i, wp.dot(row_of(joints.pivot, j, i), known))
            sync_warp(team.lanes)
    for back in range(end - first):
        place = end - 1 - back
        j = joints.sequence[place]
        for i in range(team.lane, 6, team.lanes):
            found = component_of(joints.solution, j, column, i)
            for e in range(joints.column[place], joints.column[place + 1]):
                found -= wp.dot(column_of(joints.lower, e, i), joints.solution[joints.row[e], column])
            set_component(joints.solution, j, column, i, found)
        sync_warp(team.lanes)
