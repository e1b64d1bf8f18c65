"""Commands from the page to the bench: only those that the page was offered."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from robins.bench.live.feed import JsonObject
from robins.errors import RobinsError

PLAIN = ("start", "pause", "stop")
LONGEST_S = 3600.0  # duration of a fault; without one it lasts until it is cleared


class CommandError(RobinsError, ValueError):
    """Text from a page that is not a command; the message is for the page."""


def read(
    text: str | bytes,
    faults: Sequence[JsonObject],
    alarms: Sequence[JsonObject] = (),
    says: Sequence[str] = (),
) -> JsonObject:
    """Parse and check a command sent by a page.

    Args:
        text: JSON: `{"do": ...}`, with "label" and "duration_s" (or neither) for "inject", with
            "label" (or not) for "clear", with "label" for "say", with "alarms", their numbers, for
            "acknowledge".
        faults: offered to the page, each with its label.
        alarms: that wait to be acknowledged, the oldest first: "id", "time_s", "text".
        says: labels of the operator messages.

    Returns:
        The command as `LivePage.commands` gives it.

    Raises:
        CommandError: it is none; nothing else is raised, whatever was sent.
    """
    try:
        asked = json.loads(text)
    except (ValueError, RecursionError):
        raise CommandError("a command is a JSON object, this is no JSON") from None
    if not isinstance(asked, dict):
        raise CommandError("a command is a JSON object")
    do = asked.get("do")
    if do in PLAIN:
        _only(asked, {"do"})
        return {"do": do}
    if do == "inject":
        _only(asked, {"do", "label", "duration_s"})
        label, duration_s = asked.get("label"), asked.get("duration_s")
        for f in faults:
            if f["label"] == label:
                return {"do": do, **f, "duration_s": _duration(duration_s)}
        there = ", ".join(f"'{f['label']}'" for f in faults) or "none"
        raise CommandError(f"no fault is labelled {_short(label)}; there are: {there}")
    if do == "clear":
        _only(asked, {"do", "label"})
        label = asked.get("label")
        if label is not None and not isinstance(label, str):
            raise CommandError("the label of a fault is a text")
        return {"do": do, "label": label}
    if do == "say":
        _only(asked, {"do", "label"})
        if (label := asked.get("label")) not in says:
            there = ", ".join(f"'{one}'" for one in says) or "nothing"
            raise CommandError(f"{_short(label)} cannot be said to the parts; there is: {there}")
        return {"do": do, "label": label}
    if do == "acknowledge":
        _only(asked, {"do", "alarms"})
        return {"do": do, **_acknowledged(asked.get("alarms"), alarms)}
    known = ", ".join((*PLAIN, "inject", "clear", "say", "acknowledge"))
    raise CommandError(f"no command {_short(do)}; there are: {known}")


def _acknowledged(ids: Any, alarms: Sequence[JsonObject]) -> JsonObject:
    """Acknowledgement of alarms: their numbers, and a label that names them in a record."""
    if not isinstance(ids, list) or not all(type(one) is int for one in ids):
        raise CommandError(f"alarms are acknowledged by a list of their numbers: {_short(ids)}")
    found = [one for one in alarms if one["id"] in ids]  # another page may have been quicker
    if not found:
        raise CommandError(f"none of these alarms waits to be acknowledged: {_short(ids)}")
    last = found[-1]
    what = f"'{last['text']:.100}' of {last['time_s']:.1f} s"
    label = what if len(found) == 1 else f"{len(found)} alarms, the last {what}"
    return {"alarms": [one["id"] for one in found], "label": label}


def _only(asked: JsonObject, allowed: set[str]) -> None:
    if extra := set(asked) - allowed:
        raise CommandError(f"'{asked['do']}' takes no {', '.join(map(_short, sorted(extra)))}")


def _duration(value: Any) -> float | None:
    if value is None:
        return None
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not 0.0 < value <= LONGEST_S:
        raise CommandError(f"a fault lasts 0 to {LONGEST_S:g} s, or until cleared: {_short(value)}")
    return float(value)


def _short(value: Any) -> str:
    return f"{value!r:.60}"
