"""Signed distances to a triangle mesh, on the nodes of a grid or at given points."""

import warp as wp

from warp_rigid.kernels.collide.triangle_distance import FAR

wp.set_module_options({"enable_backward": False})


@wp.struct
class MeshTables:
    """A mesh and the data that determine the sign of a distance to it.

    Attributes:
        mesh: handle of the `wp.Mesh`.
        faces: (m, 3) vertex indices.
        face_normal: (m,) unit normals.
        side_normal: (m, 3) edge pseudonormals of the sides 0-1, 1-2, 2-0.
        vertex_normal: (n,) angle-weighted pseudonormals.
        by_winding: 1 to take the sign from the winding number instead of the pseudonormals.
    """

    mesh: wp.uint64
    faces: wp.array2d[int]
    face_normal: wp.array[wp.vec3]
    side_normal: wp.array2d[wp.vec3]
    vertex_normal: wp.array[wp.vec3]
    by_winding: int


@wp.func
def pseudonormal(tables: MeshTables, face: int, u: float, v: float) -> wp.vec3:
    """Normal of the vertex, side or face that contains the point with barycentric weights u, v, 1 - u - v.

    The angle-weighted pseudonormal gives the right sign wherever the nearest point lies
    (Baerentzen and Aanaes 2005).
    """
    w = 1.0 - u - v
    zero = 1.0e-6  # float32 leaves about 1e-7
    top = 1.0 - zero
    if u > top:
        return tables.vertex_normal[tables.faces[face, 0]]
    if v > top:
        return tables.vertex_normal[tables.faces[face, 1]]
    if w > top:
        return tables.vertex_normal[tables.faces[face, 2]]
    if w < zero:
        return tables.side_normal[face, 0]
    if u < zero:
        return tables.side_normal[face, 1]
    if v < zero:
        return tables.side_normal[face, 2]
    return tables.face_normal[face]


@wp.func
def signed_arm(tables: MeshTables, point: wp.vec3, reach: float) -> wp.vec4:
    """Vector from the nearest surface point within `reach` to `point`, and its sign.

    The sign is -1 inside, 1 outside and NaN if there is no surface within reach.
    """
    if tables.by_winding != 0:
        turns = wp.mesh_query_point_sign_winding_number(tables.mesh, point, reach, 2.0, 0.5)
        if not turns.result:
            return wp.vec4(0.0, 0.0, 0.0, wp.nan)
        arm = point - wp.mesh_eval_position(tables.mesh, turns.face, turns.u, turns.v)
        return wp.vec4(arm[0], arm[1], arm[2], turns.sign)
    nearest = wp.mesh_query_point_no_sign(tables.mesh, point, reach)
    if not nearest.result:
        return wp.vec4(0.0, 0.0, 0.0, wp.nan)
    arm = point - wp.mesh_eval_position(tables.mesh, nearest.face, nearest.u, nearest.v)
    outward = wp.dot(arm, pseudonormal(tables, nearest.face, nearest.u, nearest.v))
    return wp.vec4(arm[0], arm[1], arm[2], wp.where(outward < 0.0, -1.0, 1.0))


@wp.kernel
def distance_columns(tables: MeshTables, origin: wp.vec3, spacing: float, first: int, values: wp.array3d[float]):
    """One thread per column of grid nodes along z, from column `first` on.

    Distances at neighbouring nodes differ by at most the spacing, which limits the search radius of each query after
    the first.
    """
    column = first + wp.tid()
    i = column // values.shape[1]
    j = column - i * values.shape[1]
    reach = float(FAR)
    for k in range(values.shape[2]):
        point = origin + spacing * wp.vec3(float(i), float(j), float(k))
        found = signed_arm(tables, point, reach)
        distance = wp.length(wp.vec3(found[0], found[1], found[2]))
        values[i, j, k] = found[3] * distance
        reach = distance + 1.01 * spacing


@wp.kernel
def distance_points(tables: MeshTables, points: wp.array[wp.vec3], first: int, arms: wp.array[wp.vec4]):
    """One thread per point, from point `first` on; see `signed_arm`."""
    point = first + wp.tid()
    arms[point] = signed_arm(tables, points[point], FAR)
