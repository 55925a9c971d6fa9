"""Rows, elements and products of blocks and vectors in arrays, for lanes that share a block: lane k has row k.

A block that is read as a value is copied. The copy is in local memory where the compiler does not know the index of an
element, and copies make the compilation of kernels for a GPU up to four times as long.
"""

import warp as wp

from warp_rigid.kernels.joints.arrays import mat63d, mat66d, vec6d

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
return reinterpret_cast<const double*>(blocks.data + at)[6 * row + column];
""")
def entry_of(blocks: wp.array[mat66d], at: int, row: int, column: int) -> wp.float64:
    """An element of a block."""
    ...


@wp.func_native("""
reinterpret_cast<double*>(blocks.data + at)[6 * row + column] = value;
""")
def set_entry(blocks: wp.array[mat66d], at: int, row: int, column: int, value: wp.float64):
    """Store an element of a block."""
    ...


@wp.func_native("""
return reinterpret_cast<const wp::vec_t<6, wp::float64>*>(blocks.data + at)[row];
""")
def row_of(blocks: wp.array[mat66d], at: int, row: int) -> vec6d:
    """A row of a block."""
    ...


@wp.func_native("""
reinterpret_cast<wp::vec_t<6, wp::float64>*>(blocks.data + at)[row] = value;
""")
def set_row(blocks: wp.array[mat66d], at: int, row: int, value: vec6d):
    """Store a row of a block."""
    ...


@wp.func_native("""
return reinterpret_cast<const wp::vec_t<3, wp::float64>*>(rows.data + at)[row];
""")
def axis_row(rows: wp.array[mat63d], at: int, row: int) -> wp.vec3d:
    """A row of the coefficients of a joint's rows."""
    ...


@wp.func_native("""
const double* c = reinterpret_cast<const double*>(blocks.data + at) + column;
wp::vec_t<6, wp::float64> v;
v[0] = c[0]; v[1] = c[6]; v[2] = c[12]; v[3] = c[18]; v[4] = c[24]; v[5] = c[30];
return v;
""")
def column_of(blocks: wp.array[mat66d], at: int, column: int) -> vec6d:
    """A column of a block."""
    ...


@wp.func_native("""
return reinterpret_cast<const double*>(vectors.data + vectors.shape[1] * at + column)[k];
""")
def component_of(vectors: wp.array2d[vec6d], at: int, column: int, k: int) -> wp.float64:
    """A component of a vector."""
    ...


@wp.func_native("""
reinterpret_cast<double*>(vectors.data + vectors.shape[1] * at + column)[k] = value;
""")
def set_component(vectors: wp.array2d[vec6d], at: int, column: int, k: int, value: wp.float64):
    """Store a component of a vector."""
    ...


@wp.func_native("""
const double* m = reinterpret_cast<const double*>(blocks.data + at);
wp::vec_t<6, wp::float64> product;
for (int i = 0; i < 6; ++i) {
    double sum = m[6 * i] * v[0];
    for (int k = 1; k < 6; ++k) { sum += m[6 * i + k] * v[k]; }
    product[i] = sum;
}
return product;
""")
def block_times(blocks: wp.array[mat66d], at: int, v: vec6d) -> vec6d:
    """The product of a block and a vector."""
    ...


@wp.func_native("""
const double* m = reinterpret_cast<const double*>(blocks.data + at);
wp::vec_t<6, wp::float64> product;
for (int i = 0; i < 6; ++i) {
    double sum = m[i] * v[0];
    for (int k = 1; k < 6; ++k) { sum += m[6 * k + i] * v[k]; }
    product[i] = sum;
}
return product;
""")
def transposed_block_times(blocks: wp.array[mat66d], at: int, v: vec6d) -> vec6d:
    """The product of a block, transposed, and a vector."""
    ...


@wp.func_native("""
const double* m = reinterpret_cast<const double*>(rows.data + at);
wp::vec_t<6, wp::float64> product;
for (int i = 0; i < 6; ++i) {
    double sum = m[3 * i] * v[0];
    for (int k = 1; k < 3; ++k) { sum += m[3 * i + k] * v[k]; }
    product[i] = sum;
}
return product;
""")
def rows_times(rows: wp.array[mat63d], at: int, v: wp.vec3d) -> vec6d:
    """The product of the coefficients of a joint's rows and a vector."""
    ...


@wp.func_native("""
const double* m = reinterpret_cast<const double*>(rows.data + at);
wp::vec_t<3, wp::float64> product;
for (int i = 0; i < 3; ++i) {
    double sum = m[i] * v[0];
    for (int k = 1; k < 6; ++k) { sum += m[3 * k + i] * v[k]; }
    product[i] = sum;
}
return product;
""")
def sum_of_rows(rows: wp.array[mat63d], at: int, v: vec6d) -> wp.vec3d:
    """The sum of the coefficients of a joint's rows, each times a component of a vector."""
    ...
