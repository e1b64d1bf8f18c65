"""RTCM 3 corrections in a stream, whose bytes may look like sync words of another protocol.

Source: RTCM 10403.3, section 4: 0xD3, six bits of zero, ten bits of length, content, CRC-24Q.
"""

from __future__ import annotations

from robins.logs.opening import Bytes

PREAMBLE = b"\xd3"
_LONGEST, _AROUND = 1023, 6  # bytes of the content; of head and checksum
_POLYNOMIAL = 0x1864CFB
_TRIED = 64  # most possible preambles tried; a damaged file may be full of them


def _of_byte(byte: int) -> int:
    """Remainder of a byte by the polynomial."""
    crc = byte << 16
    for _ in range(8):
        crc = crc << 1 ^ (_POLYNOMIAL if crc & 0x800000 else 0)
    return crc


_REMAINDERS = [_of_byte(byte) for byte in range(256)]


def end_of_frame(data: Bytes, at: int) -> int:
    """End of the valid correction that contains the byte `at`; 0 if there is none."""
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
    """Cyclic redundancy check of Qualcomm; 0 for a frame that ends with its valid checksum."""
    crc = 0
    for byte in content:
        crc = (crc << 8 & 0xFFFFFF) ^ _REMAINDERS[crc >> 16 ^ byte]
    return crc
