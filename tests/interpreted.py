"""Runs of filters by the interpreter of programs, which compiles nothing.

Most of what a test of a filter costs is its compilation by JAX. A law of a filter is one of its
equations, whichever machine carries them out; that the machines agree is a law of its own, in
tests/program. Tests of what JAX makes of a filter (batches, gradients, compiled code) take
`robins.filters.run` itself.
"""

import jax
import jax.numpy as jnp

from robins.filters import run as by_default


def run(*given, **named):
    """`robins.filters.run` by the interpreter; by JAX where it transforms what is given."""
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((given, named))):
        return by_default(*given, **named)
    return jax.tree.map(jnp.asarray, by_default(*given, machine="vm", **named))
