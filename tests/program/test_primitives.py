"""Every primitive that has a rule, by a small function, against JAX; written out and in loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exported import primitives
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import primitives as published
from jax.extend.random import threefry_2x32
from machines import in_c, same_in_c

import robins.program.primitives  # noqa: F401
from robins.linalg.rows import each_row
from robins.program import ProgramError, trace
from robins.program.refused import REFUSED
from robins.program.walk import RULES

RNG = np.random.default_rng(0)
A, B = RNG.normal(size=(3, 4)), RNG.normal(size=(4, 5))
WIDE = RNG.normal(size=(2, 7, 4))
SQUARE = RNG.normal(size=(5, 5))
SPD = SQUARE @ SQUARE.T + np.eye(5)
V, W = RNG.normal(size=6), RNG.normal(size=6)
POSITIVE = np.abs(V) + 0.1
ODD = np.array([0.0, -0.0, 1.5, -2.5, np.inf, -np.inf, np.nan, 1e300, 2.5, 0.5])
COUNTS, OTHERS = np.array([7, -7, 0, 3, -1]), np.array([2, 2, 5, -2, 0])
U = np.array([1, 2**31, 4_000_000_000, 7], dtype=np.uint32)
AT = jnp.asarray(2)

ROUNDING = 4e-16


@jax.custom_batching.custom_vmap
def a_batch_of_its_own(x):
    return x + 1.0


@a_batch_of_its_own.def_vmap
def _(size, batched, x):
    return x + 1.0, True


# Functions that leave nothing to rounding: moved, chosen, counted, or rounded once by all alike.
EXACT = {
    "sums": (lambda a, b: (a + b, a - b, a * b, a / b, -a, jnp.abs(a)), V, W),
    "on odd numbers": (
        lambda a, b: (a + b, a * b, a / b, jnp.maximum(a, b), jnp.minimum(a, b), jnp.sign(a)),
        np.repeat(ODD, 10),
        np.tile(ODD, 10),
    ),
    "comparisons": (
        lambda a, b: (a == b, a != b, a < b, a <= b, a > b, a >= b, jnp.isfinite(a)),
        np.repeat(ODD, 10),
        np.tile(ODD, 10),
    ),
    "roundings": (
        lambda a: (jnp.floor(a), jnp.ceil(a), jnp.round(a), lax.round(a), jnp.sqrt(a)),
        ODD,
    ),
    "powers": (lambda a: (a**2, a**3, a**5, a**-2, lax.square(a), lax.rsqrt(a * a)), V),
    "clamp": (lambda a: lax.clamp(-0.5, a, 0.5), ODD),
    "whole": (
        lambda i, j: (i + j, i * j, lax.div(i, j), lax.rem(i, j), jnp.sign(i), abs(i), i // 3),
        COUNTS,
        OTHERS,
    ),
    "whole, of 32 bits": (
        lambda i, j: (
            *(i + j, i - j, i * j, -i, abs(i), i << 3, i**3, lax.shift_right_logical(i, 3 + 0 * i)),
            *(lax.shift_right_arithmetic(i, 3 + 0 * i), jnp.sum(i, dtype=np.int32), jnp.cumsum(i)),
            *(j.astype(np.uint32), j.astype(int).astype(np.uint32).astype(np.int32), i @ j),
            lax.shift_right_logical(i.astype(int), 3),
        ),
        np.array([2**31 - 1, -(2**31), 2**30, -7, 3], np.int32),
        np.array([2**31 - 1, -(2**31), 5, -3, 2**31 - 9], np.int32),
    ),
    "cut to 32 bits": (
        lambda a, i: (a.astype(np.int32), a.astype(np.uint32), i.astype(np.int32)),
        np.array([1e12, -1e12, -0.5, 2.9, np.nan, np.inf]),
        np.array([2**40 + 5, -(2**40) - 5, 2**31, 7, -1]),
    ),
    "random numbers": (
        lambda words, seed: [
            jax.random.uniform(key, (3,))
            for key in (
                jax.random.wrap_key_data(words, impl="threefry2x32"),
                jax.random.fold_in(jax.random.key(seed), 3),
                *jax.random.split(jax.random.wrap_key_data(jax.random.key_data(jax.random.key(5)))),
            )
        ],
        U[1:3],
        3,
    ),
    "random words": (
        lambda words: threefry_2x32(words[:2], words),
        U,
    ),
    "whole, compared": (
        lambda i, j: (i < j, jnp.maximum(i, j), i == j, i & j, i | j, i ^ j),
        COUNTS,
        OTHERS,
    ),
    "words": (
        lambda u: (u + u, u * u, u << 3, u >> 5, ~u, u ^ U[::-1], u.astype(jnp.uint64) << 20),
        U,
    ),
    "flags": (lambda a, b: (a & b, a | b, a ^ b, ~a), V > 0, W > 0),
    "select": (
        lambda c, a, b: (jnp.where(c, a, b), jnp.where(c, 0.0, b), jnp.where(c, c, ~c)),
        V > 0,
        V,
        W,
    ),
    "select among five": (
        lambda i, a: lax.select_n(i, *(a + k for k in range(5))),
        np.array([4, 0, 2, 1, 3, 3], np.int32),
        V,
    ),
    "converted": (
        lambda a, i, c: (
            a.astype(int),
            i.astype(float),
            c.astype(float),
            i.astype(bool),
            c.astype(int),
            a.astype(bool),
        ),
        V * 10,
        COUNTS,
        V > 0,
    ),
    "bits": (
        lambda a, u: (
            lax.bitcast_convert_type(a, jnp.uint64),
            lax.bitcast_convert_type(u, jnp.float64),
        ),
        V,
        np.array([4607182418800017408, 5], dtype=np.uint64),
    ),
    "next": (lambda a: jnp.nextafter(a, jnp.inf), V),
    "moved": (
        lambda a, w: (
            a.T,
            a.reshape(2, 6),
            a[1:, ::2],
            a[::-1],
            a[0],
            a[None],
            jnp.tile(a, (2, 3)),
            jnp.concatenate([a, a + 1], axis=1),
            jnp.stack([a, -a], axis=1),
            jnp.split(w, 7, axis=1),
            jnp.unstack(w, axis=1),
            jnp.broadcast_to(a, (2, 3, 4)),
            jnp.moveaxis(w, 0, 2),
            jnp.arange(5),
            jnp.eye(3, 4, 1),
            lax.pad(a, 9.0, ((1, 2, 1), (-1, 2, 0))),
            lax.broadcasted_iota(float, (2, 3), 1),
            lax.expand_dims(a, (1,)),
        ),
        A,
        WIDE,
    ),
    "indexed": (
        lambda a, i: (
            a[i],
            a[:, i],
            a[i, 1:],
            a.at[i].set(0.0),
            a.at[i, 1].add(1.0),
            a.at[i, 2].subtract(1.0),
            lax.dynamic_slice(a, (i, i), (2, 2)),
        ),
        A,
        AT,
    ),
    "indexed beyond": (
        lambda a, i: (
            a[i],
            a.at[i].get(mode="fill"),
            a.at[i].get(mode="clip"),
            a.at[i].set(5.0),
            lax.dynamic_slice(a, (i, 0), (2, 2)),
            lax.dynamic_update_slice(a, a[:2, :2], (i, 1)),
        ),
        A,
        jnp.asarray(-5),
    ),
    "indexed by many": (
        lambda a, k: (
            a[k],
            a[:, k],
            a[k, k + 1],
            a.at[k].add(1.0),
            a.at[k, k].mul(2.0),
            a.at[:, k].set(0.0),
            a.at[k].min(0.1),
            a.at[k].max(0.1),
            jnp.take_along_axis(a, k[None], axis=1),
        ),
        A,
        np.array([2, 0, 0]),
    ),
    "indexed in a batch": (
        jax.vmap(lambda w, i: (w[i], w.at[i].set(0.0), lax.dynamic_slice(w, (i, 1), (2, 3)))),
        WIDE,
        np.array([3, 6]),
    ),
    "indexed by numbers that are known": (
        lambda a: (
            a[np.array([2, 0])],
            a[:, [3, 1]],
            a.at[np.array([1, 2])].set(a[:2]),
            a.at[:, 2].add(1.0),
        ),
        A,
    ),
    "extremes": (
        lambda a: (
            a.max(),
            a.min(axis=0),
            jnp.argmax(a, axis=1),
            jnp.argmin(a),
            jnp.any(a > 0),
            jnp.all(a > 0, axis=0),
        ),
        A,
    ),
    "turned round": (lambda w: (w[:, ::-1], w[::-1, :, ::-1]), WIDE),
    "extremes with NaN": (
        lambda a: (jnp.argmax(a), jnp.argmin(a), a.max(), a.min()),
        np.tile(ODD, 2),
    ),
    "parity": (lambda a: lax.reduce_xor(a, (0,)), V > 0),
    "cumulated extremes": (lambda a: (lax.cummax(a), lax.cummin(a, reverse=True)), V),
    "sorted": (
        lambda a, i: (jnp.sort(a), jnp.argsort(i), lax.sort((i, a[:5]), num_keys=2)),
        ODD[2:],
        COUNTS,
    ),
    "sorted rows": (lambda a: (jnp.sort(a, axis=0), jnp.argsort(-a, axis=1)), A),
    "branches": (
        lambda c, i, a: (
            lax.cond(c, lambda x: x + 1.0, lambda x: x * 2.0, a),
            lax.switch(i, [lambda x: x, lambda x: -x, lambda x: 0.0 * x], a),
        ),
        np.bool_(True),
        jnp.asarray(1),
        V,
    ),
    "calls": (
        lambda a: (
            jax.jit(lambda x: x + 1.0)(a),
            jax.checkpoint(lambda x: x * 2.0)(a),
            jax.nn.relu(a),
            lax.stop_gradient(a),
            checkpoint_name(a, "a"),
            lax.optimization_barrier(a),
            lax.reduce_precision(a, 11, 52),
            lax.platform_dependent(a, cpu=lambda x: x + 5.0, default=lambda x: x),
        ),
        V,
    ),
    "a batched rule of its own": (jax.jit(a_batch_of_its_own), A),
    "counted loop": (
        lambda a: lax.fori_loop(0, 5, lambda k, x: x.at[k].set(x[k] + x[k - 1]), a),
        V,
    ),
    "loop that ends by numbers": (
        lambda a: lax.while_loop(
            lambda s: s[0] < 10.0, lambda s: (s[0] * 2.0, s[2], s[1]), (a, 1, 2)
        ),
        1.3,
    ),
    "loops that end by numbers, in a batch": (
        jax.vmap(lambda a: lax.while_loop(lambda s: s < 10.0, lambda s: s * 2.0, a)),
        np.array([1.3, 20.0, 9.9]),
    ),
    "scan": (
        lambda a: lax.scan(lambda c, row: ((c[1], c[0] + row[0]), (c[0], row[1:])), (0.0, 1.0), a),
        WIDE[0],
    ),
    "each row": (
        lambda a, b: each_row(lambda x, y: {"s": jnp.sum(x * y) * V, "y": y, "z": b[0, 0]}, a, b),
        A,
        A + 1.0,
    ),
    "each row in a loop, of each row": (
        lambda a: lax.fori_loop(
            0, 3, lambda k, a: each_row(lambda x: each_row(lambda y: y * y + a[k, 0], x), a), a
        ),
        0.1 * A,
    ),
    "scan, backwards": (
        lambda a: lax.scan(lambda c, row: (c + row, c), jnp.zeros(4), a, reverse=True),
        WIDE[0],
    ),
    "scan in a loop": (
        lambda a: lax.fori_loop(
            0, 3, lambda k, x: lax.scan(lambda c, r: (c + r + k, None), x, a)[0], jnp.zeros(4)
        ),
        WIDE[0],
    ),
}
ROUNDED = {
    "trigonometry": (
        lambda a: (jnp.sin(a), jnp.cos(a), jnp.tan(a), jnp.arctan(a), jnp.arctan2(a, a[::-1])),
        V * 3,
    ),
    "inverse": (lambda a: (jnp.arcsin(a), jnp.arccos(a), jnp.arctanh(a)), V / 4),
    "hyperbolic": (lambda a: (jnp.sinh(a), jnp.cosh(a), jnp.tanh(a), jnp.arcsinh(a)), V),
    "arcosh": (lambda a: jnp.arccosh(a + 1.0), POSITIVE),
    "exponentials": (
        lambda a: (jnp.exp(a), jnp.expm1(a), jnp.log(a), jnp.log1p(a), a**1.7, lax.exp2(a)),
        POSITIVE,
    ),
    "special": (
        lambda a: (
            lax.erf_inv(a / 9.0),
            lax.erf(a),
            lax.erfc(a),
            lax.lgamma(a),
            lax.logistic(a),
            jnp.cbrt(a),
        ),
        POSITIVE,
    ),
    "sums of many": (
        lambda a: (a.sum(), a.sum(axis=1), a.prod(axis=0), jnp.cumsum(a), a.mean()),
        A,
    ),
    "cumulated": (lambda a: (jnp.cumprod(a), lax.cumsum(a, reverse=True)), V),
    "remainder": (lambda a: (lax.rem(a, 0.3), jnp.mod(a, 0.3)), V),
    "products": (
        lambda a, b, w: (
            a @ b,
            w @ b,
            jnp.einsum("bij,bkj->bik", w, w),
            b[:, 0] @ b[:, 1],
            w[0].T @ w[1],
        ),
        A,
        B,
        WIDE,
    ),
    "cholesky": (jnp.linalg.cholesky, SPD),
    "cholesky in a batch": (jnp.linalg.cholesky, np.stack([SPD, 2 * SPD])),
    "cholesky of nothing positive": (jnp.linalg.cholesky, -SPD),
    "cholesky of what is not positive in the end": (
        jnp.linalg.cholesky,
        SPD - 1e3 * np.diag([0.0, 0.0, 0.0, 0.0, 1.0]),
    ),
    "solve": (
        lambda L, b: [
            lax.linalg.triangular_solve(
                L, b, left_side=True, lower=lower, transpose_a=turned, unit_diagonal=unit
            )
            for lower in (True, False)
            for turned in (True, False)
            for unit in (True, False)
        ],
        SPD,
        SQUARE[:, :2],
    ),
    "solve from the right": (
        lambda L, b: [
            lax.linalg.triangular_solve(L, b, left_side=False, lower=lower, transpose_a=turned)
            for lower in (True, False)
            for turned in (True, False)
        ],
        SPD,
        SQUARE[:2],
    ),
    "qr": (lambda w: (jnp.linalg.qr(w), jnp.linalg.qr(w, mode="r")), WIDE),
    "qr of a wide one": (jnp.linalg.qr, A),
    "qr, all of q": (lambda w: jnp.linalg.qr(w, mode="complete"), WIDE[0]),
    "qr of a triangle": (lambda a: jnp.linalg.qr(jnp.triu(a)), SQUARE),
    "inverse of a matrix": (lambda a: (jnp.linalg.inv(a), jnp.linalg.solve(a, a[0])), SQUARE),
    "exponential of a matrix": (jax.scipy.linalg.expm, 0.1 * SQUARE),
    "eigenvalues": (lambda a: jnp.linalg.eigvalsh(a), SPD),
}
CASES = {
    **{k: (0.0, v) for k, v in EXACT.items()},
    **{k: (30 * ROUNDING, v) for k, v in ROUNDED.items()},
}


@pytest.mark.parametrize("unroll", [None, 0], ids=["written out", "in loops"])
@pytest.mark.parametrize("name", CASES)
def test_it_gives_what_jax_gives(name, unroll):
    within, (function, *args) = CASES[name]
    # XLA sums in an order of its own.
    same_in_c(function, *args, within=within, unroll=unroll)


# Names of older versions of JAX, and what JAX itself writes only in some transformations.
ELSEWHERE = {
    *("pjit", "closed_call", "core_call", "remat", "remat2", "custom_vjp_call_jaxpr", "custom_lin"),
    *("copy", "copy_p", "device_put", "add_any", "reduce_prod", "custom_vjp_call", "le_to"),
    *("igamma", "igammac", "random_gamma_grad", "bessel_i0e", "regularized_incomplete_beta"),
    *("digamma", "expand_dims", "lt_to", "checkpoint"),
}


def test_every_rule_has_a_case():
    seen = set()
    for _, (function, *args) in CASES.values():
        seen |= set(primitives(jax.make_jaxpr(function)(*args).jaxpr))
    assert set(RULES) - seen - ELSEWHERE == set()


def test_every_primitive_of_jax_has_a_rule_or_a_reason():
    modules = published, lax, lax.linalg
    names = {getattr(m, key).name for m in modules for key in dir(m) if key.endswith("_p")}
    assert names - set(RULES) - set(REFUSED) == set()
    assert set(REFUSED) & set(RULES) == set()


def test_vectors_of_a_symmetric_matrix_are_its_vectors():
    # Their signs are free, so what they promise is checked: A v = w v, v'v = 1, in order.
    for unroll in (None, 0):
        values, vectors = in_c(lambda a: tuple(jnp.linalg.eigh(a)), SPD, unroll=unroll)(SPD)
        np.testing.assert_allclose(SPD @ vectors, vectors * values, rtol=0, atol=1e-14)
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(5), rtol=0, atol=1e-14)
        assert np.all(np.diff(values) > 0)


@pytest.mark.parametrize("spoilt", [np.nan, np.inf])
def test_a_matrix_that_is_not_finite_has_no_eigenvalues(spoilt):
    A = SPD.copy()
    A[2, 1] = A[1, 2] = spoilt
    assert np.all(np.isnan(in_c(jnp.linalg.eigvalsh, A)(A)))


def test_a_primitive_without_a_rule_is_named_with_its_line():
    def asks(x):
        return jnp.linalg.svd(x[None])[1]  # this line

    with pytest.raises(
        ProgramError, match=r"test_primitives.py:\d+: .*'svd'.*: there is no "
    ) as caught:
        trace(asks, V)
    line = int(caught.value.where.rpartition(":")[2])
    with open(__file__) as text:
        assert "this line" in text.read().splitlines()[line - 1]


def test_single_precision_is_refused_with_its_line():
    with pytest.raises(ProgramError, match="float32") as caught:
        trace(lambda x: x.astype(jnp.float32), V)
    assert "test_primitives.py" in caught.value.where
