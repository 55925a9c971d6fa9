"""Divisions and roots of the solver.

On a GPU a division that is rounded to the last bit takes ten instructions, and a lane of the solver waits for each. One
that may be off by two units in the last place takes two, and the solver, which iterates, corrects it.
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
