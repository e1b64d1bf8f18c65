"""The rules of JAX's primitives, by what they do; importing this package registers them all."""

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
