"""The live page: who may talk to it, what it may ask, what is shipped; no browser yet."""

import itertools
import json
import re
import socket
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from robins.bench import live as package
from robins.bench.live import LivePage, Signal
from robins.bench.live.commands import CommandError, read
from robins.bench.live.feed import check
from robins.bench.live.guard import known_host, same_origin

STATIC = Path(package.__file__).parent / "static"
SIGNALS = [Signal("a", "1", "A"), Signal("b", "1", "A"), Signal("c", "m", "C")]
SAYS = ["back to the course"]
FAULTS = [
    {"label": "star stuck", "fault": {"kind": "stuck", "link": "star"}},
    {"label": "noise", "fault": {"kind": "bit errors", "bits": 2}},
]


@pytest.fixture(scope="module")
def live():
    with LivePage(SIGNALS, "a bench", 1, faults=FAULTS, says=SAYS) as made:
        yield made


def page_of(live: LivePage, **options):
    """A websocket to the server, as a page opens it; it takes in all that comes."""
    return connect(live.url.replace("http", "ws") + "live", max_queue=None, **options)


def told(page, kind: str):
    """The next text of a kind; others are passed over."""
    while True:
        if (said := json.loads(page.recv(timeout=3)))["kind"] == kind:
            return said


# ---------------------------------------------------------------------------------- who may talk


@pytest.mark.parametrize(
    ("host", "known"),
    [
        ("127.0.0.1:8000", True),
        ("localhost:9999", True),  # through an ssh tunnel
        ("localhost", True),
        ("[::1]:8000", True),
        ("192.168.1.7:80", True),  # a bare address cannot be a stranger's name
        (socket.gethostname(), True),
        ("evil.example:8000", False),
        ("localhost.evil.example", False),
        ("127.0.0.1.evil.example", False),
        ("evil.example#127.0.0.1", False),
        ("a b", False),
        ("", False),
        ("127.0.0.1:8000\r\nx", False),
    ],
)
def test_hosts(host, known):
    assert known_host(host) is known


@pytest.mark.parametrize(
    ("origin", "same"),
    [
        (None, True),
        ("http://127.0.0.1:8000", True),
        ("https://127.0.0.1:8000", True),  # behind a proxy
        ("http://127.0.0.1:3000", False),  # another program of this machine
        ("http://127.0.0.1", False),
        ("http://evil.example", False),
        ("null", False),  # a file, or a page in a sandbox
        ("file://", False),
        ("http://[", False),
        ("", False),
    ],
)
def test_origins(origin, same):
    assert same_origin(origin, "127.0.0.1:8000") is same


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "http://localhost:1"},
        {"Origin": "http://evil.example:80", "Host": "evil.example:80"},  # DNS rebinding
    ],
)
def test_strangers_get_403(live, headers):
    at = live._at.getsockname()
    host = headers.pop("Host", f"{at[0]}:{at[1]}")
    with pytest.raises(InvalidStatus) as refused, socket.create_connection(at) as raw:
        connect(f"ws://{host}/live", sock=raw, additional_headers=headers, proxy=None).__enter__()
    assert refused.value.response.status_code == 403
    request = urllib.request.Request(live.url, headers={"Host": host, **headers})
    with pytest.raises(urllib.error.HTTPError) as http:
        urllib.request.urlopen(request, timeout=5)
    assert http.value.code == 403
    http.value.close()
    assert live.commands() == []


def test_the_page_of_this_server_is_let_in(live):
    host, port = live._at.getsockname()
    with page_of(live, origin=f"http://{host}:{port}") as page:
        assert told(page, "hello")["run"] == 1
    with urllib.request.urlopen(live.url, timeout=5) as answer:
        policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy


def test_nothing_but_the_page_is_served(live):
    for path in ("static/../handle.py", "static/%2e%2e/handle.py", "handle.py", "static/"):
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(live.url + path, timeout=5)
        assert refused.value.code == 404
        refused.value.close()


# --------------------------------------------------------------------------------- what pages ask


def test_commands_reach_the_bench_and_nonsense_is_answered(live):
    inject = {"do": "inject", "label": "noise", "duration_s": 2.5}
    say = {"do": "say", "label": SAYS[0]}
    clear = {"do": "clear"}, {"do": "clear", "label": "noise"}
    with page_of(live) as page:
        assert told(page, "hello")["says"] == SAYS
        for asked in ({"do": "pause"}, inject, *clear, say):
            page.send(json.dumps(asked))
            assert told(page, "taken")["do"] == asked["do"]
        for nonsense in ("{", b"\xff\x00", '{"do":"format"}', '{"do":"inject","label":"x"}', "[]"):
            page.send(nonsense)
            assert told(page, "refused")["text"]
    assert live.commands() == [
        {"do": "pause"},
        {"do": "inject", **FAULTS[1], "duration_s": 2.5},
        {"do": "clear", "label": None},
        {"do": "clear", "label": "noise"},
        say,
    ]
    assert live.commands() == []


def test_a_bench_that_takes_no_commands_is_not_buried_under_them(live):
    refused = 0
    with page_of(live) as page:
        told(page, "hello")
        for _ in range(60):
            for _ in range(200):
                page.send('{"do":"pause"}')
            answers = [json.loads(text) for text in itertools.islice(page, 200)]
            refused += sum(a["kind"] == "refused" for a in answers)
            if refused:
                break
    assert refused
    assert {c["do"] for c in live.commands()} == {"pause"}


ALARMS = [{"id": k, "time_s": 1.5 * k, "text": f"alarm {k}"} for k in (3, 5, 8)]
GOOD = [
    (
        '{"do":"acknowledge","alarms":[5]}',
        {"do": "acknowledge", "alarms": [5], "label": "'alarm 5' of 7.5 s"},
    ),
    (
        '{"do":"acknowledge","alarms":[8,3,4]}',  # another page was quicker with 4
        {"do": "acknowledge", "alarms": [3, 8], "label": "2 alarms, the last 'alarm 8' of 12.0 s"},
    ),
    ('{"do":"start"}', {"do": "start"}),
    ('{"do":"inject","label":"noise"}', {"do": "inject", **FAULTS[1], "duration_s": None}),
    (
        '{"do":"inject","label":"noise","duration_s":3}',
        {"do": "inject", **FAULTS[1], "duration_s": 3.0},
    ),
    ('{"do":"clear","label":null}', {"do": "clear", "label": None}),
    ('{"do":"say","label":"back to the course"}', {"do": "say", "label": SAYS[0]}),
]
WRONG = [
    (
        '{"do":"starts"}',
        "no command 'starts'; there are: start, pause, stop, inject, clear, say, acknowledge",
    ),
    ('{"do":"acknowledge"}', "a list of their numbers: None"),
    ('{"do":"acknowledge","alarms":3}', "a list of their numbers"),
    ('{"do":"acknowledge","alarms":["3"]}', "a list of their numbers"),
    ('{"do":"acknowledge","alarms":[true]}', "a list of their numbers"),
    ('{"do":"acknowledge","alarms":[3.0]}', "a list of their numbers"),
    ('{"do":"acknowledge","alarms":[]}', "none of these alarms waits"),
    ('{"do":"acknowledge","alarms":[4]}', "none of these alarms waits"),
    ('{"do":"acknowledge","alarms":[3],"label":"all"}', "takes no 'label'"),
    ("{}", "no command None"),
    ('{"do":["start"]}', "no command"),
    ('{"do":"stop","now":1}', "'stop' takes no 'now'"),
    (
        '{"do":"inject","label":"nose"}',
        "no fault is labelled 'nose'; there are: 'star stuck', 'noise'",
    ),
    ('{"do":"inject","fault":{"kind":"x"}}', "takes no 'fault'"),
    ('{"do":"inject","label":"noise","duration_s":0}', "0 to 3600 s"),
    ('{"do":"inject","label":"noise","duration_s":NaN}', "0 to 3600 s"),
    ('{"do":"inject","label":"noise","duration_s":1e999}', "0 to 3600 s"),
    ('{"do":"inject","label":"noise","duration_s":1' + 400 * "0" + "}", "0 to 3600 s"),
    ('{"do":"inject","label":"noise","duration_s":true}', "0 to 3600 s"),
    ('{"do":"inject","label":"noise","duration_s":"3"}', "0 to 3600 s"),
    ('{"do":"say"}', "None cannot be said to the parts; there is: 'back to the course'"),
    ('{"do":"say","label":"noise"}', "'noise' cannot be said"),
    ('{"do":"say","label":["back to the course"]}', "cannot be said"),
    ('{"do":"say","message":"reference","values":{}}', "takes no 'message', 'values'"),
    ('{"do":"clear","label":3}', "label of a fault is a text"),
    ("7", "JSON object"),
    ("[" * 4000, "no JSON"),
    (b"\xff", "no JSON"),
]


@pytest.mark.parametrize(("text", "command"), GOOD)
def test_a_command_is_read(text, command):
    assert read(text, FAULTS, ALARMS, SAYS) == command


@pytest.mark.parametrize(("text", "says"), WRONG)
def test_a_wrong_command_is_told_what_is_wrong(text, says):
    with pytest.raises(CommandError) as error:
        read(text, FAULTS, ALARMS, SAYS)
    assert says in str(error.value)
    assert len(str(error.value)) < 200


values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=9),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=6,
)
keys = st.sampled_from(["do", "label", "duration_s", "fault", "alarms"])
words = st.sampled_from(["start", "stop", "inject", "clear", "noise", "say", "acknowledge", *SAYS])


@given(st.dictionaries(keys, words | values).map(json.dumps) | st.text() | st.binary())
def test_whatever_a_page_sends_is_a_command_or_refused(text):
    try:
        command = read(text, FAULTS, ALARMS, SAYS)
    except CommandError:
        return
    assert command["do"] in {"start", "pause", "stop", "inject", "clear", "say", "acknowledge"}
    if command["do"] == "acknowledge":
        assert set(command["alarms"]) <= {3, 5, 8}
    if command["do"] == "say":
        assert command["label"] in SAYS
    if command["do"] == "inject":
        assert {k: command[k] for k in ("label", "fault")} in FAULTS


# ------------------------------------------------------------------------------------- bad input


def attitude(of: str = "true", name: str = "q") -> list[Signal]:
    return [Signal(f"{name} {c}", "1", "Q", "attitude", of) for c in "wxyz"]


def test_attitudes_are_four_signals_each():
    check([*attitude(), *attitude("estimated", "p"), Signal("a", "m", "A")])


@pytest.mark.parametrize(
    ("signals", "says"),
    [
        ([], "at least one"),
        ([Signal("a", "m", "A"), Signal("a", "m", "B")], "two signals are named 'a'"),
        ([Signal("a", "m", "A"), Signal("b", "s", "A")], "plot 'A' is in m"),
        ([Signal("s", "m", "A", "sigma", "a")], "is of 'a', which is no value of its plot"),
        ([Signal("a", "m", "B"), Signal("s", "m", "A", "sigma", "a")], "no value of its plot"),
        ([Signal("a", "m", "A", "limit", "b")], "only a sigma is"),
        ([Signal("a", "m", "A")._replace(role="mean")], "none of value, sigma, limit, attitude"),
        (attitude()[:3], "attitude 'true' of plot 'Q' must be four signals in a row"),
        ([*attitude(), *attitude(name="p")], "must be four signals in a row"),
        (
            [s._replace(unit="rad") for s in attitude()],
            "signal 'q w': plot 'Q' is one of attitudes",
        ),
        ([s._replace(of="") for s in attitude()], "and says `of` what it is"),
        ([*attitude(), Signal("a", "1", "Q")], "signal 'a': plot 'Q' is one of attitudes"),
    ],
)
def test_signals_that_cannot_be_drawn(signals, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        LivePage(signals, "a bench", 1)


@pytest.mark.parametrize("faults", [[{"label": "a"}], [{"label": 1, "fault": {}}], FAULTS + FAULTS])
def test_faults_that_cannot_be_offered(faults):
    with pytest.raises(ValueError, match="label"):
        LivePage(SIGNALS, "a bench", 1, faults=faults)


def test_a_sample_of_another_length(live):
    with pytest.raises(ValueError, match="3 signals are shown, got 2 values"):
        live.push(0.0, [1.0, 2.0])


def test_a_port_that_is_taken(live):
    port = live._at.getsockname()[1]
    with pytest.raises(OSError, match=rf"cannot listen at 127\.0\.0\.1:{port}: .*; choose another"):
        LivePage(SIGNALS, "a bench", 1, port=port)
    with pytest.raises(OSError, match=r"cannot listen at no\.such\.host\.invalid:0"):
        LivePage(SIGNALS, "a bench", 1, host="no.such.host.invalid")


def test_listening_to_others_is_warned_of():
    with (
        pytest.warns(UserWarning, match="everybody who reaches it can stop this bench"),
        LivePage(SIGNALS, "a bench", 1, host="0.0.0.0") as live,
    ):
        assert socket.gethostname() in live.url


# ------------------------------------------------------------------------------- what is shipped


def test_the_drawing_library_is_named_with_its_licence():
    folder = STATIC / "uplot"
    (version,) = re.findall(r"uPlot ([\d.]+),", (folder / "README.md").read_text())
    assert f"(v{version})" in (folder / "uPlot.iife.min.js").read_text()[:80]
    assert "MIT License" in (folder / "LICENSE").read_text()


def test_no_file_of_the_page_names_another_site():
    allowed = {"https://github.com/leeoniya/uPlot", "http://www.w3.org/2000/svg"}  # never fetched
    for path in STATIC.rglob("*.*"):
        assert set(re.findall(r"https?://[\w./-]+", path.read_text())) <= allowed, path


def contrast(one: str, other: str) -> float:
    """Ratio of luminances of two colours (WCAG 2, 1.4.3)."""

    def luminance(colour: str) -> float:
        rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    a, b = sorted((luminance(one), luminance(other)))
    return (b + 0.05) / (a + 0.05)


def test_colours_can_be_told_and_read_in_both_schemes():
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    css = (STATIC / "page.css").read_text()
    schemes = [
        dict(re.findall(r"--([\w-]+): (#\w+)", b)) for b in re.findall(r":root \{([^}]*)\}", css)
    ]
    assert len(schemes) == 2
    for c in schemes:
        for text in ("text", "dim", "warning", "alarm", "good"):
            assert contrast(c[text], c["panel"]) >= 4.5, text
        for line in "xyzw":
            assert contrast(c[line], c["panel"]) >= 3.0, line
        for text, back in (
            ("on-fill", "fill"),
            ("alarm", "alarm-back"),
            ("warning", "warning-back"),
            ("dim", "back"),
            ("panel", "good"),
        ):
            assert contrast(c[text], c[back]) >= 4.5, text
