"""Rules that translate JAX's primitives, by topic; importing this package registers them all."""

from robins.program.primitives import (
    algebra,
    arithmetic,
    control,
    indexing,
    movement,
    random,
    reductions,
)

__all__ = ["algebra", "arithmetic", "control", "indexing", "movement", "random", "reductions"]
