"""Arrays whose header declares what NumPy does not take: refused, nothing of NumPy's own raised."""

import io
import struct
import zipfile

import numpy as np
import pytest

from robins.errors import RobinsError
from robins.foreign import arrays_of


def archive(shape: str, data: bytes) -> bytes:
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}}}\n".encode()
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as made:
        size = struct.pack("<H", len(header))
        made.writestr("a.npy", b"\x93NUMPY\x01\x00" + size + header + data)
    return file.getvalue()


@pytest.mark.parametrize(
    ("shape", "data"),
    [(f"(0, {10**21})", b""), ("(True,)", bytes(8)), (str((1,) * 70), bytes(8))],
)
def test_a_shape_that_is_none_is_refused(shape, data):
    with pytest.raises(RobinsError, match="'a' is no array of NumPy"):
        arrays_of(archive(shape, data), RobinsError)


def test_the_same_archive_of_a_shape_is_read():
    np.testing.assert_array_equal(arrays_of(archive("(2, 1)", bytes(16)), RobinsError)["a"], 0.0)
