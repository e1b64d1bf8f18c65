"""The same function by JAX and in C, and how far what they give is apart."""

import jax
import numpy as np

from robins.program import FLAGS, native

# Compiled without optimisation: most programs of the tests are called once. The bits are the same.
QUICK = tuple("-O0" if flag == "-O2" else flag for flag in FLAGS)


def in_c(function, *args, unroll=None):
    """A function in C, for arguments like these."""
    return native(function, *args, unroll=unroll, flags=QUICK)


def apart(want, got, size=None):
    """The largest difference of two arrays, in parts of a size: by default of the largest number.

    Infinite where one has a NaN or an infinity that the other has not.
    """
    want, got = (np.asarray(x, dtype=float) for x in (want, got))
    if size is None:
        size = np.max(np.abs(want), initial=0.0, where=np.isfinite(want))
    same = (want == got) | (np.isnan(want) & np.isnan(got))
    with np.errstate(all="ignore"):
        off = np.where(same, 0.0, np.abs(want - got) / np.where(size > 0.0, size, 1.0))
    return float(np.max(np.where(np.isnan(off), np.inf, off), initial=0.0))


def same_in_c(function, *args, within=0.0, unroll=None, others=()):
    """Check that a function gives in C what it gives by JAX, for arguments and for others."""
    program = in_c(function, *args, unroll=unroll)
    for given in (args, *others):
        want, got = jax.jit(function)(*given), program(*given)
        assert jax.tree.structure(want) == jax.tree.structure(got)
        for a, b in zip(jax.tree.leaves(want), jax.tree.leaves(got), strict=True):
            assert (np.shape(a), a.dtype) == (np.shape(b), b.dtype)
            assert apart(a, b) <= within, (a, b)
    return program
