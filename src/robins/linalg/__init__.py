"""Small-matrix algebra on square-root factors.

A *factor* of a covariance P is any matrix S with ``S @ S.T == P``. Filters take their matrix
algebra from this room and never call ``jnp.linalg`` themselves, so that its difficulties (singular
factors, gradients, signs) are solved in one place.
"""

from typing import TYPE_CHECKING

from robins.errors import lazy

if TYPE_CHECKING:
    from robins.linalg.dense import (
        as_factor,
        block_diagonal,
        block_factor,
        cholesky,
        downdate,
        eigenvalue_bounds,
        factor,
        guard,
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
]

__getattr__ = lazy(__name__, dict.fromkeys(__all__, f"{__name__}.dense"))
