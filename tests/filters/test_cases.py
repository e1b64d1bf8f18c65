"""Reference numbers computed in 60 digits by independent recursions, at their stated tolerance."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run

from robins import linalg
from robins.filters import (
    Belief,
    Model,
    Motion,
    Sensor,
    kalman,
    rts_smoother,
    sigma_points,
    sigma_weights,
    taylor,
    unscented,
    unscented_transform,
)
from robins.manifold import Angle


def cases(folder, kind: str) -> list[dict]:
    """All cases of a kind, so that new files are tested as they come."""
    every = [json.loads(path.read_text("utf-8")) for path in sorted(folder.glob("*.json"))]
    found = [case for case in every if case["kind"] == kind]
    if not found:
        pytest.skip(f"no case of kind {kind} in {folder}")
    return found


def given(case: dict, *names: str) -> list[np.ndarray]:
    """Arrays of a case; ``null`` becomes NaN."""
    return [np.array(case["given"][name], dtype=float) for name in names]


def check(case: dict, series: bool = False, **got) -> None:
    """The rule of the cases: |got - want| <= atol + rtol max|want| over an array, per time step."""
    assert set(got) >= set(case["expected"]), f"{case['name']} expects more than was computed"
    for name, want in case["expected"].items():
        want = np.array(want, dtype=float)
        have = np.asarray(got[name])
        assert have.shape == want.shape, f"{case['name']}: {name} has another shape"
        steps = zip(have, want, strict=True) if series and want.ndim else [(have, want)]
        for k, (one, right) in enumerate(steps):
            allowed = case["atol"] + case["rtol"] * np.max(np.abs(right))
            worst = np.max(np.abs(one - right))
            assert worst <= allowed, f"{case['name']}: {name}[{k}] off by {worst}, not {allowed}"


def linear(case: dict) -> tuple[Model, Belief]:
    F, Q, H, R, m0, P0 = given(case, "F", "Q", "H", "R", "m0", "P0")
    A, C = jnp.array(F), jnp.array(H)
    sensor = Sensor(lambda x, aux: C @ x, linalg.factor(R), len(H))
    model = Model(Motion(lambda x, u: A @ x, linalg.factor(Q)), (sensor,))
    return model, Belief.of(jnp.array(m0), P0)


def pendulum(dt: float):
    def step(x, u):
        return jnp.stack([x[0] + x[1] * dt, x[1] - 9.8 * jnp.sin(x[0]) * dt])

    return step, lambda x, aux: jnp.sin(x[:1]), lambda y: y


def coordinated_turn(dt: float):
    def step(x, u):
        _, _, v, heading, rate = x
        still = jnp.zeros(())
        return x + dt * jnp.stack([v * jnp.cos(heading), v * jnp.sin(heading), still, rate, still])

    def read(x, aux):
        return jnp.hypot(x[:1], x[1:2]), Angle(jnp.arctan2(x[1], x[0]))

    return step, read, lambda y: (y[:, :1], Angle(y[:, 1]))


MODELS = {"pendulum": pendulum, "coordinated_turn": coordinated_turn}


def nonlinear(case: dict) -> tuple[Model, Belief, object]:
    Q, R, m0, P0, y = given(case, "Q", "R", "m0", "P0", "y")
    step, read, as_read = MODELS[case["given"]["model"]](case["given"]["dt"])
    sensor = Sensor(read, linalg.factor(R), len(R))
    model = Model(Motion(step, linalg.factor(Q)), (sensor,))
    return model, Belief.of(jnp.array(m0), P0), as_read(jnp.array(y))


def weights_of(case: dict) -> tuple:
    return tuple(case["given"][name] for name in ("alpha", "beta", "kappa"))


def filtered(solution):
    return {"m": solution.mean, "P": solution.covariance, "loglik": solution.log_likelihood}


def test_kf_filter(cases_dir):
    for case in cases(cases_dir, "kf_filter"):
        check(case, series=True, **filtered(run(kalman(), *linear(case), given(case, "y")[0])))


def test_rts_smoother(cases_dir):
    for case in cases(cases_dir, "rts_smoother"):
        solution = run(kalman(), *linear(case), given(case, "y")[0])
        smooth = rts_smoother(solution)
        check(case, series=True, m=smooth.mean, P=smooth.covariance, loglik=solution.log_likelihood)


@pytest.mark.parametrize("form", ["sqrt", "joseph"])
def test_ekf_filter(cases_dir, form):
    for case in cases(cases_dir, "ekf_filter"):
        check(case, series=True, **filtered(run(kalman(form=form), *nonlinear(case))))


@pytest.mark.parametrize("form", ["sqrt", "joseph"])
def test_ukf_filter(cases_dir, form):
    for case in cases(cases_dir, "ukf_filter"):
        ukf = kalman(unscented(*weights_of(case), redraw=case["given"]["redraw"]), form=form)
        check(case, series=True, **filtered(run(ukf, *nonlinear(case))))


def test_sigma_points(cases_dir):
    for case in cases(cases_dir, "sigma_points"):
        m, P = given(case, "m", "P")
        weights = sigma_weights(len(m), *weights_of(case))
        points = sigma_points(Belief.of(jnp.array(m), P), weights.reach)
        check(case, points=points, wm=weights.mean, wc=weights.covariance)


def test_unscented_polar(cases_dir):
    for case in cases(cases_dir, "unscented_polar"):
        m, P = given(case, "m", "P")
        found = unscented_transform(
            Belief.of(jnp.array(m), P),
            lambda x: x[0] * jnp.stack([jnp.cos(x[1]), jnp.sin(x[1])]),
            *weights_of(case),
        )
        check(case, m=found.mean, P=found.covariance)


def test_discretize(cases_dir):
    for case in cases(cases_dir, "discretize"):
        A, Qc = given(case, "A", "Qc")
        Phi, Qd = linalg.van_loan(jnp.array(A), jnp.array(Qc), case["given"]["dt"])
        check(case, Phi=Phi, Qd=Qd)


# ------------------------------------------------ the cases' own laws, where the folder is absent


def test_the_check_can_fail():
    case = {"name": "x", "expected": {"m": [[1.0, 2.0], [3.0, 4.0]]}, "rtol": 1e-3, "atol": 0.0}
    check(case, series=True, m=[[1.0, 2.0019], [3.0, 4.0]])
    with pytest.raises(AssertionError, match=r"m\[0\] off by"):
        check(case, series=True, m=[[1.0, 2.0021], [3.0, 4.0]])
    with pytest.raises(AssertionError, match="another shape"):
        check(case, series=True, m=[1.0, 2.0])
    with pytest.raises(AssertionError, match="expects more"):
        check(case, series=True, P=1.0)


@pytest.mark.parametrize("way", [taylor(), unscented(0.5, 2.0, 1.0)], ids=["ekf", "ukf"])
def test_a_bearing_that_crosses_pi_changes_nothing(way):
    # The same turn, seen in a frame rotated by half a turn: bearings now pass through +-pi.
    step, read, as_read = coordinated_turn(0.5)
    model = Model(
        Motion(step, jnp.array([0.1, 0.1, 0.1, 0.01, 0.01])),
        (Sensor(read, jnp.array([0.5, 0.05]), 2),),
    )
    rng = np.random.default_rng(0)
    x, y = np.array([20.0, -6.0, 3.0, np.pi / 2, 0.05]), []
    for _ in range(12):
        x = np.asarray(step(jnp.array(x), None))
        y.append([np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])] + rng.normal(size=2) * [0.5, 0.05])
    y = np.array(y)
    P0 = np.diag([4.0, 4.0, 1.0, 0.1, 0.01])
    turned = np.array([-20.0, 6.0, 3.0, -np.pi / 2, 0.05])
    other = np.stack([y[:, 0], (y[:, 1] + 2 * np.pi) % (2 * np.pi) - np.pi], axis=1)
    assert np.ptp(np.sign(other[:, 1])) == 2  # it does cross
    plain, rotated = (
        run(kalman(way), model, Belief.of(jnp.array(m0), P0), as_read(jnp.array(seen)))
        for m0, seen in ((np.array([20.0, -6.0, 3.0, np.pi / 2, 0.05]), y), (turned, other))
    )
    flip = np.array([-1.0, -1.0, 1.0, 1.0, 1.0])
    shift = np.array([0.0, 0.0, 0.0, np.pi, 0.0])
    np.testing.assert_allclose(
        rotated.mean, np.asarray(plain.mean) * flip - shift, rtol=1e-10, atol=1e-10
    )
    assert float(rotated.log_likelihood) == pytest.approx(float(plain.log_likelihood), rel=1e-10)
