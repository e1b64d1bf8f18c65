"""Small-matrix algebra on square-root factors.

A *factor* of a covariance P is any matrix S with ``S @ S.T == P``. Filters are written against the
names of this room plus the operators ``@ + - * .T``, and never call ``jnp.linalg`` themselves, so
that another matrix layout can take the place of `robins.linalg.dense` without touching a filter.
"""

from robins.linalg.dense import (
    as_factor,
    block_diagonal,
    block_factor,
    cholesky,
    downdate,
    eigenvalue_bounds,
    factor,
    guard,
    identity,
    independent_rows,
    log_diagonal,
    lost_in_rounding,
    plainly_independent,
    solve_lower,
    solve_lower_transposed,
    solve_spd,
    symmetric_root,
    tria,
    van_loan,
    where,
    zeros,
)

__all__ = [
    "as_factor",
    "block_diagonal",
    "block_factor",
    "cholesky",
    "downdate",
    "eigenvalue_bounds",
    "factor",
    "guard",
    "identity",
    "independent_rows",
    "log_diagonal",
    "lost_in_rounding",
    "plainly_independent",
    "solve_lower",
    "solve_lower_transposed",
    "solve_spd",
    "symmetric_root",
    "tria",
    "van_loan",
    "where",
    "zeros",
]
