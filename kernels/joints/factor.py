"""Factorization of a mechanism: A = G M^-1 G^T = L D L^T, with a block of six rows and columns for each joint.

G are the rows of all joints of the mechanism, M the masses of its bodies. The order of elimination and the blocks of L
that are not zero are found on the host when the simulator is made. A pivot much smaller than the effective inverse mass
of its row belongs to a row that follows from the others, as in a closed loop. Its inverse is set to zero, so that the
row takes no impulse.
"""

import warp as wp

from warp_rigid.kernels.joints.arrays import Joints, mat63d, mat66d, vec6d
from warp_rigid.kernels.joints.coordinate import IDLE, damping_slope, drive_slope, is_held
from warp_rigid.kernels.joints.joint_rows import (
    has_coordinate,
    is_damped,
    is_locked,
    present_rows,
)
from warp_rigid.kernels.joints.poses import free_row
from warp_rigid.kernels.schema import Motions

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

REDUNDANT = wp.constant(wp.float64(1.0e-8))
"""Pivot, as a fraction of its diagonal entry, below which a row counts as redundant."""

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))


@wp.func
def active_rows(j: int, dt: float, motions: Motions, joints: Joints):
    """Rows of a joint that take part in the factorization: the locked ones, and others unless they are free."""
    rows = present_rows(j, motions, joints)
    if has_coordinate(j, motions, joints):
        if is_held(joints.mode[j]) or drive_slope(j, wp.float64(dt), joints) > ZERO:
            rows = rows | (1 << free_row(joints.coordinate[j]))
        for k in range(4, 6):
            if is_damped(j, k, joints) and joints.mode[j][0] != IDLE:
                rows = rows | (1 << k)
    return rows


@wp.func
def masked(rows: mat63d, active: int):
    """The rows that are active; zero for the others."""
    for k in range(6):
        if not is_locked(active, k):
            for i in range(3):
                rows[k, i] = ZERO
    return rows


@wp.func
def coupling(j: int, k: int, b: int, joints: Joints):
    """Velocities along the rows of joint j for unit impulses along those of joint k, through their common body b."""
    angular_j = joints.angular_a[j]
    angular_k = joints.angular_a[k]
    sign = ONE
    if joints.body_a[j] != b:
        angular_j = joints.angular_b[j]
        sign = -sign
    if joints.body_a[k] != b:
        angular_k = joints.angular_b[k]
        sign = -sign
    linear_j = masked(joints.linear[j], joints.active[j])
    linear_k = masked(joints.linear[k], joints.active[k])
    angular_j = masked(angular_j, joints.active[j])
    angular_k = masked(angular_k, joints.active[k])
    linear = (sign * joints.inverse_mass[b]) * (linear_j * wp.transpose(linear_k))
    return linear + (angular_j * joints.inverse_inertia[b]) * wp.transpose(angular_k)


@wp.func
def diagonal_block(j: int, dt: float, joints: Joints):
    """Block of a joint on the diagonal of A, with the compliance of its drive; 1 for rows that are not active."""
    block = coupling(j, j, joints.body_a[j], joints)
    if joints.to_world[j] == 0:
        angular = masked(joints.angular_b[j], joints.active[j])
        linear = masked(joints.linear[j], joints.active[j])
        b = joints.body_b[j]
        block += joints.inverse_mass[b] * (linear * wp.transpose(linear))
        block += (angular * joints.inverse_inertia[b]) * wp.transpose(angular)
    for k in range(6):
        if not is_locked(joints.active[j], k):
            block[k, k] = ONE
    row = free_row(joints.coordinate[j])
    if row >= 0 and is_locked(joints.active[j], row) and not is_held(joints.mode[j]):
        block[row, row] = block[row, row] + ONE / drive_slope(j, wp.float64(dt), joints)
    for k in range(4, 6):
        if is_damped(j, k, joints) and is_locked(joints.active[j], k):
            block[k, k] = block[k, k] + ONE / damping_slope(j, wp.float64(dt), joints)
    return block


@wp.func
def largest_pivot(block: mat66d, scale: vec6d, taken: int):
    """Row, not taken yet, with the largest pivot as a fraction of its diagonal entry; -1 if all are too small."""
    best = int(-1)
    most = REDUNDANT
    for k in range(6):
        if not is_locked(taken, k) and block[k, k] > most * scale[k]:
            most = block[k, k] / scale[k]
            best = k
    return best


@wp.func
def swept(k: int, block: mat66d):
    """The symmetric block after the sweep operator for a row: the swept rows hold the negative of their inverse."""
    pivot = block[k, k]
    for i in range(6):
        if i != k:
            factor = block[i, k] / pivot
            for j in range(6):
                if j != k:
                    block[i, j] = block[i, j] - factor * block[k, j]
            block[i, k] = factor
    for j in range(6):
        if j != k:
            block[k, j] = block[j, k]
    block[k, k] = -ONE / pivot
    return block


@wp.func
def inverse_without_redundant(given: mat66d, scale: vec6d):
    """Inverse of a symmetric block, largest pivots first; zero in the rows whose pivots are too small."""
    block = given
    taken = int(0)
    row = largest_pivot(block, scale, taken)
    while row >= 0:
        block = swept(row, block)
        taken = taken | (1 << row)
        row = largest_pivot(block, scale, taken)
    inverse = mat66d()
    for i in range(6):
        for j in range(6):
            if is_locked(taken, i) and is_locked(taken, j):
                inverse[i, j] = -block[i, j]
    return inverse


@wp.func
def assemble(place: int, dt: float, joints: Joints):
    """The blocks of A in the column of the joint at a place of the sequence."""
    j = joints.sequence[place]
    block = diagonal_block(j, dt, joints)
    joints.pivot[j] = block
    scale = vec6d()
    for k in range(6):
        scale[k] = block[k, k]
    joints.solution[j] = scale
    for e in range(joints.column[place], joints.column[place + 1]):
        off = mat66d()
        if joints.shared[e] >= 0:
            off += coupling(joints.row[e], j, joints.shared[e], joints)
        if joints.shared_too[e] >= 0:
            off += coupling(joints.row[e], j, joints.shared_too[e], joints)
        joints.lower[e] = off


@wp.func
def eliminate(place: int, joints: Joints):
    """Eliminate the joint at a place of the sequence."""
    j = joints.sequence[place]
    inverse = inverse_without_redundant(joints.pivot[j], joints.solution[j])
    joints.pivot[j] = inverse
    for u in range(joints.elimination[place], joints.elimination[place + 1]):
        change = (joints.lower[joints.left[u]] * inverse) * wp.transpose(joints.lower[joints.right[u]])
        joints.lower[joints.target[u]] = joints.lower[joints.target[u]] - change
    for e in range(joints.column[place], joints.column[place + 1]):
        block = joints.lower[e]
        factor = block * inverse
        k = joints.row[e]
        joints.pivot[k] = joints.pivot[k] - factor * wp.transpose(block)
        joints.lower[e] = factor


@wp.func
def factorize(m: int, dt: float, motions: Motions, joints: Joints):
    """Factorize a mechanism with the rows that are active in the present modes."""
    first = joints.first_place[m]
    end = joints.first_place[m + 1]
    for place in range(first, end):
        j = joints.sequence[place]
        joints.active[j] = active_rows(j, dt, motions, joints)
    for place in range(first, end):
        assemble(place, dt, joints)
    for place in range(first, end):
        eliminate(place, joints)
    joints.factorizations[m] = joints.factorizations[m] + 1


@wp.func
def substitute(m: int, joints: Joints):
    """Replace the right-hand side in `solution` by the solution."""
    first = joints.first_place[m]
    end = joints.first_place[m + 1]
    for place in range(first, end):
        known = joints.solution[joints.sequence[place]]
        for e in range(joints.column[place], joints.column[place + 1]):
            k = joints.row[e]
            joints.solution[k] = joints.solution[k] - joints.lower[e] * known
    for back in range(end - first):
        place = end - 1 - back
        j = joints.sequence[place]
        found = joints.pivot[j] * joints.solution[j]
        for e in range(joints.column[place], joints.column[place + 1]):
            found -= wp.transpose(joints.lower[e]) * joints.solution[joints.row[e]]
        joints.solution[j] = found
