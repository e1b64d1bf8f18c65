"""Checks of annotations at every call: shapes by jaxtyping, types by beartype.

jaxtyping binds the arguments of each call and checks types twice, which takes twenty times as long
as beartype alone. Most functions name no shape, and need beartype alone.
"""

import ast
import builtins
import inspect
from collections.abc import Callable
from typing import Any

import jaxtyping

_SHAPED = jaxtyping.jaxtyped
# A call for each node and register of a program, with whole numbers: checking them takes three
# times as long as all that they do.
CALLED_FOR_NODES = {"robins.program.nodes", "robins.program.tape"}


def install(package: str) -> None:
    """Check the functions of a package that is imported from here on."""
    jaxtyping.jaxtyped = checked
    jaxtyping.install_import_hook(package, "beartype.beartype")


def checked(*, typechecker: Callable) -> Callable:
    """`jaxtyping.jaxtyped` for what names shapes, else the checker of types."""

    def decorate(what: Any) -> Any:
        if inspect.isfunction(what) and what.__module__ in CALLED_FOR_NODES:
            return what
        return (_SHAPED(typechecker=typechecker) if shaped(what) else typechecker)(what)

    return decorate


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
