"""Foldings of a graph, and those that it must not make."""

import numpy as np
import pytest

from robins.program import Graph


@pytest.fixture
def graph():
    return Graph()


@pytest.fixture
def x(graph):
    return graph.input(0, "real")


def number(graph, value, kind="real"):
    return graph.constant(value, kind)


def test_equal_nodes_are_one(graph, x):
    y = graph.input(1, "real")
    assert graph.apply("add", x, y) == graph.apply("add", y, x)
    assert graph.apply("sub", x, y) != graph.apply("sub", y, x)
    assert number(graph, 0.0) != number(graph, -0.0)
    assert number(graph, 1.0) != number(graph, 1, "whole")
    assert number(graph, np.nan) == number(graph, np.nan)


@pytest.mark.parametrize(
    ("op", "value", "order", "left"),
    [
        ("add", 0.0, 1, "x"),
        ("add", 0.0, -1, "x"),
        ("sub", 0.0, 1, "x"),
        ("mul", 1.0, 1, "x"),
        ("mul", 0.0, -1, 0.0),
        ("div", 1.0, 1, "x"),
        ("div", 0.0, -1, 0.0),
    ],
)
def test_zeros_and_ones_leave_nothing_to_do(graph, x, op, value, order, left):
    found = graph.apply(op, *(x, number(graph, value))[::order])
    assert found == (x if left == "x" else number(graph, left))


def test_nothing_is_folded_that_a_nan_an_infinity_or_a_sign_would_undo(graph, x):
    zero = number(graph, 0.0)
    # x - x and x / x are NaN of an infinity, x == x is false of a NaN, 0 - x is no -x of a zero.
    for op, args in {
        "sub": (x, x),
        "div": (x, x),
        "eq": (x, x),
        "ne": (x, x),
        "le": (x, x),
        "is_finite": (x,),
    }.items():
        assert graph.op[graph.apply(op, *args)] == op
    assert graph.op[graph.apply("sub", zero, x)] == "sub"
    assert graph.op[graph.apply("mul", x, number(graph, -1.0))] == "neg"


def test_known_numbers_are_computed(graph):
    two, three = number(graph, 2.0), number(graph, 3.0)
    assert graph.known(graph.apply("pow", two, three)) == 8.0
    assert graph.known(graph.apply("lt", two, three))
    assert graph.known(graph.convert(number(graph, -2.7), "whole")) == -2
    with np.errstate(all="raise"):
        assert graph.known(graph.apply("div", two, number(graph, 0.0))) == np.inf


def test_choices_that_are_none(graph, x):
    y, c = graph.input(1, "real"), graph.input(0, "flag")
    yes, no = number(graph, True, "flag"), number(graph, False, "flag")
    assert graph.select(yes, x, y) == x
    assert graph.select(no, x, y) == y
    assert graph.select(c, x, x) == x
    assert graph.select(graph.apply("not", c), x, y) == graph.select(c, y, x)
    assert graph.select(c, yes, no) == c
    assert graph.select(c, no, yes) == graph.apply("not", c)
    assert graph.pick([x, y], number(graph, 1, "whole")) == y


def test_what_no_result_needs_is_left_out(graph, x):
    used, unused = graph.apply("sin", x), graph.apply("cos", x)
    assert graph.live([used]) == [x, used]
    assert unused not in graph.live([used])


def test_of_what_a_loop_keeps_only_what_is_read_is_computed(graph, x):
    loop = graph.open([x], 3)
    read, unread = (graph.apply(op, loop.leaves[0]) for op in ("sin", "cos"))
    loop.next, loop.kept = [read], [read, unread, x, number(graph, 0.0)]
    _, (first, other, same, zero) = graph.close(loop)
    assert same == [x] * 3  # of all rounds, no array
    assert zero == [number(graph, 0.0)] * 3
    assert len({*first, *other}) == 6
    assert unread not in graph.live([first[1]])
    assert unread in graph.live([other[2]])
    assert graph.kept(graph.live([other[2]])) == {(loop.scope, 1): unread}


def test_what_does_not_change_is_computed_before_a_loop(graph, x):
    loop = graph.open([x], 3)
    outside = graph.apply("sin", x)
    inside = graph.apply("mul", loop.leaves[0], outside)
    loop.next = [inside]
    ((after,), _) = graph.close(loop)
    assert (graph.scope[outside], graph.scope[inside], graph.scope[after]) == (0, loop.scope, 0)
    assert graph.live([after]) == sorted(
        {x, *loop.leaves, outside, inside, *graph.args[after], after}
    )
