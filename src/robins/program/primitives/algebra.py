"""Products and factorisations of small matrices, written out in scalars.

Written out, they use every structural zero of a matrix. Above the size that `trace` is given, they
are calls of a routine of `routines.h` instead. Eigenvalues and LU always are, as their steps depend
on the numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from robins.program.kinds import Equation
from robins.program.nodes import Node
from robins.program.refusal import ProgramError
from robins.program.walk import JaxprWriter, Nodes, flat, rule, shaped


def per_matrix(
    walk: JaxprWriter, function: Callable[..., Sequence[Nodes]], *stacks: Nodes
) -> list[Nodes]:
    """Apply a function of matrices over their leading axes."""
    lead = stacks[0].shape[:-2]
    flat = [s.reshape(-1, *s.shape[-2:]) for s in stacks]
    each = [function(walk, *matrices) for matrices in zip(*flat, strict=True)]
    return [np.stack(found).reshape(*lead, *found[0].shape) for found in zip(*each, strict=True)]


def call(
    walk: JaxprWriter,
    routine: str,
    sizes: list[int],
    arrays: list[Nodes],
    shapes: Sequence[tuple[int, ...]],
) -> list[Nodes]:
    """Call a routine on arrays, one after the other, and split its results likewise."""
    count = sum(int(np.prod(shape)) for shape in shapes)
    return shaped(walk.graph.block(routine, sizes, flat(arrays), count), shapes)


def dot(walk: JaxprWriter, a: list[Node], b: list[Node]) -> Node:
    """The sum of products, from first to last."""
    graph = walk.graph
    total = graph.constant(0, graph.kind[a[0]] if a else "real")
    for x, y in zip(a, b, strict=True):
        total = graph.apply("add", total, graph.apply("mul", x, y))
    return total


@rule("dot_general")
def _dot_general(walk: JaxprWriter, equation: Equation, a: Nodes, b: Nodes) -> Nodes:
    (over_a, over_b), (with_a, with_b) = equation.params["dimension_numbers"]

    def arranged(x: Nodes, batch: Sequence[int], over: Sequence[int]) -> Nodes:
        free = [k for k in range(x.ndim) if k not in {*batch, *over}]
        lead, rest = [x.shape[k] for k in batch], [x.shape[k] for k in free]
        depth = int(np.prod([x.shape[k] for k in over]))
        moved = x.transpose([*batch, *free, *over])
        return moved.reshape(int(np.prod(lead)), int(np.prod(rest)), depth)

    A, B = arranged(a, with_a, over_a), arranged(b, with_b, over_b)
    found = [_product(walk, x, y) for x, y in zip(A, B, strict=True)]
    shape = equation.outvars[0].aval.shape
    return np.array(found, dtype=np.int64).reshape(shape)


def _product(walk: JaxprWriter, A: Nodes, B: Nodes) -> Nodes:
    """A B' of nodes (m, k) and (n, k)."""
    (m, depth), n = A.shape, B.shape[0]
    zero = [n for n in {*A.ravel().tolist(), *B.ravel().tolist()} if walk.graph._is(n, 0)]
    dense = (~np.isin(A, zero)).astype(int) @ (~np.isin(B, zero)).astype(int).T
    real = A.size and walk.graph.kind[int(A.flat[0])] == "real"
    if real and min(m, n) > 1 and walk.stays_whole(2 * int(dense.sum())):
        return call(walk, "product", [m, depth, n], [A, B], [(m, n)])[0]
    rows = [[dot(walk, x, y) for y in B.tolist()] for x in A.tolist()]
    return np.array(rows, dtype=np.int64).reshape(m, n)


@rule("cholesky")
def _cholesky(walk: JaxprWriter, equation: Equation, P: Nodes) -> list[Nodes]:
    return per_matrix(walk, _cholesky_of, P)


def _cholesky_of(walk: JaxprWriter, P: Nodes) -> tuple[Nodes, ...]:
    """Lower factor by rows; all NaN where a pivot is not positive, as JAX returns it.

    The same in C, for large matrices: `cholesky` in `program/routines.h`.
    """
    n, apply = len(P), walk.graph.apply
    if walk.stays_whole(n**3 // 3):
        return tuple(call(walk, "cholesky", [n], [P], [(n, n)]))
    L = np.full((n, n), walk.graph.constant(0, "real"))
    positive = walk.graph.constant(True, "flag")
    for j in range(n):
        for i in range(j, n):
            rest = P[i, j].item()
            for k in range(j):
                rest = apply("sub", rest, apply("mul", L[i, k].item(), L[j, k].item()))
            if i == j:
                more = apply("lt", walk.graph.constant(0, "real"), rest)
                positive = apply("and", positive, more)
                L[j, j] = apply("sqrt", rest)
            else:
                L[i, j] = apply("div", rest, L[j, j].item())
    nan = walk.graph.constant(np.nan, "real")
    return (walk.each(lambda x: walk.graph.select(positive, x, nan), L),)


@rule("triangular_solve")
def _triangular_solve(walk: JaxprWriter, equation: Equation, A: Nodes, B: Nodes) -> list[Nodes]:
    p = equation.params

    def one(walk: JaxprWriter, A: Nodes, B: Nodes) -> tuple[Nodes]:
        lower = p["lower"]
        if p["transpose_a"]:
            A, lower = A.T, not lower
        if not p["left_side"]:  # X A = B is A' X' = B'
            A, B, lower = A.T, B.T, not lower
        if not lower:  # turned round, an upper triangle is a lower one
            A, B = A[::-1, ::-1], B[::-1]
        X = _solve_lower(walk, A, B, p["unit_diagonal"])
        X = X if lower else X[::-1]
        return (X if p["left_side"] else X.T,)

    return per_matrix(walk, one, A, B)


def _solve_lower(walk: JaxprWriter, A: Nodes, B: Nodes, unit: bool) -> Nodes:
    apply, n = walk.graph.apply, len(A)
    if unit:
        A = np.where(np.eye(n, dtype=bool), walk.graph.constant(1, "real"), A)
    if walk.stays_whole(n * n * B.shape[1]):
        return call(walk, "solve_lower", [n, B.shape[1]], [A, B], [B.shape])[0]
    X = B.copy()
    for j in range(B.shape[1]):
        for i in range(n):
            rest = B[i, j].item()
            for k in range(i):
                rest = apply("sub", rest, apply("mul", A[i, k].item(), X[k, j].item()))
            X[i, j] = apply("div", rest, A[i, i].item())
    return X


@rule("qr")
def _qr(walk: JaxprWriter, equation: Equation, A: Nodes) -> list[Nodes]:
    p = equation.params
    if p.get("pivoting"):
        raise ProgramError("a QR with exchange of columns", "", "use one without")
    wanted = type(equation.outvars[0]).__name__ != "DropVar"

    def one(walk: JaxprWriter, A: Nodes) -> tuple[Nodes, Nodes]:
        return _householder(walk, A, wanted, p["full_matrices"])

    return per_matrix(walk, one, A)


TINY = 1e-290  # squared length of a column tail below which it counts as zero


def _householder(walk: JaxprWriter, A: Nodes, wanted: bool, full: bool) -> tuple[Nodes, Nodes]:
    """Q and R by reflections, with the signs of LAPACK's dgeqrf.

    H = I + g v v' takes a column to beta = -sign(alpha) |column|, with v = (alpha - beta, tail)
    and 1 / g = beta (alpha - beta): one division and one root a column (Golub & Van Loan 2013,
    sec. 5.1). There is no reflection where all entries below the diagonal are zero.
    """
    apply, constant = walk.graph.apply, walk.graph.constant
    m, n = A.shape
    zero, one = constant(0, "real"), constant(1, "real")
    width = m if full else min(m, n)
    upper = np.arange(width)[:, None] <= np.arange(n)
    if walk.stays_whole(2 * m * n * n):
        # Two calls, as one whose results nothing reads is left out: that of Q in most filters.
        (R,) = call(walk, "triangle", [m, n, width], [A], [(width, n)])
        Q, _ = call(walk, "householder", [m, n, width], [A], [(m, width), (width, n)])
        return Q, np.where(upper, R, zero)
    R = A.copy()
    reflections = []
    for k in range(min(m - 1, n)):
        tail = [i for i in range(k + 1, m) if R[i, k] != zero]
        if not tail:
            continue
        alpha = R[k, k].item()
        below = dot(walk, R[tail, k].tolist(), R[tail, k].tolist())
        length = apply("sqrt", apply("add", apply("mul", alpha, alpha), below))
        negative = apply("lt", alpha, zero)
        beta = walk.graph.select(negative, length, apply("neg", length))
        nothing = apply("lt", below, constant(TINY, "real"))
        head = apply("sub", alpha, beta)
        h = walk.graph.select(nothing, one, apply("mul", beta, head))
        g = walk.graph.select(nothing, zero, apply("div", one, h))
        v = [(k, head), *((i, R[i, k].item()) for i in tail)]
        R[k, k] = walk.graph.select(nothing, alpha, beta)
        R[tail, k] = zero
        for j in range(k + 1, n):
            _reflect(walk, R, j, v, g)
        reflections.append((k, v, g))
    Q = np.where(np.eye(m, width, dtype=bool), one, zero)
    if wanted:
        for k, v, g in reversed(reflections):
            for j in range(k, width):
                _reflect(walk, Q, j, v, g)
    return Q, np.where(upper, R[:width], zero)


def _reflect(walk: JaxprWriter, A: Nodes, j: int, v: list[tuple[int, Node]], g: Node) -> None:
    """Add g v v' a to a column a, in place."""
    apply = walk.graph.apply
    along = apply("mul", g, dot(walk, [x for _, x in v], [A[i, j].item() for i, _ in v]))
    for i, x in v:
        A[i, j] = apply("add", A[i, j].item(), apply("mul", along, x))


@rule("eigh")
def _eigh(walk: JaxprWriter, equation: Equation, A: Nodes) -> list[Nodes]:
    """Eigenvectors as columns, and eigenvalues in ascending order."""
    if equation.params.get("subset_by_index") not in (None, (0, A.shape[-1])):
        raise ProgramError("some of the eigenvalues of a matrix", "", "take all of them")
    lower = equation.params["lower"]

    def one(walk: JaxprWriter, A: Nodes) -> tuple[Nodes, Nodes]:
        n = len(A)
        if n == 1:
            return np.full((1, 1), walk.graph.constant(1, "real")), A[0]
        both = np.tril(A) + np.tril(A, -1).T if lower else np.triu(A) + np.triu(A, 1).T
        vectors, values = call(walk, "eigh", [n], [both], [(n, n), (n,)])
        return vectors, values

    return per_matrix(walk, one, A)


@rule("lu")
def _lu(walk: JaxprWriter, equation: Equation, A: Nodes) -> list[Nodes]:
    """L and U in one matrix, the exchanges of rows, and the permutation that they make."""

    def one(walk: JaxprWriter, A: Nodes) -> tuple[Nodes, Nodes, Nodes]:
        m, n = A.shape
        shapes = [(m, n), (min(m, n),), (m,)]
        factors, *rows = call(walk, "lu", [m, n], [A], shapes)
        pivots, order = (walk.each(lambda x: walk.graph.convert(x, "whole"), r) for r in rows)
        return factors, pivots, order

    return per_matrix(walk, one, A)
