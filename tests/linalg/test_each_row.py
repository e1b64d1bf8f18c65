"""Results of `each_row` under JAX: those of `vmap`, to the bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.linalg.rows import each_row

RNG = np.random.default_rng(0)
A, M = jnp.asarray(RNG.normal(size=(3, 4))), jnp.asarray(RNG.normal(size=(4, 4)))
TWO = jnp.stack([A, 2.0 * A]), jnp.stack([M, M.T])


def made(each):
    """A function of two arrays by a function of one row, which closes over one of them."""

    def of(a, m):
        def one(x, b):
            return {"y": jnp.sin(m @ x) * b, "n": jnp.argmax(x), "k": 3.0}

        return each(one, a, np.arange(3.0))

    return of


def slope(of):
    return jax.grad(lambda a, m: jnp.sum(of(a, m)["y"] ** 2), (0, 1))


CASES = {
    "as it is": lambda of: of(A, M),
    "compiled": lambda of: jax.jit(of)(A, M),
    "in a batch": lambda of: jax.vmap(of)(*TWO),
    "in a batch of one of its arguments": lambda of: jax.vmap(of, (None, 0))(A, TWO[1]),
    "slopes backwards": lambda of: slope(of)(A, M),
    "slopes forwards": lambda of: jax.jacfwd(lambda a: of(a, M)["y"])(A),
    "slopes of slopes": lambda of: jax.hessian(lambda a: jnp.sum(of(a, M)["y"]))(A),
    "slopes in a batch": lambda of: jax.jit(jax.vmap(slope(of)))(*TWO),
    "shapes alone": lambda of: jax.tree.map(
        lambda s: (s.shape, str(s.dtype)), jax.eval_shape(of, A, M)
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_it_is_vmap(case):
    got = CASES[case](made(each_row))
    want = CASES[case](made(lambda one, *args: jax.vmap(one)(*args)))
    assert jax.tree.structure(got) == jax.tree.structure(want)
    jax.tree.map(np.testing.assert_array_equal, got, want)
