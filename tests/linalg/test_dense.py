"""Laws of the factor algebra, over sizes, scales and ranks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from robins import linalg

EPS = np.finfo(float).eps
SIZES = [1, 3, 8]

tria, downdate, guard = (jax.jit(f) for f in (linalg.tria, linalg.downdate, linalg.guard))
block_factor, independent_rows = jax.jit(linalg.block_factor), jax.jit(linalg.independent_rows)


def draw(seed: int, n: int, k: int, decades: float = 0.0) -> np.ndarray:
    """A random matrix whose rows differ in size by up to this many decades."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, k)) * 10.0 ** rng.uniform(-decades / 2, decades / 2, (n, 1))


def assert_factor(L, P, tolerance):
    """L is lower triangular with L L' = P, each entry against the sizes of its row and column."""
    L, P = np.asarray(L), np.asarray(P)
    np.testing.assert_array_equal(L, np.tril(L))
    size = np.sqrt(np.diag(P))
    assert np.all(np.abs(L @ L.T - P) <= tolerance * np.outer(size, size))


@pytest.mark.parametrize(("n", "k"), [(1, 1), (1, 12), (3, 4), (8, 1), (8, 12)])
@pytest.mark.parametrize("decades", [0.0, 20.0])
def test_tria_is_a_factor_of_the_sum_of_squares(n, k, decades):
    A, B = draw(n + k, n, k, decades), draw(7, n, 2)
    assert_factor(tria(jnp.array(A)), A @ A.T, 20 * EPS)
    both = tria(jnp.array(A), jnp.array(B))
    assert_factor(both, A @ A.T + B @ B.T, 20 * EPS)
    assert np.all(np.diagonal(both) >= 0.0)
    assert not np.any(tria(jnp.zeros((n, k))))


@pytest.mark.parametrize(("a", "b"), [((2, 3), (1, 2)), ((0, 0), (3, 3)), ((2, 0), (0, 2))])
def test_block_diagonal_leaves_the_rest_zero(a, b):
    A, B = draw(1, *a), draw(2, *b)
    found = linalg.block_diagonal(jnp.array(A), jnp.array(B))
    np.testing.assert_array_equal(found, scipy.linalg.block_diag(A, B))


def test_tria_is_cholesky_where_there_is_one():
    A = draw(3, 5, 9)
    np.testing.assert_allclose(
        tria(jnp.array(A)), np.linalg.cholesky(A @ A.T), rtol=1e-12, atol=1e-14
    )


def test_tria_keeps_what_a_covariance_cannot_hold():
    # Two readings that differ by 1e-10 of their size: in the covariance the 1e-20 is rounded away.
    small = 1e-10
    L = tria(jnp.array([[1.0, 0.0], [1.0, small]]))
    assert float(L[1, 1]) == pytest.approx(small, rel=1e-5)
    assert np.linalg.det(np.array([[1.0, 1.0], [1.0, 1.0 + small**2]])) == 0.0


@pytest.mark.parametrize("decades", [0.0, 20.0])
@pytest.mark.parametrize(("m", "n"), [(1, 1), (1, 4), (3, 2), (3, 6)])
def test_block_factor_solves_the_update(m, n, decades):
    H, S, R = draw(1, m, n), np.tril(draw(2, n, n)), np.tril(draw(3, m, m))
    scale = 10.0 ** np.random.default_rng(4).uniform(-decades / 2, decades / 2, n)
    S, H = S * scale[:, None], H / scale
    X, Y, Z = (
        np.asarray(block) for block in block_factor(jnp.array(H @ S), [jnp.array(R)], jnp.array(S))
    )
    P, P_yy = S @ S.T, H @ S @ S.T @ H.T + R @ R.T
    K = np.linalg.solve(P_yy, H @ P).T
    assert_factor(X, P_yy, 50 * EPS)
    np.testing.assert_allclose(
        np.linalg.solve(X.T, Y.T).T / scale[:, None], K / scale[:, None], atol=1e-11
    )
    after = (np.eye(n) - K @ H) @ P @ (np.eye(n) - K @ H).T + K @ R @ R.T @ K.T
    size = np.sqrt(np.diag(P))
    assert np.all(np.abs(Z @ Z.T - after) <= 1e-11 * np.outer(size, size))


def test_block_factor_takes_a_deficit_from_the_innovation_only():
    H, S, R, v = draw(1, 2, 3), np.tril(draw(2, 3, 3)), draw(3, 2, 2), draw(4, 2, 1)[:, 0] / 10
    X, Y, Z = block_factor(jnp.array(H @ S), [jnp.array(R)], jnp.array(S), jnp.array(v))
    left = np.concatenate([X, Y]) @ np.concatenate([X, Y]).T
    P_yy, P_xy = H @ S @ S.T @ H.T + R @ R.T - np.outer(v, v), S @ S.T @ H.T
    np.testing.assert_allclose(left[:2, :2], P_yy, rtol=1e-12)
    np.testing.assert_allclose(left[2:, :2], P_xy, rtol=1e-12)
    np.testing.assert_allclose(Y @ Y.T + Z @ Z.T, S @ S.T, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("decades", [0.0, 16.0])
def test_downdate_undoes_an_update(n, decades):
    A = draw(n, n, n + 1, decades)
    L, v = np.tril(A[:, :n]), A[:, n]
    more = tria(jnp.array(L), jnp.array(v)[:, None])
    p = np.linalg.solve(more, v)  # what is left of one: the subtraction cannot know it better
    assert_factor(downdate(more, jnp.array(v)), L @ L.T, 100 * EPS / (1 - p @ p))


def test_downdate_beyond_the_covariance_is_nan():
    L = jnp.array(np.tril(draw(1, 3, 3)))
    assert np.all(np.isnan(downdate(L, 1.001 * L[:, 0] + L[:, 1])))
    # out of the range of a singular covariance, however short
    flat = jnp.diag(jnp.array([1.0, 0.0, 1.0]))
    assert np.all(np.isnan(downdate(flat, jnp.array([0.0, 1e-3, 0.0]))))


def test_downdate_of_a_singular_covariance_within_its_range():
    A = draw(5, 4, 2)
    v = A @ np.array([0.3, -0.4])
    left = downdate(tria(jnp.array(A)), jnp.array(v))
    np.testing.assert_allclose(left @ left.T, A @ A.T - np.outer(v, v), rtol=1e-11, atol=1e-14)
    nothing = downdate(jnp.zeros((3, 3)), jnp.zeros(3))
    np.testing.assert_array_equal(nothing, np.zeros((3, 3)))


@pytest.mark.parametrize("m", [3, 7])  # written out, and as a loop
@pytest.mark.parametrize("seed", range(6))
def test_independent_rows_are_those_that_raise_the_rank(m, seed):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(m, m + 2))
    for i in rng.choice(m, size=m // 2, replace=False):
        rows[i] = rng.normal(size=i) @ rows[:i] if i else 0.0
    rows *= 10.0 ** rng.uniform(-12, 8, (m, 1))
    found = np.asarray(independent_rows(jnp.array(rows)))
    unit = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    rank = [np.linalg.matrix_rank(unit[:i], tol=1e-13) for i in range(m + 1)]
    np.testing.assert_array_equal(found, np.diff(rank) > 0)
    assert 0 < found.sum() < m


def test_rows_with_a_little_of_their_own_or_a_fault_are_independent():
    rows = jnp.array([[1.0, 1.0, 0.0], [1.0, 1.0, 1e-13], [1.0, 1.0, 1e-15], [jnp.nan, 0.0, 0.0]])
    assert independent_rows(rows).tolist() == [True, True, False, True]


def test_two_passes_are_enough_and_one_is_not():
    # The second row all but repeats the first, so its direction is only known to 1e-6 after one.
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 9))
    rows = np.array([a, a + 1e-10 * b, 0.3 * a + (a + 1e-10 * b), b])
    assert independent_rows(jnp.array(rows)).tolist() == [True, True, False, True]


def test_a_row_may_be_summed_from_larger_numbers():
    rows = jnp.array([[1e-9, 0.0], [0.0, 1e-6]])
    assert independent_rows(rows, jnp.array([1e6, 1e6])).tolist() == [False, True]
    assert independent_rows(rows, jnp.zeros(2)).tolist() == [True, True]
    lost = linalg.lost_in_rounding(rows, jnp.array([1e6, 1.0]))
    assert lost.tolist() == [[True, True], [True, False]]
    assert not linalg.lost_in_rounding(jnp.array([[jnp.nan]]), jnp.ones(1))[0, 0]


@pytest.mark.parametrize("decades", [0.0, 20.0])
@pytest.mark.parametrize("n", [3, 6])
def test_guard_solves_with_the_independent_rows_alone(n, decades):
    A = draw(n, n, n, decades)
    A[1] = 2.0 * A[0]  # nothing of its own, in the middle: QR alone loses the rows after it
    A[n - 2] = 0.0
    keep = [i for i in range(n) if i not in (1, n - 2)]
    solid, independent = guard(tria(jnp.array(A)))
    np.testing.assert_array_equal(np.flatnonzero(independent), keep)
    e = A @ np.arange(1.0, n + 1.0)
    white = linalg.solve_lower(solid, jnp.array(e)[:, None])[:, 0]
    small = A[keep] / np.linalg.norm(A[keep], axis=1, keepdims=True)
    scaled = e[keep] / np.linalg.norm(A[keep], axis=1)
    assert float(white @ white) == pytest.approx(
        float(scaled @ np.linalg.solve(small @ small.T, scaled)), rel=1e-9
    )
    assert not np.any(white[np.array([1, n - 2])])


@pytest.mark.parametrize("n", SIZES)
def test_solves_are_inverses(n):
    L = np.tril(draw(n, n, n)) + 2 * np.eye(n)
    B = draw(n + 1, n, 3)
    J, K = jnp.array(L), jnp.array(B)
    np.testing.assert_allclose(L @ linalg.solve_lower(J, K), B, atol=1e-12)
    np.testing.assert_allclose(L.T @ linalg.solve_lower_transposed(J, K), B, atol=1e-12)
    np.testing.assert_allclose(L @ L.T @ linalg.solve_spd(J, K), B, atol=1e-11)


@pytest.mark.parametrize("rank", [0, 1, 3, 4])
def test_roots_and_bounds_of_a_covariance(rank):
    A = draw(rank, 4, rank) if rank else np.zeros((4, 1))
    P = A @ A.T
    root = np.asarray(linalg.symmetric_root(jnp.array(P)))
    np.testing.assert_allclose(root, root.T, atol=1e-15)
    np.testing.assert_allclose(root @ root, P, atol=1e-14 * max(1, np.max(P)))
    low, high = linalg.eigenvalue_bounds(jnp.array(P))
    singular = np.linalg.svd(A, compute_uv=False)
    assert float(high) == pytest.approx(singular[0] ** 2, rel=1e-12, abs=1e-300)
    assert float(low) == pytest.approx(
        singular[-1] ** 2 if rank == 4 else 0.0, abs=1e-14 * max(1.0, singular[0] ** 2)
    )


def test_half_a_log_determinant():
    L = np.tril(draw(1, 4, 4))
    chosen = np.array([True, False, True, True])
    got = linalg.log_diagonal(jnp.array(L), jnp.array(chosen))
    assert float(got) == pytest.approx(np.log(np.abs(np.diag(L)[chosen])).sum(), rel=1e-14)
    P = L @ L.T
    everything = linalg.log_diagonal(linalg.cholesky(jnp.array(P)), jnp.ones(4, dtype=bool))
    assert float(everything) == pytest.approx(0.5 * np.linalg.slogdet(P)[1], rel=1e-12)


# ------------------------------------------------------------------------------- derivatives


def slope_by_differences(f, A, dA, step):
    return (np.asarray(f(jnp.array(A + step * dA))) - np.asarray(f(jnp.array(A - step * dA)))) / (
        2 * step
    )


@pytest.mark.parametrize("k", [2, 4, 7])
def test_derivative_of_tria(k):
    A, dA = draw(1, 4, k), draw(2, 4, k)
    if k < 4:
        dA = draw(2, 4, 4) @ A  # stays singular, so that there is a derivative
    L, dL = jax.jvp(tria, (jnp.array(A),), (jnp.array(dA),))
    np.testing.assert_allclose(dL @ L.T + L @ dL.T, dA @ A.T + A @ dA.T, rtol=1e-10, atol=1e-12)
    if k >= 4:
        want = slope_by_differences(tria, A, dA, 1e-6)
        np.testing.assert_allclose(dL, want, rtol=1e-7, atol=1e-8)


def test_derivatives_of_tria_agree_forward_and_reverse():
    A = jnp.array(draw(1, 3, 5))
    weight = jnp.array(draw(2, 3, 3))

    def total(A):
        return jnp.sum(weight * tria(A))

    gradient = jax.jit(jax.grad(total))
    np.testing.assert_allclose(gradient(A), jax.jit(jax.jacfwd(total))(A), rtol=1e-12, atol=1e-13)
    two = jax.jvp(gradient, (A,), (jnp.ones_like(A),))[1]
    want = slope_by_differences(gradient, np.asarray(A), np.ones((3, 5)), 1e-6)
    np.testing.assert_allclose(two, want, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("rows", [[0], [1], [0, 2], [0, 1, 2]])
def test_derivatives_of_tria_are_finite_with_rows_of_zeros(rows):
    A = draw(1, 3, 4)
    A[rows] = 0.0
    dA = draw(2, 3, 4)
    dA[rows] = 0.0
    L, dL = jax.jvp(tria, (jnp.array(A),), (jnp.array(dA),))
    np.testing.assert_allclose(dL @ L.T + L @ dL.T, dA @ A.T + A @ dA.T, atol=1e-13)
    gradient = jax.grad(lambda A: jnp.sum(tria(A) ** 2))(jnp.array(A))
    np.testing.assert_allclose(gradient, 2 * A, atol=1e-13)  # trace of A A'


# ------------------------------------------------------------------------------- at the boundary


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("decades", [0.0, 20.0])
def test_factor_of_a_covariance(n, decades):
    A = draw(n, n, n + 3, decades)
    P = A @ A.T
    assert_factor(linalg.factor(P), P, 30 * EPS)


def test_factor_of_a_singular_covariance_has_no_noise_of_its_own():
    column = np.array([1.0, 0.05, 0.0, 1e-9])
    P = np.outer(column, column)
    L = linalg.factor(P)
    assert_factor(L, P, 10 * EPS)
    assert independent_rows(L).tolist() == [True, False, False, False]
    for seed in range(10):
        A = draw(seed, 5, 2, 4.0)
        L = linalg.factor(A @ A.T)
        assert_factor(L, A @ A.T, 30 * EPS)
        assert np.linalg.matrix_rank(L / np.linalg.norm(A, axis=1, keepdims=True), tol=1e-13) == 2
    np.testing.assert_array_equal(linalg.factor(np.zeros((3, 3))), np.zeros((3, 3)))
    assert linalg.factor(np.zeros((0, 0))).shape == (0, 0)


def test_factor_takes_any_real_kind():
    P = np.array([[4, 2], [2, 5]])
    for kind in ("int32", "float32", ">f8"):
        np.testing.assert_array_equal(linalg.factor(P.astype(kind)), linalg.factor(P))
    np.testing.assert_allclose(linalg.factor(P), scipy.linalg.cholesky(P, lower=True), rtol=1e-15)


@pytest.mark.parametrize(
    ("P", "message"),
    [
        (np.ones(3), r"^start has shape \(3,\); a square matrix is wanted"),
        (np.ones((2, 3)), r"^start has shape \(2, 3\)"),
        (np.array([[1.0, np.nan], [np.nan, 1.0]]), "^start has entries that are not finite"),
        (np.array([[np.inf, 0.0], [0.0, 1.0]]), "^start has entries that are not finite"),
        (np.array([[1.0, 0.1], [0.0, 1.0]]), "^start is not symmetric: mend it with"),
        # asymmetry and indefiniteness are seen in the units of each state
        (np.array([[1e-20, 1e-12], [0.0, 1.0]]), "^start is not symmetric"),
        (
            np.array([[1e-20, 2e-10], [2e-10, 1.0]]),
            "^start is not positive semidefinite.*eigenvalue is -1",
        ),
        (np.diag([1.0, -1e-20]), r"semidefinite: its variance at \(1, 1\), .* is -1e-20; if"),
        (np.array([[0.0, 1e-3], [1e-3, 1.0]]), "^start is not positive semidefinite"),
    ],
)
def test_factor_refuses_what_is_no_covariance(P, message):
    with pytest.raises(ValueError, match=message):
        linalg.factor(P, "start")


# ------------------------------------------------------------------------------- small change


def test_deviations_are_a_diagonal_factor():
    noise = jnp.array([1.0, 2.0])
    np.testing.assert_array_equal(linalg.as_factor(noise), np.diag([1.0, 2.0]))
    np.testing.assert_array_equal(linalg.as_factor(jnp.ones((2, 1))), np.ones((2, 1)))


def test_all_of_it_batches():
    A = jnp.array(np.stack([draw(s, 3, 5) for s in range(4)]))
    L = jax.vmap(tria)(A)
    v = 0.3 * A[:, :, 0]
    found = (L, jax.vmap(downdate)(L, v), *jax.vmap(guard)(L))
    for i in range(4):
        alone = (tria(A[i]), downdate(L[i], v[i]), *guard(L[i]))
        for one, many in zip(alone, found, strict=True):
            np.testing.assert_allclose(one, many[i], rtol=1e-13, atol=1e-15)
