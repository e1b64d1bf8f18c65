"""The attitude determination hears a committed record again: what it makes of it has not changed.

The record has a frame that the gate refuses, a gyro that falls silent, and wrong bytes.
"""

import json
from pathlib import Path

import pytest

from robins.bench import wire
from robins.bench.recording import Recorder, open_record, read_record
from robins.bench.recording.replay import recorded
from robins.bench.rigs.satellite.messages import WIRE
from robins.cli import main

RECORD = Path(__file__).parent / "records" / "adm.mcap"
STEPS = 80
# Processors and compilers round apart, and the record is of another one: the filter forgets that
# within a few frames of the star sensor, so it never grows.
ROUNDING = 1e-9


def told(capsys, *arguments: str) -> tuple[int, dict]:
    capsys.readouterr()
    code = main(["bench", "replay", str(RECORD), "--node", "adm", "--json", *arguments])
    return code, json.loads(capsys.readouterr().out)


def test_the_record_has_what_it_is_for():
    record = read_record(RECORD)
    assert record.complete
    said = [(WIRE.message(f.header.type).name, f.payload) for f in recorded(record.entries, "adm")]
    flags = [WIRE.decode(name, p)["flags"] for name, p in said if name == "estimate"]
    assert len(flags) == STEPS
    together = 0
    for one in flags:
        together |= one
    assert together & 0b1111 == 0b1111  # used, refused, gyro held, safe
    receiver = wire.Receiver()
    for entry in record.entries:
        if entry.direction == "to":
            receiver.feed(entry.data)
    assert receiver.counts.wrong > 3
    assert RECORD.stat().st_size < 60_000


def test_a_damaged_record_is_told_with_how_much_was_compared(capsys, tmp_path):
    damaged, record = tmp_path / "damaged.mcap", read_record(RECORD)
    with Recorder(damaged, WIRE, record.header) as out:
        for number, entry in enumerate(record.entries):
            out.write(entry)
            if number % 50 == 49:
                out.flush()  # else all is one piece of the file, and lost with a bit of it
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    complete = list(recorded(record.entries, "adm"))
    at_once, each = read_record(damaged), open_record(damaged)
    assert 0 < len(at_once.entries) < len(record.entries)
    for _ in range(2):  # as often as it is wanted
        assert list(each.entries) == at_once.entries
    assert each._replace(entries=at_once.entries) == at_once
    for one, other in ((damaged, damaged), (RECORD, damaged), (damaged, RECORD)):
        command = ["bench", "replay", str(one), "--node", "adm", "--diff", str(other)]
        assert main(command) == 1
        told = capsys.readouterr().out
        assert f"{damaged} is not whole: is damaged" in told
        left = list(recorded(read_record(damaged).entries, "adm"))
        until_s = left[-1].header.time_ns * 1e-9
        compared = f"{len(left)} frames, up to {until_s:g} s of a run of 8 s"
        assert f"Compared, and no more: {compared}." in told
        assert ("Same: as far as the record goes" in told) == (one == other)
        assert main([*command, "--json"]) == 1
        said = json.loads(capsys.readouterr().out)
        assert (said["whole"], said["planned_s"]) == (False, 8.0)
    assert 0 < len(list(recorded(at_once.entries, "adm"))) < len(complete)
    assert main(["bench", "replay", str(RECORD), "--node", "adm", "--diff", str(RECORD)]) == 0
    assert "Same: 'adm' says the same" in capsys.readouterr().out


def test_the_filter_makes_of_it_what_it_made(capsys):
    _, said = told(capsys)
    assert said["frames"] > STEPS
    for d in said["differences"]:
        assert d["field"] not in ("", "flags"), d  # as many frames, and the same decisions
        assert min(d["max_abs"], d["max_rel"]) < ROUNDING, d


@pytest.mark.parametrize(("field", "step"), [("flags", 30), ("q_ib", 79)])
def test_a_change_is_found(capsys, tmp_path, field, step):
    record = read_record(RECORD)
    number = WIRE.message("estimate").number
    with Recorder(tmp_path / "changed.mcap", WIRE, record.header) as out:
        for entry in record.entries:
            found = wire.Receiver().feed(entry.data)
            head = found[0].header if found else None
            if head and head.type == number and head.time_ns == (step + 1) * 100_000_000:
                values = WIRE.decode("estimate", found[0].payload)
                if field == "flags":
                    values["flags"] ^= 16
                else:
                    values[field][3] += 1e-7
                changed = WIRE.encode("estimate", values)
                entry = entry._replace(data=wire.encode_frame(head, changed))
            out.write(entry)
    code, said = told(capsys, "--diff", str(tmp_path / "changed.mcap"))
    assert (code, said["same"]) == (0, False)
    (d,) = said["differences"]
    assert (d["message"], d["field"], d["first_step"], d["count"]) == ("estimate", field, step, 1)
