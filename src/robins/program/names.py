"""Texts of values, equal in every process for equal values only."""

from __future__ import annotations

import enum
import json
import sys
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

NAMED = {"robins", "builtins", "jax"}  # packages whose functions and classes are known by name
NONE = "builtins:NoneType"
PLAIN = (type(None), bool, int, float, str, bytes)
if TYPE_CHECKING:  # a structure of JAX is no class to a checker
    Tree = Any
else:
    Tree = jax.tree_util.PyTreeDef
Json = Any


def by_name(value: Any) -> str:
    """Return a text that is equal for equal values only, in any process with the same packages.

    Args:
        value: numbers, texts, pytree structures, functions and classes, nested in tuples and lists.

    Raises:
        LookupError: a function or class that is not of a module of robins, JAX or Python, such as
            one of a user's file, which may change, or one made in a function; or a value of another
            type.
    """
    if type(value) in PLAIN:
        return repr(value)
    match value:
        case enum.Enum():
            return f"{by_name(type(value))}.{value.name}"
        case np.dtype():
            return value.str
        case tuple() | list():
            kind = "" if type(value) is tuple else by_name(type(value))
            return f"{kind}({','.join(map(by_name, value))})"
        case jax.tree_util.PyTreeDef():
            return f"{by_name(value.node_data())}{by_name(value.children())}"
    name = f"{getattr(value, '__module__', '')}:{getattr(value, '__qualname__', '')}"
    if _named(name) is not value:
        raise LookupError(repr(value))
    return name


def _named(name: str) -> Any:
    """Function or class of a name, in a module that is loaded.

    Raises:
        LookupError: there is none, or it is of another package than those of `NAMED`.
    """
    module, _, path = name.partition(":")
    if name == NONE:  # no attribute of its module
        return type(None)
    found: Any = sys.modules.get(module) if module.split(".")[0] in NAMED else None
    for part in path.split("."):
        found = getattr(found, part, None)
    if found is None:
        raise LookupError(name)
    return found


def as_json(tree: Tree) -> Json | None:
    """JSON data of a pytree structure; None where `of_json` would not restore it."""
    try:
        text = json.loads(json.dumps(_nodes(tree)))
    except (LookupError, TypeError):
        return None
    return text if of_json(text) == tree else None


def _nodes(tree: Tree) -> Json:
    """Class, node data and children of a structure; an empty list for a leaf."""
    node = tree.node_data()
    return [] if node is None else [by_name(node[0]), node[1], list(map(_nodes, tree.children()))]


def of_json(text: Json) -> Tree | None:
    """Pytree structure from data of `as_json`; None where a class of it is not loaded."""
    if not text:
        return jax.tree_util.tree_structure(0)
    kind, about, inner = text
    inside = list(map(of_json, inner))
    try:
        made = jax.tree_util.PyTreeDef.from_node_data_and_children
        about = about if kind == by_name(dict) else _tuples(about)
        return made(jax.tree_util.default_registry, (_named(kind), about), inside)
    except (AttributeError, LookupError, TypeError, ValueError):  # also an older version of JAX
        return None


def _tuples(x: Json) -> Json:
    return tuple(map(_tuples, x)) if isinstance(x, list) else x
