"""The wire for firmware: one C header, made of the schema, that needs nothing but a compiler."""

from __future__ import annotations

from importlib import resources

from robins.bench.wire.fields import SIZES, Message
from robins.bench.wire.frames import MOST_PAYLOAD, VERSION
from robins.bench.wire.schema import Wire

_TYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "u64": "uint64_t", "f64": "double"}

_TOP = """\
/* The wire of robins, version {version}. Made by `robins.bench.wire.c_header`; do not edit.
 *
 * C99 or C++11, little endian, 64-bit double, no heap. A frame is
 *   0x00 COBS(version u8, type u8, run u32, sequence u32, time_ns u64, payload, CRC-32C u32) 0x00
 */
#ifndef ROBINS_WIRE_H
#define ROBINS_WIRE_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the structs of this header are those of the wire on little-endian machines only"
#endif
#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "NaN means missing here: compile without -ffast-math and -ffinite-math-only"
#endif

#define ROBINS_VERSION {version}
#define ROBINS_SCHEMA 0x{schema:08x}u
#define ROBINS_HEADER 18u
/* Payload that buffers have room for. A board with little memory may define less before it includes
 * this; no message has more than ROBINS_LONGEST_MESSAGE. */
#ifndef ROBINS_MOST_PAYLOAD
#define ROBINS_MOST_PAYLOAD {most}u
#endif
#define ROBINS_LONGEST_MESSAGE {longest}u
#define ROBINS_MOST_BODY (ROBINS_HEADER + ROBINS_MOST_PAYLOAD + 4u)
/* between the zeros of a frame */
#define ROBINS_MOST_STUFFED (ROBINS_MOST_BODY + ROBINS_MOST_BODY / 254u + 1u)
/* of a whole frame with its zeros */
#define ROBINS_MOST_FRAME (ROBINS_MOST_STUFFED + 2u)
typedef char robins_room[ROBINS_MOST_PAYLOAD >= ROBINS_LONGEST_MESSAGE ? 1 : -1];

#pragma pack(push, 1)
typedef struct {{
  uint8_t version;
  uint8_t type;
  uint32_t run;
  uint32_t sequence;
  uint64_t time_ns;
}} robins_header;
"""

_END = """\
#pragma pack(pop)

/* fails to compile where a struct has another size than on the wire */
typedef char robins_header_size[sizeof(robins_header) == ROBINS_HEADER ? 1 : -1];
{sizes}
static inline uint32_t robins_crc32c(const uint8_t *data, size_t size) {{
  uint32_t crc = 0xffffffffu;
  for (size_t i = 0; i < size; i++) {{
    crc ^= data[i];
    for (int k = 0; k < 8; k++) crc = (crc >> 1) ^ (0x82f63b78u & (0u - (crc & 1u)));
  }}
  return ~crc;
}}

/* Writes a frame into `out`, which holds ROBINS_MOST_FRAME. Returns its bytes; 0 if the payload is
 * too long. */
static inline size_t robins_encode(uint8_t type, uint32_t run, uint32_t sequence, uint64_t time_ns,
                                   const void *payload, size_t size, uint8_t *out) {{
  uint8_t body[ROBINS_MOST_BODY];
  robins_header head = {{ROBINS_VERSION, type, run, sequence, time_ns}};
  if (size > ROBINS_MOST_PAYLOAD) return 0;
  memcpy(body, &head, sizeof head);
  if (size) memcpy(body + sizeof head, payload, size);
  size += sizeof head;
  uint32_t crc = robins_crc32c(body, size);
  memcpy(body + size, &crc, 4);
  size += 4;
  size_t to = 1, code = 1;
  uint8_t run_length = 1;
  out[0] = 0;
  to = 2;
  for (size_t i = 0; i < size; i++) {{
    if (body[i] == 0) {{
      out[code] = run_length;
      code = to++;
      run_length = 1;
    }} else {{
      out[to++] = body[i];
      if (++run_length == 0xff && i + 1 < size) {{
        out[code] = run_length;
        code = to++;
        run_length = 1;
      }}
    }}
  }}
  out[code] = run_length;
  out[to++] = 0;
  return to;
}}

/* Reads what lies between two zeros into `body`, which holds ROBINS_MOST_BODY and may be `stuffed`
 * itself. Returns the bytes of the payload, which begins at body + ROBINS_HEADER, or -1 if it is no
 * frame of this version. */
static inline long robins_decode(const uint8_t *stuffed, size_t size, uint8_t *body) {{
  size_t to = 0, from = 0;
  while (from < size) {{
    uint8_t run_length = stuffed[from++];
    if (run_length == 0 || from + run_length - 1 > size) return -1;
    for (uint8_t k = 1; k < run_length; k++) {{
      if (stuffed[from] == 0 || to >= ROBINS_MOST_BODY) return -1;
      body[to++] = stuffed[from++];
    }}
    if (run_length != 0xff && from < size) {{
      if (to >= ROBINS_MOST_BODY) return -1;
      body[to++] = 0;
    }}
  }}
  if (to < ROBINS_HEADER + 4u) return -1;
  uint32_t crc;
  memcpy(&crc, body + to - 4, 4);
  if (crc != robins_crc32c(body, to - 4) || body[0] != ROBINS_VERSION) return -1;
  return (long)(to - ROBINS_HEADER - 4u);
}}
"""

_STREAM = """
/* Bytes of the payload of a message; -1 if this version has no such message. */
static inline long robins_size(uint8_t type) {
  switch (type) {
@cases@    default: return -1;
  }
}

/* Frames out of a stream of bytes. All zero is the beginning. */
typedef struct {
  uint32_t frames; /* good ones so far */
  uint32_t wrong; /* runs of bytes between zeros that were no frame */
  uint8_t too_long;
  size_t held;
  uint8_t bytes[ROBINS_MOST_STUFFED];
} robins_receiver;

/* Takes one byte. Returns -1 as long as no frame has ended; else the bytes of its payload, which
 * robins_payload gives, as robins_head gives its header, until the next byte is taken. */
static inline long robins_take(robins_receiver *in, uint8_t byte) {
  if (byte) {
    if (in->held == ROBINS_MOST_STUFFED) in->too_long = 1;
    else in->bytes[in->held++] = byte;
    return -1;
  }
  size_t held = in->held;
  uint8_t too_long = in->too_long;
  in->held = in->too_long = 0;
  if (!held) return -1; /* two zeros in a row are the edges of neighbours */
  long size = too_long ? -1 : robins_decode(in->bytes, held, in->bytes);
  if (size < 0) in->wrong++;
  else in->frames++;
  return size;
}

/* Least and most of the numbers of a message; NaN passes where it stands for a number that there is
 * not. Returns whether a payload of the right length is sound. */
static inline int robins_sound(uint8_t type, const uint8_t *payload) {
  static const struct {
    uint8_t type, missing;
    uint16_t at, length;
    double least, most;
  } limits[] = {
@limits@  };
  for (size_t i = 0; i < sizeof limits / sizeof limits[0]; i++) {
    if (limits[i].type != type) continue;
    for (size_t k = 0; k < limits[i].length; k++) {
      double x;
      memcpy(&x, payload + limits[i].at + k * sizeof x, sizeof x);
      if (x >= limits[i].least && x <= limits[i].most) continue;
      if (!limits[i].missing || x == x) return 0;
    }
  }
  return 1;
}

/* The same for what has the length of its message and is sound: its number, or 0 as long as there
 * is none. */
static inline uint8_t robins_message(robins_receiver *in, uint8_t byte) {
  long size = robins_take(in, byte);
  uint8_t type = in->bytes[1];
  if (size < 0 || size != robins_size(type)) return 0;
  return robins_sound(type, in->bytes + ROBINS_HEADER) ? type : 0;
}

static inline robins_header robins_head(const robins_receiver *in) {
  robins_header head;
  memcpy(&head, in->bytes, sizeof head);
  return head;
}

static inline const uint8_t *robins_payload(const robins_receiver *in) {
  return in->bytes + ROBINS_HEADER;
}

/* Numbers of the frames of one direction. All zero is the beginning. */
typedef struct {
  uint8_t any;
  uint32_t next;
  uint32_t passed; /* numbers that were passed over: lost, or late */
  uint32_t old; /* frames that came again, or late */
} robins_order;

/* Counts a frame. Returns whether it is new and in its order, and so may be used. A number that is
 * further back than any frame comes late is of a sender that counts anew. */
static inline int robins_in_order(robins_order *order, uint32_t sequence) {
  uint32_t ahead = order->any ? sequence - order->next : 0;
  if (0u - ahead <= 1024u && ahead) {
    order->old++;
    return 0;
  }
  order->any = 1;
  if (!(ahead & 0x80000000u)) order->passed += ahead;
  order->next = sequence + 1u;
  return 1;
}

#endif
"""


def c_header(wire: Wire) -> str:
    """The text of ``robins_wire.h`` for the messages of a rig."""
    every = wire.messages
    longest = max(m.size for m in every)
    top = _TOP.format(version=VERSION, schema=wire.number, most=MOST_PAYLOAD, longest=longest)
    sizes = "".join(_size_check(m) for m in every if m.fields)
    parts = "".join(f"#define ROBINS_PART_{p.upper()} {k}u\n" for k, p in enumerate(wire.parts))
    cases = "".join(f"    case ROBINS_{m.name.upper()}: return {m.size};\n" for m in every)
    structs = "".join(_struct(m) for m in every)
    stream = _STREAM.replace("@cases@", cases)
    stream = stream.replace("@limits@", "".join(_limits(m) for m in every))
    return top + "\n" + parts + structs + _END.format(sizes=sizes) + stream


def firmware(wire: Wire) -> dict[str, str]:
    """Source files of a board, by name: the wire, the platform, one for a PC, and examples.

    An example is the loop of a part, included where the wire has a part of its name.
    """
    there = resources.files("robins.bench.wire") / "firmware"
    kinds, loop = (".c", ".h", ".mk"), "_board.c"
    files = {f.name: f.read_text("utf-8") for f in there.iterdir() if f.name.endswith(kinds)}
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
