"""The product model of transfer alignment: derivatives, readings, delays, consistency, refusals."""

from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_lanes import each
from scipy.spatial.transform import Rotation as SciRotation

from robins.campaign.statistics import Statistics
from robins.earth import Geodetic
from robins.filters import Code, kalman, run
from robins.ins.increments import Increments
from robins.ins.state import InsNoise, InsState
from robins.manifold import local, retract
from robins.rotation import Rotation
from robins.scenario import ScenarioError, load, parse
from robins.sim.flexure import Flexure
from robins.systems import transfer_alignment
from robins.systems.judgement import claim_judge
from robins.systems.parts import ImuBlock
from robins.systems.tables import SensorUpdates
from robins.systems.transfer_alignment.product import model as p
from robins.systems.transfer_alignment.product.filters import FILTERS, VARIANTS
from robins.systems.transfer_alignment.product.parameters import PairAssumptions, Product
from robins.systems.transfer_alignment.product.study import (
    CLAIMS,
    STUDY,
    product_contender,
    product_metrics,
    reported,
    start_sigma,
)
from robins.systems.transfer_alignment.product.world import lay_out, simulate_pair

MINUTE, DEG_H = np.deg2rad(1.0) / 60.0, np.deg2rad(1.0) / 3600.0
SCENARIOS = Path(transfer_alignment.__file__).parent / "scenarios"
FLEXURE = Flexure(np.array([8.0, 5.6, 2.4]) * MINUTE, np.array([3.0, 2.0, 1.0]), 0.7)
NOISE = InsNoise(1e-5, 1e-4, 1e-7, 1e-6)
AT = p.Installation(Rotation.from_euler(0.1, -0.2, 1.5), jnp.array([-1.0, 6.0, 0.5]))
# the size of an error that matters, in tangent order: columns of Jacobians are compared in it
SIZE = np.repeat([1e-3, 0.1, 10.0, 1e-5, 1e-2, 1e-3, 1e-3, 1e-3], 3)

S_TURN = """
settle = "30 s"
[manoeuvre]
kind = "aircraft"
latitude = "32 deg"
longitude = "0 deg"
speed = "100 m/s"
pitch = "2 deg"
legs = [
    {bank = "0 deg", seconds = "10 s"},
    {bank = "30 deg", seconds = "31 s"},
    {bank = "-30 deg", seconds = "30 s"},
    {bank = "0 deg", seconds = "49 s"},
]
[slave]
rate = "10 Hz"
gyro_noise = "0.05 deg/sqrt(h)"
accel_noise = "50 ug/sqrt(Hz)"
gyro_bias = "5 deg/h"
accel_bias = "1 mg"
[master]
attitude_noise = "1 arcmin"
velocity_noise = "0.05 m/s"
[start]
attitude = ["0.5 deg", "0.5 deg", "1 deg"]
velocity = "0.3 m/s"
position = "10 m"
[disturbance]
dropouts = [{begin = "100 s", end = "100.5 s"}]
"""
LOST, HALF = slice(999, 1004), 1050  # epochs without a record, and one without its north velocity


def random_state(seed: int, pitch_deg: float = 10.0) -> tuple[p.ProductState, p.RecordDelay]:
    rng = np.random.default_rng(seed)
    draw = lambda size: jnp.asarray(size * rng.normal(size=3))  # noqa: E731
    ins = InsState(
        Rotation.from_euler(rng.uniform(-1, 1), np.deg2rad(pitch_deg), rng.uniform(-3, 3)),
        draw(80.0),
        Geodetic(*(jnp.asarray(v) for v in (rng.uniform(-1.2, 1.2), rng.uniform(-3, 3), 2e3))),
        draw(5e-5),
        draw(1e-2),
    )
    x = p.ProductState(ins, draw(0.02), jnp.concatenate([draw(0.003), draw(0.002)]))
    age = rng.uniform(0.0, 0.2)
    lag = p.RecordDelay(age, draw(0.5 * age), draw(15.0 * age), draw(0.5))
    return x, jax.tree.map(jnp.asarray, lag)


def block(seed: int) -> ImuBlock:
    rng = np.random.default_rng(seed)
    dt = np.array([0.02, 0.02, 0.0, 0.02])
    rate, force = rng.normal(size=(4, 3)), rng.normal(size=(4, 3)) * 3.0 - [0, 0, 10.0]
    arrays = (jnp.asarray(a) for a in (dt, rate * dt[:, None], force * dt[:, None]))
    return ImuBlock(Increments(*arrays), 3.0)


# ------------------------------------------------------------------------------ derivatives


def central(g, x):
    """g at x, and its Jacobian between tangent spaces by central differences in units of `SIZE`."""
    step = 1e-2 * jnp.diag(jnp.asarray(SIZE))
    ends = jnp.concatenate([jnp.zeros((1, 24)), step, -step])
    values = jax.vmap(lambda d: g(retract(x, d)))(ends)  # all by one, which is traced once
    value, others = (jax.tree.map(lambda v, at=at: v[at], values) for at in (0, slice(1, None)))
    away = jax.vmap(lambda other: local(value, other))(others)
    return value, (away[:24] - away[24:]).T / 2e-2


SIGMAS = {p.ATTITUDE: MINUTE, p.VELOCITY: 0.05, p.POSITION: 5.0}


class Derived(NamedTuple):
    """Derivatives of a state, by the model and by differences."""

    Phi: Any
    factor: Any  # of the process noise
    pairs: dict[str, tuple[Any, Any, Any]]  # Jacobian, by differences, values apart


@pytest.fixture(scope="module")
def derived():
    model = p.product_model(NOISE, AT, SIGMAS, FLEXURE)
    motion, sensors = model.motion, model.sensors[:2]

    @jax.jit
    def both(x, lag, inc):
        assert motion.linear is not None
        new, Phi, factor = motion.linear(x, inc)
        moved, differences = central(lambda s: motion.step(s, inc), x)
        out = {"motion": (Phi, differences, local(new, moved))}
        for sensor in sensors:
            assert sensor.linear is not None
            z, H = sensor.linear(x, lag)
            read, differences = central(lambda s, r=sensor.read: r(s, lag), x)
            out[sensor.name] = (H, differences, local(z, read))
        return Derived(Phi, factor, out)

    return both


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("pitch_deg", [10.0, 89.9999])
def test_jacobians_are_those_of_differences(derived, seed, pitch_deg):
    x, lag = random_state(seed, pitch_deg)
    found = derived(x, lag, block(seed)).pairs
    for name, (analytic, differences, apart) in found.items():
        scaled = analytic * SIZE[None]
        row = np.max(np.abs(scaled), axis=1, keepdims=True)
        limit = 1e-7 if name == "motion" else 1e-8
        assert np.max(np.abs(scaled - differences) / row) < limit, name
        np.testing.assert_allclose(apart, 0.0, atol=1e-13)
        assert np.max(row) > 1e-4  # it reads something


def test_flexure_and_mounting_move_apart_from_the_slave(derived):
    """Flexure keeps its steady state, mounting stays, and nothing couples them to the slave."""
    x, lag = random_state(0)
    inc = block(0)
    Phi, L, _ = (np.asarray(a) if i < 2 else a for i, a in enumerate(derived(x, lag, inc)))
    Q = L @ L.T / 9.0  # of a noise three times as large
    assert np.all(Q[15:18] == 0.0)
    assert np.all(Q[:18, 18:] == 0.0)
    assert np.all(Phi[:18, 18:] == 0.0)
    assert np.all(Phi[15:18] == np.eye(24)[15:18])
    wn = 2.146 / FLEXURE.tau_s
    steady = np.diag(np.r_[FLEXURE.sigma_rad, FLEXURE.sigma_rad * wn] ** 2)
    F = Phi[18:, 18:]
    np.testing.assert_allclose(F @ steady @ F.T + Q[18:, 18:], steady, rtol=1e-9, atol=1e-15)


def flexure_of(name, believed):
    return VARIANTS[name].flexure(believed.flexure)


def test_start_of_the_flexure_is_its_steady_state():
    believed = PairAssumptions.model_validate_json(
        '{"flexure": {"sigma": ["8 arcmin", "5 arcmin", "0 arcmin"], "time": "2 s",'
        ' "damping": 0.3}, "mounting": "0.2 deg"}'
    )
    sigma = start_sigma(PAIR, believed, flexure_of("product", believed))
    np.testing.assert_allclose(sigma[15:18], np.deg2rad(0.2))
    np.testing.assert_allclose(sigma[18:21], np.array([8.0, 5.0, 0.0]) * MINUTE, rtol=1e-9)
    np.testing.assert_allclose(sigma[21:], sigma[18:21] * 2.146 / 2.0, rtol=1e-9)


# --------------------------------------------------------------------------------- readings


def test_master_is_read_through_mounting_and_flexure():
    """Attitude by SciPy's matrices; velocity and place by the cross product of whole rates."""
    x, lag = random_state(7)
    lag = lag._replace(dt=jnp.asarray(0.0), theta=jnp.zeros(3), dv=jnp.zeros(3))
    exp = lambda v: SciRotation.from_rotvec(np.array(v)).as_matrix()  # noqa: E731
    nominal = SciRotation.from_euler("ZYX", [1.5, -0.2, 0.1]).as_matrix()
    C_ms = exp(x.flexure[:3]) @ nominal @ exp(x.mounting_rad)
    w, i, j, k = np.asarray(x.ins.q_nb.wxyz)
    C_nm = SciRotation.from_quat([i, j, k, w]).as_matrix() @ C_ms.T
    sensors = p.product_model(NOISE, AT, SIGMAS, FLEXURE).sensors
    q_nm, v_n, place = (s.read(x, lag) for s in sensors)
    np.testing.assert_allclose(q_nm.as_dcm(), C_nm, atol=1e-14)

    lat, alt = float(x.ins.position.lat), 2e3
    north, east, _ = np.asarray(x.ins.v_n)
    a, e2, omega = 6378137.0, 6.69437999014e-3, 7.292115e-5
    w_sq = 1.0 - e2 * np.sin(lat) ** 2
    meridian, transverse = a * (1.0 - e2) / w_sq**1.5 + alt, a / np.sqrt(w_sq) + alt
    omega_ie = np.array([omega * np.cos(lat), 0.0, -omega * np.sin(lat)])
    omega_en = np.array([east / transverse, -north / meridian, -east * np.tan(lat) / transverse])
    omega_in = omega_ie + omega_en
    omega_nm_m = np.asarray(lag.omega_m) - C_nm.T @ omega_in
    arm = np.asarray(AT.lever_m)
    expected = np.asarray(x.ins.v_n) - C_nm @ np.cross(omega_nm_m, arm)
    np.testing.assert_allclose(v_n, expected, atol=1e-10)
    np.testing.assert_allclose(local(x.ins.position, place), -C_nm @ arm, atol=1e-8)


def test_lag_collects_what_the_slave_felt():
    """Sums over the delay, part of a sample included, by SciPy; padding is passed over."""
    rng = np.random.default_rng(3)
    dt = np.where(np.arange(12) % 4 == 3, 0.0, 0.01).reshape(3, 4)
    theta = 0.02 * rng.normal(size=(3, 4, 3)) * (dt > 0.0)[..., None]
    dv = 0.1 * rng.normal(size=(3, 4, 3)) * (dt > 0.0)[..., None]
    rate = np.array([[1.0, np.nan, 2.0]] * 3)
    lag = p.lag_of(Increments(dt, theta, dv), 0.035, rate)
    np.testing.assert_array_equal(lag.omega_m, [[1.0, 0.0, 2.0]] * 3)
    # the last epoch: all three samples of its block and half of the one before
    pieces = [(1, 2, 0.5), (2, 0, 1.0), (2, 1, 1.0), (2, 2, 1.0)]
    turned, gained = SciRotation.identity(), np.zeros(3)
    for i, j, share in reversed(pieces):
        back = turned * SciRotation.from_rotvec(-share * theta[i, j])
        turned, gained = back, gained + back.apply(share * dv[i, j])
    np.testing.assert_allclose(np.asarray(lag.theta)[-1], turned.inv().as_rotvec(), atol=1e-14)
    np.testing.assert_allclose(np.asarray(lag.dv)[-1], gained, atol=1e-14)
    none = p.lag_of(Increments(dt, theta, dv), 0.0, rate)
    assert not np.any(none.theta)
    assert not np.any(none.dv)


# ------------------------------------------------------------------------------- whole runs


def with_mounting(pair: Product, error) -> Product:
    """The scenario with a true mounting error that may be traced."""
    return pair.model_copy(update={"mounting": pair.mounting.model_copy(update={"error": error})})


RUNS = 24
PAIR = parse(Product, S_TURN)
CONTENDER = product_contender(PAIR)
course = cache(partial(lay_out, PAIR))


@each
def runs(one):
    """Errors, sigmas and sigmas before the velocity of "product", and what became of that."""
    index, mounting_error = one
    world = simulate_pair(with_mounting(PAIR, mounting_error), course(), 0, index)
    case = CONTENDER.case(world)
    y = {**case.y, p.VELOCITY: case.y[p.VELOCITY].at[HALF, 0].set(jnp.nan)}
    keep = lambda s: (s.posterior, s.prediction.belief.sigma, s.info[p.VELOCITY].code)  # noqa: E731
    found = run(kalman(form="joseph"), CONTENDER.model, case.start, y, case.u, case.aux, keep)
    belief, before, code = found.steps
    errors = jax.lax.map(lambda pair: local(*pair), (belief.mean, case.truth))
    return errors, belief.sigma, before, code


@cache
def aligned(mounting_error_deg):
    course()  # before it is traced
    return runs((np.arange(RUNS), np.full((RUNS, 3), np.deg2rad(mounting_error_deg))))


def settled(mounting_error_deg):
    """Errors and sigmas, (runs, epochs from 30 s on, 18)."""
    counts = course().epoch_s > PAIR.settle
    return [a[:, counts] for a in aligned(mounting_error_deg)[:2]]


def pooled(x, block):
    return np.sqrt(np.mean(x[..., block] ** 2, axis=(-3, -2, -1)))


@pytest.mark.parametrize("mounting_error_deg", [0.0, 0.3])
def test_errors_are_as_large_as_the_filter_says(mounting_error_deg):
    """Scenarios A and E at full initial errors, from 30 s on."""
    e, s = settled(mounting_error_deg)
    attitude = slice(0, 3)
    ratio = pooled(e, attitude) / pooled(s, attitude)
    assert 0.9 < ratio < 1.1
    assert pooled(e, attitude) < 0.4 * MINUTE
    for at in (slice(3, 6), slice(9, 12), slice(12, 15)):
        assert 0.85 < pooled(e, at) / pooled(s, at) < 1.15


def test_mounting_is_found():
    e, s = (pooled(a[:, -1:], slice(15, 18)) for a in settled(0.3))
    assert e < 0.2 * MINUTE
    assert 0.8 < e / s < 1.2


def test_missing_records_are_passed_over():
    _, sigma, before, code = aligned(0.3)
    assert np.all(code[:, LOST] == Code.MISSING)
    assert np.all(code[:, HALF] == Code.PARTLY_MISSING)
    assert np.sum(code != Code.DONE) == RUNS * 6
    np.testing.assert_array_equal(sigma[:, LOST], before[:, LOST])
    assert np.all(sigma[:, HALF, 4] < before[:, HALF, 4])


SHIP = [SCENARIOS / "ship.toml", ['manoeuvre.seconds="20 s"', 'settle="0 s"']]
NO_NOISE = [
    'settle="0 s"',
    'manoeuvre.legs=[{bank="0 deg", seconds="4 s"}, {bank="-60 deg", seconds="16 s"}]',
    'slave.gyro_noise="0 deg/sqrt(h)"',
    'slave.accel_noise="0 ug/sqrt(Hz)"',
    'master.attitude_noise="1e-9 arcmin"',
    'master.velocity_noise="1e-9 m/s"',
    'master.position_noise="1e-9 m"',
    'master.delay="80 ms"',
    'mounting.nominal=["10 deg", "-20 deg", "70 deg"]',
    'flexure={sigma="8 arcmin", time="6 s"}',
    'believed={position=true, flexure={sigma="8 arcmin", time="6 s"}}',
]


def test_without_noise_the_reading_is_the_record():
    """A steep turn, with biases, mounting, flexure, lever arm and records 80 ms late."""
    pair = load(Product, SCENARIOS / "aircraft.toml", NO_NOISE)
    contender = product_contender(pair, believed=pair.believed)
    course = lay_out(pair)

    @each
    def apart(index):
        case = contender.case(simulate_pair(pair, course, 3, index))
        return {
            s.name: jax.lax.map(
                lambda row, s=s: local(s.read(row[0], row[2]), row[1]),
                (case.truth, case.y[s.name], case.aux[s.name]),
            )
            for s in contender.model.sensors
        }

    found = {k: v[0, 1:] for k, v in apart(np.arange(1)).items()}
    assert all(np.all(np.isfinite(v)) for v in found.values())
    assert np.max(np.abs(found[p.ATTITUDE])) < 0.2 * MINUTE
    assert np.max(np.abs(found[p.VELOCITY])) < 3e-3
    assert np.max(np.abs(found[p.POSITION])) < 3e-3


# ------------------------------------------------------------------------------- the study


@pytest.mark.parametrize("name", ["aircraft", "ship", "vehicle"])
def test_packaged_scenarios_can_be_read(name):
    pair = load(Product, SCENARIOS / f"{name}.toml")
    assert pair.study == "product"
    assert set(pair.filters) <= set(FILTERS)


def test_filters_have_flexure_states_where_they_should():
    believed = PairAssumptions.model_validate_json(
        '{"flexure": {"sigma": "8 arcmin", "time": "2 s"}}'
    )
    assert flexure_of("kf", believed) is None
    assert flexure_of("product", PairAssumptions()) is None
    told = flexure_of("product", believed)
    assert told is not None
    assert np.all(told.tau_s == 2.0)
    assert flexure_of("product-flexure", PairAssumptions()) is not None


def test_reported_rows_in_the_other_frame():
    """ENU and right-forward-up swap the first two axes and turn the third."""
    error = np.arange(24.0)
    np.testing.assert_array_equal(reported(24) @ error, error[:18])
    rows = reported(24, ("gyro_bias", "attitude"), "ENU")
    np.testing.assert_array_equal(rows @ error, [10, 9, -11, 1, 0, -2])
    with pytest.raises(ValueError, match=r"blocks are attitude, .* got wings in NED"):
        reported(24, ("wings",))


@pytest.mark.parametrize(
    ("settings", "filters", "words"),
    [
        ((), ("product", "best"), "no filter 'best' in this study. It has kf, product"),
        (('settle="21 s"',), ("kf",), "settle = 21 s leaves nothing to count of a run of 20 s"),
        (
            ('master.velocity_noise=["0.1 m/s", "0 m/s", "0.1 m/s"]',),
            ("kf",),
            r"master.velocity_noise is \(0.1, 0.0, 0.1\): .* above zero",
        ),
    ],
)
def test_what_cannot_be_aligned_is_refused(settings, filters, words):
    file, short = SHIP
    with pytest.raises(ValueError, match=words):
        STUDY.problem(load(Product, file, [*short, *settings]), filters, 0)


def test_a_word_that_is_not_known_is_refused():
    with pytest.raises(ScenarioError, match=r"believed\.flexur"):
        parse(Product, S_TURN, ['believed.flexur={sigma="8 arcmin"}'])


def statistics(scale, runs=60, epochs=40, seed=0):
    """Records of a filter that states sigma = 1' everywhere and errs by `scale` times as much."""
    rng = np.random.default_rng(seed)
    error = MINUTE * np.asarray(scale) * rng.normal(size=(runs, epochs, 18))
    white = error / MINUTE
    nis = np.sum(rng.normal(size=(runs, epochs, 3)) ** 2, axis=2)
    record = {
        "error": error,
        "sigma": np.full_like(error, MINUTE),
        "nees": np.sum(white**2, axis=2),
        "dim": np.full(runs, 18),
        "block_nees": {},
        "mean": {},
        "updates": {
            p.VELOCITY: SensorUpdates(
                np.zeros((runs, epochs, 3)),
                np.ones((runs, epochs, 3)),
                nis,
                np.full((runs, epochs), 3),
                np.zeros((runs, epochs), int),
            )
        },
    }
    problem = STUDY.problem(load(Product, *SHIP), (), 0)
    statistics = Statistics(problem.blocks, 0, problem.limits)
    statistics.add(record)
    return statistics


def test_metrics_are_in_their_units_and_order():
    scale = np.r_[2.0, 3.0, 4.0, np.full(15, 1.0)]
    m = product_metrics(statistics(scale))
    np.testing.assert_allclose(m["attitude_rms_arcmin"], [3.0, 2.0, 4.0], rtol=0.05)
    assert m["attitude_rms_all_arcmin"] == pytest.approx(np.sqrt(29.0 / 3.0), rel=0.05)
    assert m["attitude_over_sigma"] == pytest.approx(np.sqrt(29.0 / 3.0), rel=0.05)
    np.testing.assert_allclose(m["gyro_bias_rms_deg_per_h"], MINUTE / DEG_H, rtol=0.1)
    np.testing.assert_allclose(m["accel_bias_rms_mg"], MINUTE / 9.80665e-3, rtol=0.1)
    np.testing.assert_allclose(m["mounting_last_sigma_arcmin"], 1.0)
    assert m["nis_master_velocity"] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("scale", "held"), [(1.0, {"sigma", "anees", "nis", "aligned"}), (1.3, {"nis"})]
)
def test_claims_hold_for_a_right_filter_only(scale, held):
    claims = claim_judge(CLAIMS)({"product": product_metrics(statistics(scale, epochs=200))})
    assert [c["id"] for c in claims] == list(CLAIMS)
    assert {c["id"] for c in claims if c["verdict"] == "reproduced"} == held
    assert claim_judge(CLAIMS)({"kf": {}}) == []
