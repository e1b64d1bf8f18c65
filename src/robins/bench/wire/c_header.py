"""The wire for firmware: one C header, made of the schema, that needs nothing but a compiler."""

from __future__ import annotations

from importlib import resources

import fastcrc

from robins.bench.wire.frames import MOST_PAYLOAD
from robins.bench.wire.records import size_of
from robins.bench.wire.schema import MESSAGES, PARTS, VERSION, Message, markdown

_TYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "u64": "uint64_t", "f64": "double"}

_TOP = """\
/* The wire of robins, version {version}. Made by `robins.bench.wire.c_header`; do not edit.
 *
 * C99, little endian, 64-bit double, no heap. A frame is
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

/* The same for what has the length of its message: its number, or 0 as long as there is none. */
static inline uint8_t robins_message(robins_receiver *in, uint8_t byte) {
  long size = robins_take(in, byte);
  return size >= 0 && size == robins_size(in->bytes[1]) ? in->bytes[1] : 0;
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

/* Counts a frame. Returns whether it is new and in its order, and so may be used. */
static inline int robins_in_order(robins_order *order, uint32_t sequence) {
  uint32_t ahead = order->any ? sequence - order->next : 0;
  if (ahead & 0x80000000u) {
    order->old++;
    return 0;
  }
  order->any = 1;
  order->passed += ahead;
  order->next = sequence + 1u;
  return 1;
}

#endif
"""


def schema_number() -> int:
    """CRC-32C of the schema as it is documented: the same table, the same number."""
    return fastcrc.crc32.iscsi(markdown().encode())


def c_header() -> str:
    """The text of ``robins_wire.h``."""
    longest = max(size_of(m.name) for m in MESSAGES)
    top = _TOP.format(version=VERSION, schema=schema_number(), most=MOST_PAYLOAD, longest=longest)
    sizes = "".join(_size_check(m) for m in MESSAGES if m.fields)
    parts = "".join(f"#define ROBINS_PART_{p.upper()} {k}u\n" for k, p in enumerate(PARTS))
    cases = "".join(
        f"    case ROBINS_{m.name.upper()}: return {size_of(m.name)};\n" for m in MESSAGES
    )
    structs = "".join(_struct(m) for m in MESSAGES)
    return (
        top + "\n" + parts + structs + _END.format(sizes=sizes) + _STREAM.replace("@cases@", cases)
    )


def firmware() -> dict[str, str]:
    """The files of the example of a board, by name: loop, platform, one for a PC, and the wire."""
    there = resources.files("robins.bench.wire") / "firmware"
    files = {f.name: f.read_text("utf-8") for f in there.iterdir() if f.name.endswith((".c", ".h"))}
    return {**dict(sorted(files.items())), "robins_wire.h": c_header()}


def _struct(m: Message) -> str:
    lines = [f"\n/* {m.text} */", f"#define ROBINS_{m.name.upper()} {m.number}u"]
    if m.fields:
        lines.append("typedef struct {")
        for f in m.fields:
            many = "" if f.length == 1 else f"[{f.length}]"
            unit = "" if f.unit == "1" else f"{f.unit}; "
            lines.append(f"  {_TYPES[f.kind]} {f.name}{many}; /* {unit}{f.text} */")
        lines.append(f"}} robins_{m.name};")
    return "\n".join(lines) + "\n"


def _size_check(m: Message) -> str:
    name = f"robins_{m.name}"
    return f"typedef char {name}_size[sizeof({name}) == {size_of(m.name)} ? 1 : -1];\n"
