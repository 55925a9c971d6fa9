"""Declaration of the pool of shapes: its records and arrays, which all environments share."""

import warp as wp

from warp_rigid.kernels.declare import Field, Lifetime, layout, packed_record, record, record_reader

PartRecord = record(
    "PartRecord",
    "One signed distance function of a shape.",
    kind=Field(int, "", "", "distance function, a PartKind (distance.py)"),
    placed=Field(int, "", "", "0: the pose in the shape's frame is the identity"),
    position=Field(wp.vec3, "", "m", "position in the shape's frame"),
    orientation=Field(wp.quat, "", "", "orientation in the shape's frame"),
    size=Field(wp.vec4, "", "m", "dimensions, depending on the kind"),
    grid_start=Field(int, "", "", "first node of the grid"),
    grid_dims=Field(wp.vec3i, "", "", "number of grid nodes along x, y, z"),
    grid_origin=Field(wp.vec3, "", "m", "position of the first node, in the part's frame"),
    grid_spacing=Field(float, "", "m", "distance between neighbouring nodes"),
    tree_start=Field(int, "", "", "first node of the tree of triangles"),
    tree_end=Field(int, "", "", "one past the last; tree_start if the part has no exact distance to triangles"),
    surface_end=Field(int, "", "", "one past the last, also if it has none"),
)

MOST_OF_LEAF = 8
"""Triangles of a leaf are fewer than this number, so that one integer holds the first one and their number."""

TreeRecord = packed_record(
    "TreeRecord",
    "A node of a tree of triangles, stored depth first.",
    lower=Field(wp.vec3, "", "m", "lower corner of the box around its triangles, in the part's frame"),
    skip=Field(int, "", "", "node that follows its subtree"),
    upper=Field(wp.vec3, "", "m", "upper corner of the box"),
    leaf=Field(
        int,
        "",
        "",
        "MOST_OF_LEAF times the first triangle of a leaf, plus their number, which is 0 for other nodes",
    ),
)

TriangleRecord = packed_record(
    "TriangleRecord",
    "A triangle of a mesh, with the normals that give the sign of a distance.",
    corner_0=Field(wp.vec3, "", "m", "first corner, in the part's frame"),
    normal_x=Field(float, "", "", "first component of the outward unit normal"),
    corner_1=Field(wp.vec3, "", "m", "second corner"),
    normal_y=Field(float, "", "", "second component"),
    corner_2=Field(wp.vec3, "", "m", "third corner"),
    normal_z=Field(float, "", "", "third component"),
    side_0=Field(wp.vec3, "", "", "mean of the normals at the side between the first and second corner"),
    side_1=Field(wp.vec3, "", "", "the same, second and third corner"),
    side_2=Field(wp.vec3, "", "", "the same, third and first corner"),
    vertex_0=Field(wp.vec3, "", "", "angle-weighted mean of the normals at the first corner"),
    vertex_1=Field(wp.vec3, "", "", "the same at the second corner"),
    vertex_2=Field(wp.vec3, "", "", "the same at the third corner"),
)

ClusterRecord = packed_record(
    "ClusterRecord",
    "A few neighbouring samples and their bounding sphere.",
    center=Field(wp.vec3, "", "m", "centre of the sphere, in the shape's frame"),
    radius=Field(float, "", "m", "radius of the sphere"),
    kind=Field(int, "", "", "kind of the samples; rims are grouped with points"),
    sample_start=Field(int, "", "", "first sample"),
    sample_end=Field(int, "", "", "one past the last"),
)

SampleRecord = packed_record(
    "SampleRecord",
    "A surface point, edge segment, rim or arc of a rim that is tested against other bodies.",
    point=Field(wp.vec3, "", "m", "position in the shape's frame"),
    radius=Field(float, "", "m", "radius of a sphere around the sample, or of a rim"),
    slide=Field(
        wp.vec3, "", "m", "half of an edge segment, from its middle to its end, or of an arc along it; zero for others"
    ),
    kind=Field(int, "", "", "a SampleKind"),
    normal=Field(wp.vec3, "", "", "outward unit normal; zero for the centre of a sphere"),
    choice=Field(int, "", "", "of a ball on a mesh: the place that it stands for, from 1; 0: the nearest place"),
    edge_start=Field(int, "", "", "first unsampled edge at a point of a mesh"),
    edge_end=Field(int, "", "", "one past the last"),
)

ShapeRecord = record(
    "ShapeRecord",
    "Ranges of a shape's parts and clusters in the pool, and its bounding box.",
    part_start=Field(int, "", "", "first part"),
    part_end=Field(int, "", "", "one past the last"),
    convex=Field(int, "", "", "1: one convex part with an exact distance"),
    cluster_start=Field(int, "", "", "first cluster"),
    cluster_end=Field(int, "", "", "one past the last"),
    hull_start=Field(int, "", "", "first hull vertex, if the shape is a convex mesh"),
    hull_end=Field(int, "", "", "one past the last; `hull_start` if it is not"),
    inside=Field(wp.vec3, "", "m", "a point inside the shape, if it is convex"),
    lower=Field(wp.vec3, "", "m", "lower corner of the bounding box"),
    upper=Field(wp.vec3, "", "m", "upper corner of the bounding box"),
    size=Field(float, "", "m", "smallest extent of the bounding box; contact tolerances scale with it"),
    wall=Field(float, "", "m", "thickness of its walls"),
    ball_start=Field(int, "", "", "first inner ball, the largest one"),
    ball_end=Field(int, "", "", "one past the last"),
    cell=Field(float, "", "m", "widest cell of the distance grids of its meshes; 0 without a mesh"),
    dip=Field(float, "", "m", "how much nearer than its samples its unsampled edges may come to others like them"),
    unsampled_length=Field(float, "", "m", "longest piece of an unsampled edge"),
    rise=Field(float, "", "m/s", "largest speed of the surface relative to the body; 0 except for moving ground"),
)

Shapes = layout(
    "Shapes",
    "The pool of shapes, shared by all environments. Values that are read together are stored in one record.",
    lifetime=Lifetime.SCENE,
    shapes=Field(ShapeRecord, "shapes", "", "shapes"),
    parts=Field(PartRecord, "parts", "", "signed distance functions of the shapes"),
    clusters=Field(ClusterRecord, "clusters", "", "sample clusters of the shapes"),
    samples=Field(SampleRecord, "samples", "", "surface samples of the shapes"),
    unsampled_edges=Field(
        wp.vec3, "unsampled_edges", "m", "from a point of a mesh to the other end of each of its unsampled edges"
    ),
    balls=Field(wp.vec4, "balls", "m", "inner balls: centre and radius; radius 0 if the shape has no inside"),
    hull=Field(wp.vec3, "hull_vertices", "m", "vertices of convex meshes, in the shape's frame"),
    grid_value=Field(float, "nodes", "m", "signed distance, or height, at a grid node"),
    tree=Field(TreeRecord, "tree_nodes", "", "trees of the triangles of meshes"),
    triangles=Field(TriangleRecord, "triangles", "", "triangles of meshes, in the order of the leaves"),
)

read_node = record_reader(TreeRecord)
read_triangle = record_reader(TriangleRecord)
read_cluster = record_reader(ClusterRecord)
read_sample = record_reader(SampleRecord)
