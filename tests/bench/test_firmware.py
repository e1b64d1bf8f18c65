"""The example of a board, compiled and run on a pseudo-terminal, and the header it stands on."""

import os
import re
import select
import shutil
import struct
import subprocess
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robins.bench import wire
from robins.bench.ports.line import BITS_PER_BYTE
from robins.bench.ports.port import open_pair
from robins.bench.rigs.satellite import RIG
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.wire import Frame, Header, Receiver, Sequence
from robins.bench.wire.c_header import firmware

DOCS = Path(__file__).resolve().parents[2] / "docs"
GCC = shutil.which("gcc")
pytestmark = pytest.mark.skipif(GCC is None, reason="needs a C compiler, gcc")

FLAGS = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1"]
SANITISERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
STEP_NS = 10_000_000
NOTHING = 0.05  # s without an answer


def build(folder: Path, *sources: str, extra: tuple[str, ...] = ()) -> Path:
    program = folder / "program"
    command = ["gcc", *FLAGS, *extra, *sources, "-lm", "-o", str(program)]
    built = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return program


def sanitised(folder: Path) -> bool:
    (folder / "none.c").write_text("int main(void) { return 0; }")
    command = ["gcc", *SANITISERS, "none.c", "-o", "none"]
    if subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode:
        return False
    return not subprocess.run([folder / "none"], capture_output=True, check=False).returncode


def unpacked(folder: Path) -> Path:
    for name, text in firmware(WIRE).items():
        (folder / name).write_text(text)
    return folder


@pytest.fixture(scope="module", params=["plain", "checked"])
def program(request, tmp_path_factory) -> Path:
    """The board as it is, and with the least buffers, every access to memory checked."""
    folder = unpacked(tmp_path_factory.mktemp(request.param))
    if request.param == "plain":
        return build(folder, "gyro_board.c", "platform_posix.c")
    if not sanitised(folder):
        pytest.skip("this compiler has no sanitisers")
    extra = (*SANITISERS, "-DROBINS_MOST_PAYLOAD=ROBINS_LONGEST_MESSAGE")
    return build(folder, "gyro_board.c", "platform_posix.c", extra=extra)


class Board:
    """The bench's end of the line to a board that runs."""

    def __init__(self, program: Path, pair):
        self.pair = pair
        self.run = self.sequence = 0
        self.receiver = Receiver()
        self.waiting: list[Frame] = []
        self.process = subprocess.Popen([program, pair.path], stderr=subprocess.PIPE, text=True)

    def send(self, name: str, time_ns: int = 0, **values) -> None:
        self.put(WIRE.message(name).number, WIRE.encode(name, values), time_ns)

    def put(self, kind: int, payload: bytes, time_ns: int = 0) -> None:
        self.write(wire.encode_frame(Header(kind, self.run, self.sequence, time_ns), payload))
        self.sequence += 1

    def write(self, data: bytes) -> None:
        while data:
            select.select([], [self.pair.master], [])
            data = data[os.write(self.pair.master, data) :]

    def frame(self, timeout_s: float = 3.0) -> Frame | None:
        """The next frame of this run; a hello that was on its way when begin was sent is not."""
        end = time.monotonic() + timeout_s
        while not self.waiting and (left := end - time.monotonic()) > 0:
            if select.select([self.pair.master], [], [], left)[0]:
                found = self.receiver.feed(os.read(self.pair.master, 65536))
                self.waiting += [one for one in found if one.header.run == self.run]
        return self.waiting.pop(0) if self.waiting else None

    def got(self, name: str, timeout_s: float = 3.0) -> tuple[Header, dict]:
        one = self.frame(timeout_s)
        assert one is not None, f"no {name} came"
        assert WIRE.message(one.header.type).name == name
        return one.header, WIRE.decode(name, one.payload)

    def begin(self, run: int, step_ns: int = STEP_NS) -> None:
        """Answer a hello."""
        self.run = 0
        self.got("hello")
        self.run, self.sequence = run, 0
        self.waiting.clear()
        self.send("begin", step=step_ns)

    def step(self, k: int, q_ib=None) -> np.ndarray:
        """Attitude, tick, and what comes of it."""
        time_ns = (k + 1) * STEP_NS
        if q_ib is not None:
            self.send("mounted", time_ns, q_ib=q_ib)
        self.send("tick", time_ns, step=k)
        header, sample = self.got("gyro")
        assert (header.run, header.time_ns) == (self.run, time_ns)
        header, done = self.got("done")
        assert (header.run, header.time_ns, done["step"]) == (self.run, time_ns, k)
        return sample["theta_b"]


@pytest.fixture
def board(program):
    with open_pair() as pair:
        board = Board(program, pair)
        yield board
        board.process.kill()
        board.process.communicate()


def attitudes(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Attitudes, scalar first, of either sign, and the turns between them, one less."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(
        rng.normal(size=(count, 3)) * 10.0 ** rng.integers(-9, 1, (count, 1))
    )
    at = [turns[0]]
    for turn in turns[1:]:
        at.append(at[-1] * turn)
    q = np.array([one.as_quat(scalar_first=True) for one in at])
    between = [(a.inv() * b).as_rotvec() for a, b in pairwise(at)]
    return q * rng.choice([-1.0, 1.0], (count, 1)), np.array(between)


# --------------------------------------------------------------------------------------- protocol


def test_it_says_hello_until_it_is_answered(board):
    header, hello = board.got("hello")
    assert (header.run, header.sequence) == (0, 0)
    assert (WIRE.parts[hello["part"]], hello["schema"]) == ("gyro", WIRE.number)
    began = time.monotonic()
    assert board.got("hello")[0].sequence == 1
    assert 0.3 < time.monotonic() - began < 1.0
    board.begin(run=7)
    assert board.frame(timeout_s=0.7) is None


def test_its_samples_are_the_turns_of_the_table(board):
    q, turns = attitudes(40)
    board.begin(run=7)
    assert np.isnan(board.step(0, q[0])).all()
    samples = np.array([board.step(k, q[k]) for k in range(1, 40)])
    # each component of a quaternion is rounded by 1e-16, whatever the turn
    np.testing.assert_allclose(samples, turns, rtol=1e-12, atol=1e-15)


def test_a_tick_that_comes_again_has_the_same_answer(board):
    q, turns = attitudes(4)
    board.begin(run=7)
    for k in range(3):
        board.step(k, q[k])
    for _ in range(3):
        board.send("mounted", 3 * STEP_NS, q_ib=q[3])  # must not be computed with
        board.send("tick", 3 * STEP_NS, step=2)
    answers = [board.frame() for _ in range(6)]
    assert [a.header.sequence for a in answers] == list(range(6, 12))
    assert len({a.payload for a in answers[::2]}) == 1
    assert len({a.payload for a in answers[1::2]}) == 1  # done with its time, too
    np.testing.assert_allclose(
        WIRE.decode("gyro", answers[0].payload)["theta_b"], turns[1], rtol=1e-12, atol=1e-15
    )
    board.send("tick", 2 * STEP_NS, step=1)  # its sample is not known any more
    assert board.frame(NOTHING) is None
    assert np.isfinite(board.step(3, q[3])).all()


def test_an_attitude_that_did_not_come_is_not_made_up(board):
    q, turns = attitudes(8)
    board.begin(run=7)
    board.step(0, q[0])
    assert np.isfinite(board.step(1, q[1])).all()
    assert np.isnan(board.step(2)).all()
    board.send("mounted", 3 * STEP_NS, q_ib=q[2])  # late: of the step before
    assert np.isnan(board.step(3)).all()
    left_out = Rotation.from_quat(q[1], scalar_first=True).inv() * Rotation.from_quat(
        q[4], scalar_first=True
    )
    np.testing.assert_allclose(board.step(4, q[4]), left_out.as_rotvec(), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(board.step(5, q[5]), turns[4], rtol=1e-12, atol=1e-15)


def test_what_is_of_another_run_or_length_or_kind_is_not_taken(board):
    q, turns = attitudes(3)
    board.begin(run=7)
    board.step(0, q[0])
    board.run = 6
    board.send("tick", 2 * STEP_NS, step=1)
    board.run = 0
    board.send("tick", 2 * STEP_NS, step=1)
    board.run = 7
    board.put(WIRE.message("tick").number, b"\x01\x00\x00")
    board.put(WIRE.message("mounted").number, bytes(8), 2 * STEP_NS)
    board.put(255, b"of a later version")
    board.send("begin", step=STEP_NS)  # again, as two hellos may be answered: nothing is lost
    assert board.frame(NOTHING) is None
    np.testing.assert_allclose(board.step(1, q[1]), turns[0], rtol=1e-12, atol=1e-15)


def test_stop_and_another_run_begin_anew(board):
    q, _ = attitudes(3)
    board.begin(run=7)
    board.step(0, q[0])
    board.step(1, q[1])
    board.send("stop")
    board.run = 0
    assert board.got("hello")[0].sequence == 0
    board.begin(run=8)
    board.send("tick", STEP_NS, step=0)  # nothing is left of the attitude of run 7, step 0
    header, sample = board.got("gyro")
    assert (header.run, header.sequence) == (8, 0)
    assert np.isnan(sample["theta_b"]).all()
    board.got("done")
    assert np.isnan(board.step(1, q[1])).all()
    board.run = 9  # without a stop: the bench was killed
    board.send("begin", step=STEP_NS)
    assert np.isnan(board.step(0, q[0])).all()
    assert np.isfinite(board.step(1, q[1])).all()


def test_it_ends_with_the_line(board):
    board.got("hello")
    board.pair.close()
    assert board.process.wait(5.0) == 1
    assert "the line is gone" in board.process.stderr.read()


def test_a_path_that_is_no_line(program):
    result = subprocess.run([program, "/nowhere"], capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert "/nowhere: No such file" in result.stderr


@pytest.mark.parametrize("count", [1_500, 10_000])
def test_thousands_of_steps_on_a_noisy_line(board, count):
    """Noise, cut frames and wrong bits between good frames cost neither a step nor a bit."""
    q, turns = attitudes(count)
    rng = np.random.default_rng(1)
    order = Sequence()
    board.begin(run=7)
    samples = np.empty((count, 3))
    for k in range(count):
        time_ns = (k + 1) * STEP_NS
        mounted, tick = (
            wire.encode_frame(
                Header(WIRE.message(name).number, 7, 2 * k + n + 1, time_ns),
                WIRE.encode(name, values),
            )
            for n, (name, values) in enumerate([("mounted", {"q_ib": q[k]}), ("tick", {"step": k})])
        )
        damaged = bytearray(mounted)
        damaged[int(rng.integers(1, len(damaged) - 1))] ^= 1 << int(rng.integers(0, 8))
        noise = [b"", rng.bytes(7), mounted[:11], bytes(damaged), b"\xff" * 300][k % 5]
        board.write(noise + mounted + noise + tick)
        one, two = board.frame(), board.frame()
        assert one.header.time_ns == two.header.time_ns == time_ns
        assert order.take(one.header.sequence)
        assert order.take(two.header.sequence)
        samples[k] = WIRE.decode("gyro", one.payload)["theta_b"]
        assert WIRE.decode("done", two.payload)["step"] == k
    assert (order.lost, board.receiver.counts.wrong) == (0, 0)
    np.testing.assert_allclose(samples[1:], turns, rtol=1e-12, atol=1e-15)


# ----------------------------------------------------------------------------------------- source


def test_the_loop_has_forty_lines_and_no_heap():
    for name in ("part_loop.h", "gyro_board.c"):
        text = firmware(WIRE)[name]
        code = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
        assert len([line for line in code.splitlines() if line.strip()]) <= 40
        assert max(len(line) for line in text.splitlines()) <= 110
    assert not re.search(r"\b(m|c|re)alloc\b", "".join(firmware(WIRE).values()))


def test_every_file_of_the_example_is_given():
    examples = ["adm_board.c", "board.mk", "gyro_board.c", "part_loop.h", "platform.h"]
    examples.append("platform_posix.c")
    assert list(firmware(WIRE)) == [*examples, "robins_wire.h"]


# ------------------------------------------------------------------------------------------ page

# What goes over each line, beside tick and done; a star sensor that is no camera takes less.
LINES = {  # what the operator says is rare
    f"`{part}`": (tuple(m for m in RIG.takes[part] if m not in RIG.console), sent)
    for part, sent in RIG.sends.items()
}
LINES["`star`, a camera"] = LINES["`star`"]
LINES["`star`"] = (("motion",), ("star",))
BAUDS, RATES_HZ = (115200, 460800, 921600), (10, 100, 200)


def on_the_line(names: tuple[str, ...]) -> int:
    blank = Header(1, 1, 1, 1)
    return sum(len(wire.encode_frame(blank, bytes(WIRE.size_of(name)))) for name in names)


def test_the_page_has_the_budget():
    head = "| line | to the part [bytes] | from it [bytes] |"
    shares = "".join(f" {b} baud: {', '.join(map(str, RATES_HZ))} Hz |" for b in BAUDS)
    rows = [f"{head}{shares} on the way at 460800 [ms] |", "|---|---|---|---|---|---|---|"]
    for line, (to, back) in LINES.items():
        there, here = on_the_line((*to, "tick")), on_the_line((*back, "done"))
        cells = [line, str(there), str(here)]
        for baud in BAUDS:
            full = [round(100 * max(there, here) * hz * BITS_PER_BYTE / baud) for hz in RATES_HZ]
            cells.append(", ".join(f"{share} %" for share in full))
        cells.append(f"{1e3 * (there + here) * BITS_PER_BYTE / 460800:.1f}")
        rows.append(f"| {' | '.join(cells)} |")
    page = (DOCS / "board.md").read_text("utf-8").splitlines()
    first = page.index(rows[0])
    assert sorted(page[first : first + len(rows)]) == sorted(rows)


# ----------------------------------------------------------------------------------------- header

STREAM = """
#include "robins_wire.h"
#include <stdio.h>

/* frames of a stream: size, header, payload of each; then what was counted */
int main(void) {
  static robins_receiver in;
  int byte;
  while ((byte = getchar()) != EOF) {
    long size = robins_take(&in, (uint8_t)byte);
    if (in.held > ROBINS_MOST_STUFFED) return 1;
    if (size < 0) continue;
    uint32_t length = (uint32_t)size;
    robins_header head = robins_head(&in);
    fwrite(&length, 4, 1, stdout);
    fwrite(&head, sizeof head, 1, stdout);
    fwrite(robins_payload(&in), 1, length, stdout);
  }
  fprintf(stderr, "%u %u", (unsigned)in.frames, (unsigned)in.wrong);
  return 0;
}
"""

ORDER = """
#include "robins_wire.h"
#include <stdio.h>

int main(void) {
  robins_order order = {0};
  uint32_t number;
  while (fread(&number, 4, 1, stdin) == 1) putchar(robins_in_order(&order, number));
  fprintf(stderr, "%u %u", (unsigned)order.passed, (unsigned)order.old);
  return 0;
}
"""

SIZES = """
#include "robins_wire.h"
#include <stdio.h>

int main(void) {
  for (int type = 0; type < 256; type++) printf("%ld ", robins_size((uint8_t)type));
  return 0;
}
"""


def compiled(folder: Path, text: str) -> Path:
    (unpacked(folder) / "main.c").write_text(text)
    return build(folder, "main.c", extra=tuple(SANITISERS) if sanitised(folder) else ())


def result(program: Path, given: bytes = b"") -> tuple[bytes, str]:
    one = subprocess.run([program], input=given, capture_output=True, check=False)
    assert one.returncode == 0, one.stderr
    return one.stdout, one.stderr.decode()


def test_its_receiver_finds_what_ours_finds(tmp_path):
    rng = np.random.default_rng(3)
    pieces = []
    for k in range(4000):
        payload = rng.integers(0, 256, int(rng.integers(0, 600)), dtype=np.uint8).tobytes()
        made = wire.encode_frame(Header(int(rng.integers(0, 256)), 7, k, k), payload)
        damaged = bytearray(made)
        damaged[int(rng.integers(0, len(made)))] ^= 1 << int(rng.integers(0, 8))
        other = wire.encode_frame(Header(1, 7, k, k, version=2), payload)
        long = rng.integers(1, 256, int(rng.integers(4000, 4300)), dtype=np.uint8).tobytes()
        cut = made[: int(rng.integers(0, len(made)))]
        pieces += [[made, bytes(damaged), rng.bytes(20), cut, other, long][k % 6], made]
    edge = [wire.encode_frame(Header(9, 7, 0, 0), bytes([b]) * 4096) for b in (0, 1, 255)]
    stream = b"".join([*pieces, *edge, b"\x01" * 4200, bytes(3), *edge])

    receiver = Receiver()
    expected = b"".join(
        struct.pack("<IBBIIQ", len(f.payload), h.version, h.type, h.run, h.sequence, h.time_ns)
        + f.payload
        for f in receiver.feed(stream)
        for h in [f.header]
    )
    found, counts = result(compiled(tmp_path, STREAM), stream)
    assert counts == f"{receiver.counts.frames} {receiver.counts.wrong}"
    assert receiver.counts.frames > 4000
    assert receiver.counts.wrong > 3000
    assert found == expected


def test_its_order_is_ours(tmp_path):
    rng = np.random.default_rng(4)
    numbers = np.concatenate(
        [[5, 6, 9, 9, 8, 10, 10], 2**31 + np.arange(5), [2**32 - 2, 0, 2**32 - 1, 3]]
    )
    numbers = np.concatenate([numbers, 100 + np.cumsum(rng.integers(-3, 6, 2000))]).astype("<u4")
    ours = Sequence()
    expected = bytes(ours.take(int(n)) for n in numbers)
    program = compiled(tmp_path, ORDER)
    found, counts = result(program, numbers.tobytes())
    assert found == expected
    jumps = np.array([7, 8, 8 - 2**31, 9 - 2**31, 5000, 1, 1, 2]).astype("<u4")
    assert result(program, jumps.tobytes())[0] == bytes([1, 1, 1, 1, 1, 1, 0, 1])
    assert 0 in expected
    # it does not remember what is missing, so a late frame is an old one
    assert counts == f"{(ours.lost + ours.late) % 2**32} {ours.repeated + ours.late}"


def test_it_knows_the_length_of_every_message(tmp_path):
    found, _ = result(compiled(tmp_path, SIZES))
    known = {m.number: WIRE.size_of(m.name) for m in WIRE.messages}
    assert [int(n) for n in found.split()] == [known.get(k, -1) for k in range(256)]


SOUND = """
#include "robins_wire.h"
#include <stdio.h>

int main(void) {
  static uint8_t message[1 + ROBINS_LONGEST_MESSAGE];
  while (fread(message, sizeof message, 1, stdin) == 1)
    putchar(robins_sound(message[0], message + 1));
  return 0;
}
"""


def test_it_refuses_the_numbers_that_we_refuse(tmp_path):
    longest = max(WIRE.size_of(m.name) for m in WIRE.messages)
    given, expected = b"", b""
    for m in WIRE.messages:
        blank = {f.name: np.zeros(f.length, int) for f in m.fields}
        for f in (f for f in m.fields if f.limits and f.kind == "f64"):
            least, most = f.limits
            edges = (least, most, np.nextafter(least, -np.inf), np.nextafter(most, np.inf))
            for x in (*edges, np.nan, np.inf, -np.inf, 1e308):
                for k in range(f.length):
                    values = np.zeros(f.length)
                    values[k] = x
                    payload = WIRE.encode(m.name, {**blank, f.name: values})
                    given += bytes([m.number]) + payload.ljust(longest, b"\0")
                    expected += bytes([WIRE.unsound(m.name, payload) is None])
    assert result(compiled(tmp_path, SOUND), given)[0] == expected
    assert 0.1 < np.mean(np.frombuffer(expected, "u1")) < 0.6


def test_a_receiver_for_a_small_board_is_small(tmp_path):
    text = SIZES.replace("return 0;", 'printf("%u", (unsigned)sizeof(robins_receiver)); return 0;')
    (unpacked(tmp_path) / "main.c").write_text(text)
    small = build(tmp_path, "main.c", extra=("-DROBINS_MOST_PAYLOAD=ROBINS_LONGEST_MESSAGE",))
    assert int(result(small)[0].split()[-1]) < 200


def test_buffers_too_small_for_a_message_do_not_compile(tmp_path):
    (unpacked(tmp_path) / "main.c").write_text(SIZES)
    longest = max(WIRE.size_of(m.name) for m in WIRE.messages)
    build(tmp_path, "main.c", extra=(f"-DROBINS_MOST_PAYLOAD={longest}u",))
    with pytest.raises(AssertionError, match="robins_room"):
        build(tmp_path, "main.c", extra=(f"-DROBINS_MOST_PAYLOAD={longest - 1}u",))
