"""Checks of annotations at every call: shapes by jaxtyping, types by beartype.

jaxtyping binds the arguments of each call and checks types twice, which takes twenty times as long
as beartype alone. Most functions name no shape, and need beartype alone.
"""

import ast
import builtins
import functools
import inspect
import types
from collections.abc import Callable
from typing import Any

import jaxtyping

_SHAPED = jaxtyping.jaxtyped
# A call for each node and register of a program, with whole numbers: checking them takes three
# times as long as all that they do.
CALLED_FOR_NODES = {"robins.program.nodes", "robins.program.tape"}
FUNCTION = "__beartype_func"  # what a wrapper of beartype calls
# A function within another is defined at each call of that, and to write its checks takes a hundred
# times as long as to call it: they are written once for each text. None is for what names shapes.
PATTERNS: dict[tuple[str, types.CodeType], types.FunctionType | None] = {}


def install(package: str) -> Any:
    """Check the functions of a package that is imported from here on; a context ends it."""
    jaxtyping.jaxtyped = checked
    return jaxtyping.install_import_hook(package, "beartype.beartype")


def checked(*, typechecker: Callable) -> Callable:
    """`jaxtyping.jaxtyped` for what names shapes, else the checker of types."""

    def fresh(what: Any) -> Any:
        if inspect.isfunction(what) and what.__module__ in CALLED_FOR_NODES:
            return what
        return (_SHAPED(typechecker=typechecker) if shaped(what) else typechecker)(what)

    def decorate(what: Any) -> Any:
        if not inspect.isfunction(what) or "<locals>" not in what.__qualname__:
            return fresh(what)
        text = what.__module__, what.__code__  # that of another file may be equal
        if text not in PATTERNS:
            PATTERNS[text] = None if shaped(what) else fresh(unbound(what))
        pattern = PATTERNS[text]
        return fresh(what) if pattern is None else like(pattern, what)

    return decorate


def unbound(what: types.FunctionType) -> types.FunctionType:
    """A function of the same text that holds nothing of what is around it."""
    cells = tuple(types.CellType() for _ in what.__code__.co_freevars)
    made = types.FunctionType(what.__code__, what.__globals__, closure=cells)
    functools.update_wrapper(made, what)
    del made.__wrapped__
    return made


def like(pattern: types.FunctionType, what: types.FunctionType) -> types.FunctionType:
    """A function with the checks that beartype wrote for one of the same text."""
    given = pattern.__kwdefaults__ or {}
    if FUNCTION not in given:
        return what  # there was nothing to check
    made = types.FunctionType(pattern.__code__, pattern.__globals__)
    made.__kwdefaults__ = given | {FUNCTION: what}
    made.__dict__.update(pattern.__dict__)
    return functools.update_wrapper(made, what)


def shaped(what: Any) -> bool:
    """True for all but functions whose annotations have known names and none of jaxtyping's."""
    if not inspect.isfunction(what):
        return True
    known = vars(builtins) | what.__globals__
    texts = [text for text in what.__annotations__.values() if isinstance(text, str)]
    nodes = [node for text in texts for node in ast.walk(ast.parse(text, mode="eval"))]
    names = {node.id for node in nodes if isinstance(node, ast.Name)}
    if len(texts) < len(what.__annotations__) or not names <= known.keys():
        return True
    kinds = [known[name] for name in names]
    return any("jaxtyping" in f"{type(x).__module__} {getattr(x, '__module__', '')}" for x in kinds)
