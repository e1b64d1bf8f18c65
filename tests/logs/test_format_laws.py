"""Laws that every format obeys, over the table of formats: recognised, read, written, refused."""

import dataclasses
import lzma
import random

import numpy as np
import pytest
from log_samples import SAMPLES
from made_pair import attitudes
from made_wild import KITTI_TIMES

from robins.dataset import AttitudeTable, Dataset, GnssTable, ImuTable, MagTable, Trajectory
from robins.ins.frames import to_enu_rfu
from robins.logs import FORMATS, LogError, Origin, open_log, write_log
from robins.logs.quantities import CLOCKS, QUANTITIES
from robins.logs.registry import matching_formats, recognise
from robins.logs.tables import kind_in_text, tables_of
from robins.logs.text_format import ANY
from robins.logs.text_formats import TEXT_FORMATS
from robins.logs.timebase import GPS_EPOCH_NS, WEEK_NS
from robins.units import KINDS, to_si

N = 24
TIME_NS = 1_700_000_000_123_456_789 + np.arange(N) * 5_000_001
ORIGIN = Origin(46.9, 8.1, 350.0)
# A column of each array of a table, to know whether it is written in SI.
COLUMN_OF = {
    "gyro": ("gyro_x", "dtheta_x"),
    "accel": ("accel_x", "dv_x"),
    "field_t": ("mag_x",),
    "lat_rad": ("lat",),
    "lon_rad": ("lon",),
    "alt_m": ("height",),
    "v_n": ("v_north",),
    "sigma_m": ("sigma_north",),
    "sigma_v": ("sigma_v_north",),
    "omega_ib_b": ("omega_x",),
}
ROWS = pytest.mark.parametrize("row", TEXT_FORMATS, ids=lambda row: row.name)


def tables_for(row):
    """Plausible tables as a format holds them, one after the other."""
    rng, s = np.random.default_rng(5), np.arange(N) / 10.0
    angles = np.stack([0.8 + 0.1 * np.sin(s), 0.5 * np.cos(s), -3.0 + 0.3 * s], axis=-1)
    place = (np.deg2rad(47.0) + 1e-6 * s, np.deg2rad(8.0) + 2e-6 * s, 400.0 - s)
    v_n = np.stack([6.0 + 0 * s, 9.0 + s, 0.1 * s], axis=-1)
    gyro, accel = rng.normal(size=(N, 3)), 9.8 + rng.normal(size=(N, 3))
    sigma, body, has = np.full((N, 3), [0.01, 0.02, 0.03]), row.body, row.quantities
    path = Trajectory(TIME_NS, *place, v_n, attitudes(*angles.T))
    made = {
        "imu": [
            ImuTable(TIME_NS, step * gyro, step * accel, kind, body)
            for kind, column, step in (("rate", "gyro_x", 1.0), ("increment", "dtheta_x", 5e-3))
            if column in has
        ],
        "mag": [MagTable(TIME_NS, 5e-5 * gyro, body)],
        "gnss": [GnssTable(TIME_NS, *place, sigma, *((v_n, sigma) if "v_east" in has else ()))],
        "trajectory": [path],
        "attitude": [AttitudeTable(TIME_NS, path.q_nb, row.nav, body)],
    }
    if "omega_x" in has:
        made["trajectory"].append(dataclasses.replace(path, omega_ib_b=gyro))
    if len(row.kinds) > 1:
        fields = {"trajectory": "truth"}
        return [Dataset("log", **{fields.get(k, k): made[k][0] for k in row.kinds})]
    tables = made[row.kinds[0]]
    return [*tables, *map(to_enu_rfu, tables)] if row.states_frames else tables


def assert_same(back, table, row):
    """Bit by bit what is written in SI units, to a rounding what is converted."""
    units = {column.holds: column.unit for column in row.columns}
    for got, wanted in zip(tables_of(back), tables_of(table), strict=True):
        assert type(got) is type(wanted)
        shift = got.time_ns - wanted.time_ns
        assert (shift == shift[0]).all()
        of_week = "time_of_week" in row.quantities and (shift[0] + GPS_EPOCH_NS) % WEEK_NS == 0
        assert shift[0] == 0 or of_week
        assert got.rows.tolist() == sorted(got.rows.tolist())
        for field in ("kind", "body", "nav"):
            same = getattr(got, field, None) == getattr(wanted, field, None)
            assert same or (row.local and field == "nav")
        for field, columns in COLUMN_OF.items():
            one, other = getattr(got, field, None), getattr(wanted, field, None)
            unit = next((units[c] for c in columns if c in units), None)
            if row.local and field in ("lat_rad", "lon_rad", "alt_m"):
                np.testing.assert_allclose(one, other, rtol=0, atol=1e-8 if "m" in field else 1e-14)
            elif unit is None or other is None or (row.local and field == "v_n"):
                continue
            elif unit == KINDS[QUANTITIES[next(c for c in columns if c in units)]][0]:
                np.testing.assert_array_equal(one, other)
            else:
                np.testing.assert_allclose(one, other, rtol=5e-16)
        if hasattr(wanted, "q_nb") and not row.local:
            there = np.isfinite(wanted.q_nb).all(axis=1)
            np.testing.assert_array_equal(np.isfinite(got.q_nb).all(axis=1), there)
            cosine = np.abs(np.sum(got.q_nb * wanted.q_nb, axis=1))[there]
            np.testing.assert_allclose(cosine, 1.0, rtol=0, atol=1e-14)


def written(row, table, path):
    """A file of a table, as rows of cells, the header among them."""
    write_log(path, table, row, origin=ORIGIN if row.local else None)
    return path.read_text()


# ------------------------------------------------------------------------------------ recognition


def test_there_is_a_sample_of_every_format():
    assert sorted(SAMPLES) == sorted(f.name for f in FORMATS)


@pytest.mark.parametrize("format", FORMATS, ids=lambda format: format.name)
@pytest.mark.parametrize("pack", [bytes, lzma.compress], ids=["", "xz"])
def test_a_sample_is_recognised_by_content_alone_and_by_no_other_format(tmp_path, format, pack):
    if format.name == "px4-ulog":
        pytest.importorskip("pyulog", reason="the extra `logs` is not installed")
    path = tmp_path / "no_telling_name"
    sample = SAMPLES[format.name]
    (tmp_path / "times.txt").write_text(KITTI_TIMES)
    path.write_bytes(pack(sample.encode() if isinstance(sample, str) else sample))
    assert recognise(path).name == format.name
    held = tables_of(open_log(path, findings=[]))
    assert {kind_in_text(table) for table in held} == set(format.holds)


@ROWS
def test_what_is_written_is_recognised_and_read_as_it_was(tmp_path, row):
    for table in tables_for(row):
        path = tmp_path / "log.txt"
        written(row, table, path)
        assert [f.name for f in matching_formats(path)[1]] == [row.name]
        findings = []
        assert_same(open_log(path, findings=findings), table, row)
        assert findings == []
        again = tmp_path / "again.txt.gz"
        write_log(again, table, row.name, origin=ORIGIN if row.local else None)
        assert_same(open_log(again), table, row)


@ROWS
def test_a_row_writes_nothing_but_what_it_holds(tmp_path, row):
    others = {kind: f for f in TEXT_FORMATS if len(f.kinds) == 1 for kind in f.kinds}
    for kind, other in others.items():
        if kind not in row.kinds:
            with pytest.raises(LogError, match=f"{row.name} holds .*, not "):
                written(row, tables_for(other)[0], tmp_path / "log.txt")
    for table in tables_for(row) if not row.states_frames else ():
        turned = to_enu_rfu(table) if not isinstance(table, Dataset) else None
        if turned is not None and not isinstance(turned, GnssTable):
            with pytest.raises(LogError, match=r"wants (body|nav) frame ..., this table is in "):
                written(row, turned, tmp_path / "log.txt")
        if isinstance(table, ImuTable) and not row.choice:
            other = {"rate": "increment", "increment": "rate"}[table.kind]
            with pytest.raises(LogError, match=f"wants {table.kind}s, these are {other}s; "):
                written(row, dataclasses.replace(table, kind=other), tmp_path / "log.txt")
    assert not (tmp_path / "log.txt").exists()


@pytest.mark.parametrize("name", [f.name for f in FORMATS if not f.binary])
def test_marks_and_line_ends_of_other_systems_change_nothing(tmp_path, name):
    path, text = tmp_path / "log", SAMPLES[name]
    (tmp_path / "times.txt").write_text(KITTI_TIMES)
    tables = []
    for data in (text.encode(), b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode()):
        path.write_bytes(data)
        tables.append(tables_of(open_log(path, findings=[])))
    for one, two in zip(*tables, strict=True):
        for field in ("time_ns", "q_nb", *COLUMN_OF):
            np.testing.assert_array_equal(getattr(one, field, None), getattr(two, field, None))


# ------------------------------------------------------------------------------------ numbers


@ROWS
def test_a_number_that_is_missing_is_missing_in_its_place(tmp_path, row):
    path = tmp_path / "log.txt"
    table = tables_for(row)[-1]
    for k, one in enumerate(tables_of(table)):
        arrays = {f: getattr(one, f, None) for f in (*COLUMN_OF, "q_nb")}
        for field, array in arrays.items():
            if array is None or (row.local and field not in ("alt_m", "q_nb")):
                continue
            holed = array.copy()
            holed[(3, slice(None)) if field == "q_nb" else (3, -1)[: array.ndim]] = np.nan
            changed = dataclasses.replace(one, **{field: holed})
            if isinstance(table, Dataset):
                changed = dataclasses.replace(table, **{("imu", "mag")[k]: changed})
            if row.whole:
                with pytest.raises(LogError, match=r"time 17\d+\.\d+ s: .* cannot hold a missing"):
                    written(row, changed, path)
                assert not path.exists()
                continue
            text = written(row, changed, path)
            for empty in (text, text.replace(f"{row.separator}nan", row.separator)):
                path.write_text(empty if row.separator == "," else text)
                got = getattr(tables_of(open_log(path, findings=[]))[k], field)
                np.testing.assert_array_equal(np.isnan(got), np.isnan(holed))


@ROWS
def test_a_cell_that_is_no_number_is_named(tmp_path, row):
    path = tmp_path / "log.txt"
    lines = written(row, tables_for(row)[-1], path).splitlines()
    cells = lines[-4].split(row.separator)
    names = next((x.strip("# ").split(row.separator) for x in lines if "imestamp" in x), None)
    if row.named and names is None:
        names = next(x for x in lines if not x.startswith("#")).split(row.separator)
    for k, cell in enumerate(cells):
        wrong = row.separator.join([*cells[:k], f"{cell}x", *cells[k + 1 :]])
        path.write_text("\n".join([*lines[:-4], wrong, *lines[-3:]]) + "\n")
        with pytest.raises(LogError) as caught:
            open_log(path, row.name, [])
        assert caught.value.where == f"{path} line {len(lines) - 3}"
        assert caught.value.field == (names[k] if names else row.columns[k].name)
        assert caught.value.value == f"{cell}x"


@ROWS
def test_a_file_cut_anywhere_is_a_prefix_or_refused(tmp_path, row):
    path = tmp_path / "log.txt"
    table = tables_for(row)[0]
    data = written(row, table, path).encode()
    whole = tables_of(open_log(path))[0]
    second, last = data.splitlines(True)[-N + 1], data.splitlines(True)[-1]
    head, tail = data.index(second), len(data) - len(last)  # few lengths: each is compiled anew
    for end in [*random.Random(3).sample(range(head), 25), *range(tail - 4, len(data), 7)]:
        path.write_bytes(data[:end])
        findings = []
        n = data[:end].count(b"\n") - (len(data.splitlines()) - N)
        if n < 1:
            with pytest.raises(LogError) as refused:
                open_log(path, row.name, findings)
            assert refused.value.file == str(path)
            continue
        got = tables_of(open_log(path, row.name, findings))[0]
        assert len(got) == n
        np.testing.assert_array_equal(got.time_ns, whole.time_ns[:n])
        for field in COLUMN_OF:
            if getattr(whole, field, None) is not None:
                # turned to the axes of the place in blocks of other sizes
                atol = 1e-12 if row.local else 0.0
                one, other = getattr(got, field), getattr(whole, field)[:n]
                np.testing.assert_allclose(one, other, rtol=atol, atol=atol)
        codes = {f.code for f in findings} - {"no_place"}
        assert codes == (set() if data[:end].endswith(b"\n") else {"ends_early"})


# ------------------------------------------------------------------------------------ headers

WITH_NAMES = [row for row in TEXT_FORMATS if row.named]
NAMED = pytest.mark.parametrize("row", WITH_NAMES, ids=lambda row: row.name)


class Sheet:
    """A file whose header names its columns, to be changed."""

    def __init__(self, row, text):
        self.separator, lines = row.separator, text.splitlines()
        rows = [line for line in lines if line[0].isdigit()]
        named = [sum(c.names[0] in line for c in row.columns) for line in lines[: -len(rows)]]
        at = named.index(max(named))
        self.mark = "#" if lines[at].startswith("#") else ""
        self.comments = [line for k, line in enumerate(lines[: -len(rows)]) if k != at]
        self.names = lines[at].removeprefix("#").strip().split(self.separator)
        self.rows = [line.split(self.separator) for line in rows]

    def text(self, names=None):
        header = self.mark + self.separator.join(names or self.names)
        rows = [self.separator.join(row) for row in self.rows]
        return "\n".join([*self.comments, header, *rows]) + "\n"


@NAMED
def test_every_unit_that_a_header_may_name_is_heeded(tmp_path, row):
    path = tmp_path / "log.txt"
    for table in tables_for(row):
        sheet = Sheet(row, written(row, table, path))
        usual = open_log(path)
        for column in row.columns:
            kind = QUANTITIES[column.holds]
            known = CLOCKS if kind == "time" else KINDS[kind]
            units = known if kind == "time" or ANY in column.units else column.units
            if column.names[0] not in sheet.names or "{unit" not in column.name:
                continue
            at = sheet.names.index(column.names[0])
            for unit in {*units} - {column.unit}:
                other = column._replace(units=(unit,)).names[0]
                path.write_text(sheet.text([*sheet.names[:at], other, *sheet.names[at + 1 :]]))
                if kind == "angle" and row.kinds == ("trajectory",):
                    # degrees that are called radians cannot be
                    with pytest.raises(LogError, match=f"{other} = .*: beyond "):
                        open_log(path, row.name, [])
                    continue
                factor = to_si(1.0, unit) / to_si(1.0, column.unit)
                assert_scaled(open_log(path, row.name, []), usual, column.holds, factor)


def assert_scaled(got, usual, quantity, factor):
    """The one column is so many times what it was, the others are as they were."""
    stem, _, axis = quantity.rpartition("_")
    for one, other in zip(tables_of(got), tables_of(usual), strict=True):
        time_ns = other.time_ns * (factor if quantity == "time" else 1.0)
        np.testing.assert_allclose(one.time_ns, time_ns, rtol=1e-12, atol=1)
        for field, columns in COLUMN_OF.items():
            if getattr(other, field, None) is None:
                continue
            scale = np.ones(getattr(other, field).shape[1:])
            if scale.ndim and stem in [c.rpartition("_")[0] for c in columns]:
                scale["xyz".index(axis)] = factor
            elif quantity in columns:
                scale = factor
            np.testing.assert_allclose(getattr(one, field), getattr(other, field) * scale, 1e-14)


@NAMED
def test_columns_come_in_any_order_among_others(tmp_path, row):
    path = tmp_path / "log.txt"
    for table in tables_for(row):
        sheet = Sheet(row, written(row, table, path))
        good = open_log(path)
        order = [0, *random.Random(1).sample(range(1, len(sheet.names)), len(sheet.names) - 1)]
        sheet.rows = [[*(cells[k] for k in order), "21"] for cells in sheet.rows]
        path.write_text(sheet.text([*(sheet.names[k] for k in order), "other"]))
        for one, other in zip(tables_of(open_log(path)), tables_of(good), strict=True):
            for field in ("time_ns", "q_nb", *COLUMN_OF):
                if getattr(other, field, None) is not None:
                    np.testing.assert_array_equal(getattr(one, field), getattr(other, field))


@NAMED
def test_a_column_that_lacks_or_is_there_twice_is_named(tmp_path, row):
    path = tmp_path / "log.txt"
    for table in tables_for(row):
        sheet = Sheet(row, written(row, table, path))
        for at, name in enumerate(sheet.names):
            if name in ("dt", "GPS Week") or (
                at == 0 and name == "time"
            ):  # it need not be, or be called so
                continue
            path.write_text(sheet.text([*sheet.names[:at], "other", *sheet.names[at + 1 :]]))
            with pytest.raises(LogError, match="the header lacks ") as caught:
                open_log(path, row.name, [])
            assert name in caught.value.what.split("; it has ")[0]
            path.write_text(sheet.text([*sheet.names, name]))
            with pytest.raises(LogError, match="are the same thing; keep one"):
                open_log(path, row.name, [])
