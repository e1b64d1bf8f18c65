"""The federated filter against the centralised one and against dense recursions of its modes."""

import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from dense_kalman import System, times
from interpreted import run
from jax.tree_util import Partial
from two_sensors import (
    CHANNELS,
    ROWS,
    STACKED,
    START,
    SYSTEMS,
    N,
    Y,
    added,
    answer,
    centralised,
    corrected,
    one_run,
)

from robins import linalg
from robins.filters import Belief, Model, Motion, Sensor, kalman
from robins.filters.composite.channels import channel
from robins.filters.composite.federated import FLOOR, federated
from robins.filters.rules import huber

VECTOR = np.array([[0.8, 0.3, 0.5, 0.1], [0.2, 0.7, 0.5, 0.9]])


EXACT = {
    "scalar, uneven, with a master": federated(
        CHANNELS, sharing="scalar", shares=[0.6, 0.1], master=0.3
    ),
    "root, a share a state, Joseph": federated(
        [channel("a", kalman(form="joseph")), channel("b", kalman(form="joseph"))], shares=VECTOR
    ),
    "root, by the diagonals": federated(CHANNELS, shares="diagonal"),
    "zero-reset": federated(CHANNELS, mode="zero-reset"),
    "root, shared anew after a time-out": federated(CHANNELS, shares=VECTOR, timeout=5),
}


@pytest.mark.parametrize("one", EXACT.values(), ids=EXACT)
def test_it_is_the_centralised_filter(one):
    # 200 steps of five systems, through 70 steps without one of the sensors.
    parts = [jnp.array(a) for a in (STACKED.F, STACKED.G, STACKED.H, STACKED.W)]
    for i, s in enumerate(SYSTEMS):
        here, start = jax.tree.map(lambda a, i=i: a[i], (parts, START))
        got = answer(one, here, start, Y[i])
        means, covariances = centralised(s, Y[i])
        np.testing.assert_allclose(got.mean, means, rtol=0.0, atol=1e-11)
        np.testing.assert_allclose(got.covariance, covariances, rtol=0.0, atol=1e-11)


def test_cases_of_the_shared_folder(cases_dir):
    every = [json.loads(path.read_text("utf-8")) for path in sorted(cases_dir.glob("*.json"))]
    found = [case for case in every if case["kind"] == "federated_filter"]
    if not found:
        pytest.skip(f"no case of kind federated_filter in {cases_dir}")
    for case in found:
        given = case["given"]
        F, Q, m0, P0 = (np.array(given[k], dtype=float) for k in ("F", "Q", "m0", "P0"))
        names = [f"s{i}" for i in range(len(given["H"]))]
        sensors = tuple(
            Sensor(Partial(times, jnp.array(h)), linalg.factor(np.array(r)), len(h), name)
            for h, r, name in zip(given["H"], given["R"], names, strict=True)
        )
        model = Model(Motion(Partial(times, jnp.array(F)), linalg.factor(Q)), sensors)
        y = {k: np.array(v, dtype=float) for k, v in zip(names, given["y"], strict=True)}
        channels = [channel(name) for name in names]
        one = federated(channels, sharing="scalar", shares=given["beta"])
        solution = run(one, model, Belief.of(jnp.array(m0), P0), y)
        for name, got in (("m", solution.mean), ("P", solution.covariance)):
            for have, want in zip(np.asarray(got), case["expected"][name], strict=True):
                allowed = case["atol"] + case["rtol"] * np.max(np.abs(want))
                assert np.max(np.abs(have - np.array(want))) <= allowed


# -------------------------------------------------------------------- modes, by dense recursions


def split(P, shares, sharing):
    """Covariances of the shares, by the formulas of the papers."""
    D = np.diag(np.sqrt(np.diag(P)))
    root = D @ scipy.linalg.sqrtm(np.linalg.solve(D, np.linalg.solve(D, P).T))
    if sharing == "half":
        return [np.diag(a**-0.5) @ P @ np.diag(a**-0.5) for a in shares]
    return [root @ np.diag(1.0 / a) @ root.T for a in shares]


def dense_federated(s: System, y, mode, sharing, shares, keep=1.0, late=False):
    """Shares (members, n), perhaps a function of the local covariances; a third is a master."""
    choose = shares if callable(shares) else lambda P, fused: shares
    start = np.full((2, N), 0.5) if callable(shares) else shares
    members = [(s.m0, P) for P in split(s.P0, start, sharing)]
    fused, out = (s.m0, s.P0), []
    for row in y:
        a = choose([P for _, P in members], fused[1])
        if late:
            x, P = s.F @ fused[0], s.F @ fused[1] @ s.F.T + s.Q
            members = [(x, part) for part in split(P, a, sharing)]
        else:
            if mode == "fusion-reset":
                members = [(fused[0], part) for part in split(fused[1], a, sharing)]
            elif mode == "rescale":
                Y = [np.linalg.inv(P) for _, P in members]
                kept = [keep * one for one in Y[:-1]]
                Y_g = sum(Y)
                y_g = sum(one @ x for one, (x, _) in zip(Y, members, strict=True))
                Y_m = Y_g - sum(kept)  # as printed, by subtraction
                y_m = y_g - sum(one @ x for one, (x, _) in zip(kept, members[:-1], strict=True))
                members = [
                    (x, np.linalg.inv(one)) for (x, _), one in zip(members, kept, strict=False)
                ]
                members.append((np.linalg.solve(Y_m, y_m), np.linalg.inv(Y_m)))
            noise = split(s.Q, a, sharing)
            members = [
                (s.F @ x, s.F @ P @ s.F.T + q) for (x, P), q in zip(members, noise, strict=True)
            ]
        for i, rows in enumerate(ROWS.values()):
            members[i] = corrected(s, members[i], row, rows)
        fused = added(members)
        out.append(fused)
    return [np.array(series) for series in zip(*out, strict=True)]


def by_trace(covariances, fused):
    weight = np.array([1.0 / np.sum(np.diag(P) / np.diag(fused)) for P in covariances])
    assert np.min(weight / weight.sum()) > 0.05
    return np.tile((weight / weight.sum())[:, None], (1, N))


THREE = np.concatenate([0.75 * VECTOR, np.full((1, N), 0.25)])
MODES = {
    "no-reset, by the trace": (
        partial(federated, mode="no-reset", shares="trace", sharing="scalar"),
        {"mode": "no-reset", "sharing": "root", "shares": by_trace},
    ),
    "rescale, root": (
        partial(federated, mode="rescale", shares=0.75 * VECTOR, master=0.25, keep=0.6),
        {"mode": "rescale", "sharing": "root", "shares": THREE, "keep": 0.6},
    ),
    "half, shared before prediction": (
        partial(federated, shares=VECTOR, sharing="half"),
        {"mode": "fusion-reset", "sharing": "half", "shares": VECTOR},
    ),
    "half, shared after prediction": (
        partial(federated, shares=VECTOR, sharing="half", after_prediction=True),
        {"mode": "fusion-reset", "sharing": "half", "shares": VECTOR, "late": True},
    ),
    "root, shared before prediction": (
        partial(federated, shares=VECTOR, after_prediction=False),
        {"mode": "fusion-reset", "sharing": "root", "shares": VECTOR},
    ),
}


@pytest.mark.parametrize("mode", MODES.values(), ids=MODES)
@pytest.mark.filterwarnings("ignore:sharing='half' is no upper bound:UserWarning")
def test_modes_are_what_the_papers_say(mode):
    make, dense = mode
    means, covariances = dense_federated(SYSTEMS[0], Y[0, :40], **dense)
    got = one_run(make(CHANNELS))
    np.testing.assert_allclose(got[0], means, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(got[1], covariances, rtol=1e-8, atol=1e-9)
    central = centralised(SYSTEMS[0], Y[0, :40])[1]
    assert np.max(np.abs(got[1] - central)) > 1e-3  # none of these is the centralised filter


# ------------------------------------------------------------------------------------- time-outs

ROBUST = channel("a", kalman(rules=[huber(0.9)]))


@pytest.mark.parametrize(
    "given",
    [{"sharing": "scalar", "shares": [0.3, 0.7]}, {"shares": VECTOR}, {"shares": "diagonal"}],
    ids=["scalar", "root", "diagonal"],
)
def test_a_silent_filter_hands_its_share_to_the_others(given):
    """The rest is the federated filter of the others, with a master that holds the floor."""
    s, y = SYSTEMS[0], {"a": Y[0, :12, :2] * 1.5, "b": np.full((12, 1), np.nan)}
    motion = Motion(Partial(times, jnp.array(s.F)), s.G)
    rows = {name: jnp.array(s.H[r]) for name, r in ROWS.items()}
    sensors = [
        Sensor(Partial(times, rows[k]), jnp.array(s.W[r, r]), r.stop - r.start, k)
        for k, r in ROWS.items()
    ]
    both, alone = Model(motion, tuple(sensors)), Model(motion, (sensors[0],))
    one = federated([ROBUST, channel("b")], **given, timeout=2)
    got = run(one, both, s.start(), y)
    start = jax.tree.map(lambda a: a[1], got.steps.posterior)
    held = FLOOR / (1.0 + FLOOR)
    late = given.get("sharing") != "scalar"
    rest = federated([ROBUST], "fusion-reset", "scalar", [1.0 - held], held, after_prediction=late)
    want = run(rest, alone, start, {"a": y["a"][2:]})
    np.testing.assert_allclose(got.mean[2:], want.mean, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(got.covariance[2:], want.covariance, rtol=1e-10, atol=1e-10)
    assert np.any(np.asarray(want.steps.info["a"].notes["huber.weight"]) < 0.9)
    if late and given["shares"] is VECTOR:
        never = run(federated([ROBUST, channel("b")], **given), both, s.start(), y)
        np.testing.assert_array_equal(never.mean[:2], got.mean[:2])
        assert np.max(np.abs(never.mean - got.mean)) > 1e-3  # Huber judges by another covariance


def test_a_share_comes_back_with_the_next_measurement_and_stays_where_all_are_silent():
    y = {k: np.nan_to_num(Y[0, :11, r]) for k, r in ROWS.items()}
    y["b"][2:6] = np.nan
    y["a"][7:] = y["b"][7:] = np.nan
    s = SYSTEMS[0]
    model = Model(
        Motion(Partial(times, jnp.array(s.F)), s.G),
        tuple(
            Sensor(Partial(times, jnp.array(s.H[r])), jnp.array(s.W[r, r]), r.stop - r.start, k)
            for k, r in ROWS.items()
        ),
    )
    one = federated(CHANNELS, sharing="scalar", shares=[0.3, 0.5], master=0.2, timeout=2)
    got = run(one, model, s.start(), y)
    share = np.asarray(got.steps.info["a"].notes["federated.share"])
    left = 0.8 / (1.0 + FLOOR)
    # Silent for two steps before the step that shares anew; heard again in step 6, shared in 7.
    np.testing.assert_allclose(share, [0.3] * 4 + [left] * 3 + [0.3] * 4, rtol=1e-12)
    assert float(got.final.memory.shares[2, 0]) == 0.2


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"mode": "no-reset", "timeout": 3}, "does not share anew"),
        ({"timeout": 0}, "at least one step"),
    ],
)
def test_a_timeout_that_makes_no_sense_is_refused(given, said):
    with pytest.raises(ValueError, match=said):
        federated(CHANNELS, **given)
