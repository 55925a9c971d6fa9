"""Large functions: called on a CPU, where inlining them takes most of the compilation; inlined on a GPU.

A call on a GPU needs a stack, which makes the search for contacts slower. A call on a CPU copies its arguments; a
struct of arrays such as `Shapes` has several hundred bytes. Large functions that are called for each sample or pair
therefore take it by reference (`wp.ref`), or are inlined (`inline=True`) where they are called once.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
#undef WP_NOINLINE
#define WP_NOINLINE
#endif
""")
def inline_on_gpu():
    """Restrict `inline=False` of a function that calls this one to the CPU.

    Warp writes a function after those that it calls, so that this macro, Warp's attribute for `inline=False`, is empty
    when the code for a GPU reaches the function.
    """
    ...
