"""The wire for firmware: one C header, made of the schema, that needs nothing but a compiler."""

from __future__ import annotations

import fastcrc

from robins.bench.schema import MESSAGES, SIZES, VERSION, Message, markdown

_TYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "u64": "uint64_t", "f64": "double"}

_TOP = """\
/* The wire of robins, version {version}. Made by `robins.bench.c_header`; do not edit.
 *
 * C99, little endian, 64-bit double, no heap. A frame is
 *   0x00 COBS(version u8, type u8, run u32, sequence u32, time_ns u64, payload, CRC-32C u32) 0x00
 */
#ifndef ROBINS_WIRE_H
#define ROBINS_WIRE_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define ROBINS_VERSION {version}
#define ROBINS_SCHEMA 0x{schema:08x}u
#define ROBINS_HEADER 18u
#define ROBINS_MOST_PAYLOAD {most}u
#define ROBINS_MOST_BODY (ROBINS_HEADER + ROBINS_MOST_PAYLOAD + 4u)
/* of a whole frame with its zeros */
#define ROBINS_MOST_FRAME (ROBINS_MOST_BODY + ROBINS_MOST_BODY / 254u + 3u)

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

/* Reads what lies between two zeros into `body`, which holds ROBINS_MOST_BODY. Returns the bytes of
 * the payload, which begins at body + ROBINS_HEADER, or -1 if it is no frame of this version. */
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

#endif
"""


def schema_number() -> int:
    """CRC-32C of the schema as it is documented: the same table, the same number."""
    return fastcrc.crc32.iscsi(markdown().encode())


def c_header() -> str:
    """The text of ``robins_wire.h``."""
    from robins.bench.frames import MOST_PAYLOAD

    top = _TOP.format(version=VERSION, schema=schema_number(), most=MOST_PAYLOAD)
    sizes = "".join(_size_check(m) for m in MESSAGES if m.fields)
    return top + "".join(_struct(m) for m in MESSAGES) + _END.format(sizes=sizes)


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
    size = sum(f.length * SIZES[f.kind] for f in m.fields)
    name = f"robins_{m.name}"
    return f"typedef char {name}_size[sizeof({name}) == {size} ? 1 : -1];\n"
