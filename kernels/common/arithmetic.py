"""Fast division and square root for the solver.

On a GPU, a correctly rounded division takes ten dependent instructions. An approximate division, with an error of up to
two units in the last place, takes two. The iterations of the solver correct the error.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __fdividef(x, y);
#else
    return x / y;
#endif
""")
def quotient(x: float, y: float) -> float:
    """Quotient x / y, for y below 2^126."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return rsqrtf(x);
#else
    return 1.0f / ::sqrtf(x);
#endif
""")
def inverse_root(x: float) -> float:
    """Reciprocal of the square root of x > 0."""
    ...


@wp.func
def root(x: float):
    """Square root of x >= 0."""
    return x * inverse_root(wp.max(x, 1.0e-30))
