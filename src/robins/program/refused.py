"""Primitives of JAX without a rule, with the reason that `robins.program.walk` reports.

Every primitive that JAX publishes has a rule or a reason here; a test compares both with JAX.
"""

_REASONS = {
    "its numbers are complex": (
        *("complex", "conj", "real", "imag", "fft", "eig", "schur", "hessenberg"),
    ),
    "there is no rule for this factorisation": (
        *("svd", "householder_product", "ormqr", "tridiagonal", "tridiagonal_solve"),
        *("cholesky_update", "symmetric_product", "lu_pivots_to_permutation"),
    ),
    "there is no rule for this function": (
        *("bessel_i1e", "polygamma", "zeta", "igamma_grad_a", "cumlogsumexp", "eq_to"),
        *("clz", "population_count", "mulhi"),
    ),
    "there is no rule for sliding windows": (
        *("conv_general_dilated", "reduce_window", "reduce_window_max", "reduce_window_min"),
        *("reduce_window_sum", "select_and_gather_add", "select_and_scatter"),
        "select_and_scatter_add",
    ),
    "there is no rule for a reduction by a function of its own": ("reduce",),
    "there is no rule for the greatest few; sort them": ("top_k", "approx_top_k"),
    "its random numbers are not those of threefry": (
        *("random_gamma", "rng_bit_generator", "rng_uniform"),
    ),
    "it exchanges numbers with other devices": (
        *("all_gather", "all_to_all", "axis_index", "pmax", "pmin", "ppermute", "psum"),
        *("ragged_all_to_all", "sharding_constraint", "stage"),
    ),
    "it calls Python": ("pure_callback", "io_callback", "debug_callback", "debug_print"),
    "it changes memory in place": ("get", "swap", "empty2"),
    "it orders effects, of which a program has none": ("after_all", "create_token", "dce_sink"),
    "it calls what is not yet traced": ("call",),
}

REFUSED = {name: reason for reason, names in _REASONS.items() for name in names}
"""The reason by the name of the primitive."""
