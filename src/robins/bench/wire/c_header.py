"""The wire for firmware: one C header, made of the schema, that needs nothing but a compiler."""

from __future__ import annotations

from importlib import resources

from robins.bench.wire.fields import SIZES, Message
from robins.bench.wire.frames import MOST_PAYLOAD, VERSION
from robins.bench.wire.schema import Wire

_TYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "u64": "uint64_t", "f64": "double"}

_FIRMWARE = resources.files("robins.bench.wire") / "firmware"


def c_header(wire: Wire) -> str:
    """The text of ``robins_wire.h`` for the messages of a rig."""
    every = wire.messages
    longest = max(m.size for m in every)
    text = (_FIRMWARE / "robins_wire.h.in").read_text("utf-8")
    for name, value in {
        "version": str(VERSION),
        "schema": f"{wire.number:08x}",
        "most": str(MOST_PAYLOAD),
        "longest": str(longest),
        "parts": "".join(
            f"#define ROBINS_PART_{p.upper()} {k}u\n" for k, p in enumerate(wire.parts)
        ),
        "structs": "".join(_struct(m) for m in every),
        "sizes": "".join(_size_check(m) for m in every if m.fields),
        "cases": "".join(f"    case ROBINS_{m.name.upper()}: return {m.size};\n" for m in every),
        "limits": "".join(_limits(m) for m in every),
    }.items():
        text = text.replace(f"@{name}@", value)
    return text


def firmware(wire: Wire) -> dict[str, str]:
    """Source files of a board, by name: the wire, the platform, one for a PC, and examples.

    An example is the loop of a part, included where the wire has a part of its name.
    """
    kinds, loop = (".c", ".h", ".mk"), "_board.c"
    files = {f.name: f.read_text("utf-8") for f in _FIRMWARE.iterdir() if f.name.endswith(kinds)}
    fit = {
        name: text
        for name, text in sorted(files.items())
        if not name.endswith(loop) or name.removesuffix(loop) in wire.parts
    }
    return {**fit, "robins_wire.h": c_header(wire)}


def _struct(m: Message) -> str:
    lines = [f"\n/* {m.text} */", f"#define ROBINS_{m.name.upper()} {m.number}u"]
    if m.fields:
        lines.append("typedef struct {")
        for f in m.fields:
            many = "" if f.length == 1 else f"[{f.length}]"
            unit = "" if f.unit == "1" else f"{f.unit}; "
            span = f.span and f"; {f.span}"
            lines.append(f"  {_TYPES[f.kind]} {f.name}{many}; /* {unit}{f.text}{span} */")
        lines.append(f"}} robins_{m.name};")
    return "\n".join(lines) + "\n"


def _limits(m: Message) -> str:
    """Rows of the table of limits, for the doubles."""
    rows, at = "", 0
    for f in m.fields:
        if f.limits and f.kind == "f64":
            least, most = f.limits
            rows += f"    {{ROBINS_{m.name.upper()}, {int(f.missing)}, {at}, {f.length}, "
            rows += f"{least!r}, {most!r}}},\n"
        at += f.length * SIZES[f.kind]
    return rows


def _size_check(m: Message) -> str:
    name = f"robins_{m.name}"
    return f"typedef char {name}_size[sizeof({name}) == {m.size} ? 1 : -1];\n"
