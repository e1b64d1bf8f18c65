"""Faults of files (F29): an exact prefix with "ends early", or a refusal; never a wrong number."""

import gzip
import lzma
import os
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robins import foreign
from robins.logs import open_log
from robins.logs.findings import LogError, LogWarning
from robins.logs.opening import _FOREIGN
from robins.logs.text import TextLayout, peek, read_columns

LAYOUT = TextLayout(("time", "x", "y"), ",")


def lines(n, first=1):
    rng = np.random.default_rng(n)
    return [
        f"{k}.005,{x!r},{y!r}\n" for k, (x, y) in enumerate(rng.normal(size=(n, 2)).tolist(), first)
    ]


def plainly(text):
    """Expected content of a file, by Python's own float."""
    rows = [line.split(",") for line in text]
    return [r[0].encode() for r in rows], [[float(v) for v in r[1:]] for r in rows]


def assert_is(columns, text):
    stamps, values = plainly(text)
    assert columns.texts[:, 0].tolist() == stamps
    np.testing.assert_array_equal(columns.values, np.array(values).reshape(-1, 2))


@pytest.fixture(params=[bytes, gzip.compress, lzma.compress], ids=["", ".gz", ".xz"])
def write(request, tmp_path):
    """Write bytes, plain or compressed; the name never tells which."""

    def write(data):
        path = tmp_path / "log.csv"
        path.write_bytes(request.param(data))
        return path

    return write


def test_numbers_are_those_of_python(write):
    text = lines(500)
    findings = []
    columns = read_columns(write("".join(text).encode()), LAYOUT, findings)
    assert_is(columns, text)
    assert columns.rows.tolist() == list(range(1, 501))
    assert findings == []


@given(st.floats(allow_nan=True))
def test_every_float_is_read_exactly(tmp_path_factory, x):
    path = tmp_path_factory.mktemp("float") / "log.csv"
    path.write_text(f"1,{x!r},0\n")
    (value,) = read_columns(path, LAYOUT).values[:, 0]
    assert value == x or (np.isnan(value) and np.isnan(x))


def test_many_blocks_join(write, monkeypatch):
    monkeypatch.setattr("robins.logs.text._PARSE_BYTES", 700)
    monkeypatch.setattr("robins.logs.opening._BLOCK", 64)
    text = lines(300)
    text[150] = "# a remark\n"
    columns = read_columns(write("".join(text).encode()), LAYOUT, [])
    assert_is(columns, text[:150] + text[151:])
    assert columns.rows.tolist() == [*range(1, 151), *range(152, 301)]


def test_bom_crlf_comments_blank_lines_and_blanks(write):
    data = b"\xef\xbb\xbf# made by hand\r\n\r\n1, 2 ,3\r\n  \r\n% more\r\n4,5,6\r\n"
    columns = read_columns(write(data), LAYOUT, [])
    assert columns.values.tolist() == [[2.0, 3.0], [5.0, 6.0]]
    assert columns.rows.tolist() == [3, 6]


def test_empty_fields_nan_and_inf_are_kept_for_cleaning(write):
    columns = read_columns(write(b"1,,-Inf\n2,NaN,infinity\n3,1e-310,1e400\n"), LAYOUT, [])
    expected = [[np.nan, -np.inf], [np.nan, np.inf], [1e-310, np.inf]]
    np.testing.assert_array_equal(columns.values, expected)


def test_extra_columns_are_read_too(write):
    columns = read_columns(write(b"1,2,3,4\n5,6,7,8\n"), LAYOUT, [])
    assert columns.values.tolist() == [[2, 3, 4], [6, 7, 8]]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", r"log.csv: is empty \(0 bytes\); record or copy"),
        (b"\n\n", r"header only; record"),
        (b"# time,x,y\n", r"header only; record"),
        (b"1,2,3", r"holds no whole line of samples; record"),
        (b"1,2,3\n4,abc,6\n", r"log.csv line 2: x = 'abc': is not a number; write numbers"),
        (b"1,2,3\n4,None,6\n", r"line 2: x = 'None': is not a number"),
        (b"1,2,3\n4,1_000,6\n", r"line 2: x = '1_000': is not a number"),
        (b"1,2,3\n4,0x10,6\n", r"line 2: x = '0x10': is not a number"),
        (b"1,2,3\n4,1d3,6\n", r"line 2: x = '1d3': is not a number"),
        (b"1,2,3\n4,5 5,6\n", r"line 2: x = '5 5': is not a number"),
        (b"1,2,3\n4,5\n6,7,8\n", r"line 2: 2 fields where the first lines have 3; bytes are miss"),
        (b"1,2,3\n4,5,6,7\n6,7,8\n", r"fields where the first lines have"),
        (b"1,2\n3,4\n", r"line 1: 2 fields where 3 are needed: time, x, y; is it of another"),
        (b"1,2,3\n\xff,5,6\n", r"line 2: is not text in UTF-8"),
        (b"1,2,3\r4,5,6\r", r"line 1: its lines end in CR alone; save it with"),
        (b"1,2,3\n4,5,6\n7,8,9\r7,8,9\n", r"line 3: 5 fields"),
        ("1,2,3\n".encode("utf-16"), r"line 1: is UTF-16 text; save it as UTF-8"),
        (b"1,2,3\n4,\0\0\0\n", r"line 2: holds NUL bytes: a binary file, or one with a hole"),
        (b"1" * 40 + b",2,3\n", r"time = '1{40}': is too long for a time stamp"),
    ],
)
def test_refusals_name_line_field_value_and_mend(write, data, message):
    path = write(data)
    with pytest.raises(LogError, match=message):
        read_columns(path, LAYOUT, [])


@pytest.mark.parametrize("row", _FOREIGN, ids=[what for _, _, what, _ in _FOREIGN])
def test_a_file_of_another_kind_is_refused_by_name_with_the_way_in(tmp_path, row):
    place, magic, what, way = row
    path = tmp_path / "log.bin"
    path.write_bytes(bytes(place) + magic + bytes(99))
    if magic in (b"\x1f\x8b", b"\xfd7zXZ\x00"):
        path.write_bytes(gzip.compress(magic))
    with pytest.raises(LogError) as caught:
        peek(path)
    assert str(caught.value) == f"{path}: is {what}, not a text log; {way}"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"PK\x03\x04....", r"log.csv: is a zip archive, not a text log; unpack it first"),
        (b"ULog\x01\x12\x35", r"log.csv: is a PX4 ULog, not a text log; leave the format"),
        (b"#ROSBAG V2.0\n", r"log.csv: is a ROS bag, not a text log; leave"),
    ],
)
def test_other_kinds_of_file_are_named(tmp_path, data, message):
    path = tmp_path / "log.csv"
    path.write_bytes(data)
    with pytest.raises(LogError, match=message):
        read_columns(path, LAYOUT, [])


def test_decimal_commas_between_blanks_are_named(tmp_path):
    path = tmp_path / "log.txt"
    path.write_text("1,5 2,25 3\n")
    message = r"line 1: x = '2,25': is not a number \(a decimal comma\?\)"
    with pytest.raises(LogError, match=message):
        read_columns(path, LAYOUT._replace(delimiter=None), [])


def test_a_text_log_cut_anywhere_gives_an_exact_prefix(tmp_path):
    text = lines(25)
    data = "".join(text).encode()
    path = tmp_path / "log.csv"
    for size in range(len(text[0]), len(data)):
        path.write_bytes(data[:size])
        whole = data[:size].count(b"\n")
        findings = []
        columns = read_columns(path, LAYOUT, findings)
        assert_is(columns, text[:whole])
        if data[size - 1 : size] == b"\n":
            assert findings == []
        else:
            (f,) = findings
            assert (f.code, f.where, f.severity) == ("ends_early", f"line {whole + 1}", "warning")
            assert f"ends early at line {whole + 1}" in f.sentence


def is_prefix(columns, text):
    """Test for the first rows of the text, bit by bit."""
    stamps, values = plainly(text)
    n = len(columns.rows)
    return columns.texts[:, 0].tolist() == stamps[:n] and columns.values.tolist() == values[:n]


@pytest.mark.parametrize("compress", [gzip.compress, lzma.compress])
def test_a_compressed_log_cut_at_400_places(tmp_path, compress):
    text = lines(400)
    data = compress("".join(text).encode())
    path = tmp_path / "log"
    refused = 0
    for size in np.linspace(1, len(data) - 1, 400).astype(int):
        path.write_bytes(data[:size])
        findings = []
        try:
            columns = read_columns(path, LAYOUT, findings)
        except LogError:
            refused += 1
            continue
        assert is_prefix(columns, text)
        assert findings[-1].code == "ends_early"
        assert "no end mark" in findings[-1].sentence
    assert refused < 100  # those in the header; most cuts leave something


@pytest.mark.parametrize("compress", [gzip.compress, lzma.compress])
def test_a_flipped_bit_in_a_compressed_log_never_gives_a_wrong_number(tmp_path, compress):
    text = lines(60)
    data = bytearray(compress("".join(text).encode()))
    path = tmp_path / "log"
    refused = 0
    for at in range(0, len(data), 7):
        data[at] ^= 1 << (at % 8)
        path.write_bytes(data)
        try:
            assert is_prefix(read_columns(path, LAYOUT, []), text)
        except LogError:
            refused += 1
        data[at] ^= 1 << (at % 8)
    assert refused > len(data) / 7 * 0.9


def test_compressed_streams_one_after_the_other_with_padding(tmp_path):
    text = lines(20)
    path = tmp_path / "log"
    one, two = ("".join(t).encode() for t in (text[:7], text[7:]))
    for data in (gzip.compress(one) + gzip.compress(two), lzma.compress(one) + bytes(8)):
        path.write_bytes(data + (lzma.compress(two) if data[:1] == b"\xfd" else b""))
        findings = []
        assert_is(read_columns(path, LAYOUT, findings), text)
        assert findings == []


@pytest.mark.parametrize("compress", [gzip.compress, lzma.compress])
def test_output_that_waits_in_the_decompressor_is_fetched(tmp_path, monkeypatch, compress):
    monkeypatch.setattr("robins.logs.opening._BLOCK", 64)
    path = tmp_path / "log"
    for n in range(1, 80):
        path.write_bytes(compress(b"1,2,3\n" * n))
        findings = []
        assert len(read_columns(path, LAYOUT, findings).rows) == n
        assert findings == []


@pytest.mark.parametrize("compress", [gzip.compress, lzma.compress])
def test_a_stream_that_unpacks_to_more_than_any_log_is_refused(tmp_path, monkeypatch, compress):
    path = tmp_path / "log.csv"
    path.write_bytes(compress(b"1,2,3\n" * 600_000))
    assert len(read_columns(path, LAYOUT).rows) == 600_000
    monkeypatch.setattr(foreign, "FREE", 1 << 20)
    with pytest.raises(LogError, match=r"log.csv: is damaged: .*it would take \d+ bytes, and"):
        read_columns(path, LAYOUT)


def test_a_row_of_commas_is_named(tmp_path):
    """As the only row no stamp has a digit."""
    path = tmp_path / "truth.csv"
    names = "time_ms,lat_deg,lon_deg,height_m,v_north_m_s,v_east_m_s,v_down_m_s,q_w,q_x,q_y,q_z"
    path.write_text(f"{names}\n{10 * ','}\n")
    with pytest.raises(LogError, match=r"truth.csv line 2: time_ms: is not a time stamp"):
        open_log(path)


def test_garbage_behind_a_compressed_stream_is_refused(tmp_path):
    path = tmp_path / "log"
    path.write_bytes(lzma.compress("".join(lines(5)).encode()) + b"more, but not xz")
    with pytest.raises(LogError, match="is damaged: the compressed stream does not decode"):
        read_columns(path, LAYOUT, [])


def test_a_recording_that_began_mid_line(write):
    findings = []
    columns = read_columns(write(b"75,3\n4,5,6\n7,8,9\n"), LAYOUT, findings)
    assert columns.values.tolist() == [[5.0, 6.0], [8.0, 9.0]]
    assert columns.rows.tolist() == [2, 3]
    (f,) = findings
    assert (f.code, f.where, f.value) == ("begins_midway", "line 1", "75,3")


def test_nothing_is_left_out_silently(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("1,2,3\n4,5,6\n7,8")
    with pytest.warns(LogWarning, match="ends early at line 3"):
        read_columns(path, LAYOUT)


def assert_refused_in_bounded_memory(path, message):
    tracemalloc.start()
    with pytest.raises(LogError, match=message):
        read_columns(path, LAYOUT, [])
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()


def test_a_sparse_file_of_ten_gigabytes_is_refused_at_once(tmp_path):
    path = tmp_path / "sparse.csv"
    path.write_text("".join(lines(10)))
    os.truncate(path, 10 << 30)
    assert_refused_in_bounded_memory(path, "line 11: holds NUL bytes")


def test_a_bomb_of_one_line_is_refused_in_bounded_memory(tmp_path):
    path = tmp_path / "bomb.xz"
    path.write_bytes(lzma.compress(b"1,2,3\n" + b"7" * 100_000_000, preset=0))
    message = "line 2: is longer than 65536 bytes; is this a text log"
    assert_refused_in_bounded_memory(path, message)


def test_memory_is_bounded_by_the_numbers_not_by_the_text(tmp_path):
    path = tmp_path / "long.csv"
    line = "1.000000000000000000000,2.00000000000000000000,3.0000000000000000000000\n"
    path.write_text(line * 300_000)  # 21 MB of text, 21 MB of arrays
    tracemalloc.start()
    columns = read_columns(path, LAYOUT, [])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    held = columns.texts.nbytes + columns.values.nbytes + columns.rows.nbytes
    assert peak < 2 * held + 40e6


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("missing.csv", "cannot be read: .+; check path and permissions"),
        (".", "is a folder with 0 recordings of ROS, not one; give a file of it"),
    ],
)
def test_what_cannot_be_opened(tmp_path, name, words):
    with pytest.raises(LogError, match=words):
        peek(tmp_path / name)


def test_peek_shows_whole_first_lines(write):
    head = peek(write(b"\xef\xbb\xbf# a\r\n1,2\r\n3,"))
    assert head.lines == ["# a", "1,2"]
    assert head.data() == [(2, "1,2")]
