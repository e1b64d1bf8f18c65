"""Reports of the memories in the last state of a run.

Nothing can be raised in compiled code. A memory whose type has a method ``audit(start, again,
time)`` is asked when the numbers are there, wherever in a state it lies; the filters around it need
not know.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from jax.tree_util import tree_flatten, tree_leaves

Again = Callable[[Any], Any]  # a run once more, from another first state or memory to the last one


def reports(node: Any) -> bool:
    """Whether a part of a state is a memory that is asked."""
    return hasattr(type(node), "audit")


def audit(start: Any, final: Any, again: Again | None, time: Any) -> None:
    """Ask every memory of a run what it has to report.

    Args:
        start: the state that the run began with, or a part of it.
        final: the same that it ended with.
        again: runs once more from another `start` to another `final`; None where samples came one
            by one. A memory gets its own: from another first memory to its last.
        time: (T,) seconds of the steps, or None.

    Raises:
        Exception: what a memory reports.
    """
    first, shape = tree_flatten(start, is_leaf=reports)
    for i, last in enumerate(tree_leaves(final, is_leaf=reports)):
        if reports(last):

            def rerun(memory: Any, i: int = i) -> Any:
                assert again is not None
                ended = again(shape.unflatten([*first[:i], memory, *first[i + 1 :]]))
                return tree_leaves(ended, is_leaf=reports)[i]

            last.audit(first[i], None if again is None else rerun, time)
