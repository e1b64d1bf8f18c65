"""Corrections of RTCM 3 in a stream: bytes in which a sync word of another protocol is none.

Source: RTCM 10403.3, section 4: 0xD3, six bits of zero, ten bits of length, content, CRC-24Q.
"""

from __future__ import annotations

from robins.logs.opening import Bytes

PREAMBLE = b"\xd3"
_LONGEST, _AROUND = 1023, 6  # bytes of the content; of head and checksum
_POLYNOMIAL = 0x1864CFB
_TRIED = 64  # bytes before that look like a preamble; a damaged file may be full of them


def _of_byte(byte: int) -> int:
    """Remainder of a byte by the polynomial."""
    crc = byte << 16
    for _ in range(8):
        crc = crc << 1 ^ (_POLYNOMIAL if crc & 0x800000 else 0)
    return crc


_REMAINDERS = [_of_byte(byte) for byte in range(256)]


def end_of_frame(data: Bytes, at: int) -> int:
    """End of the correction with a right checksum in which a byte lies; 0 where it lies in none."""
    first, begin = max(at - _LONGEST - _AROUND, 0), at
    for _ in range(_TRIED):
        begin = data.rfind(PREAMBLE, first, begin)
        if begin < 0:
            break
        size = int.from_bytes(data[begin + 1 : begin + 3], "big")
        end = begin + size + _AROUND
        if size <= _LONGEST and at < end <= len(data) and crc24q(data[begin:end]) == 0:
            return end
    return 0


def crc24q(content: bytes) -> int:
    """Cyclic redundancy check of Qualcomm; 0 of a frame with its right checksum behind."""
    crc = 0
    for byte in content:
        crc = (crc << 8 & 0xFFFFFF) ^ _REMAINDERS[crc >> 16 ^ byte]
    return crc
