"""Bad samples, lost sensors and scenarios that cannot be, in the rocket's filters."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_lanes import each
from scipy.spatial.transform import Rotation as Turn

from robins import scenario
from robins.campaign.machine import first_run, first_worlds
from robins.filters import Belief, Code, OnlineFilter, run
from robins.filters.rules.discriminator import DiscriminatorVerdict
from robins.rotation import Rotation
from robins.scenario import ScenarioError
from robins.systems.rocket import SYSTEM
from robins.systems.rocket.angles import GYRO, MAGNETIC
from robins.systems.rocket.field import FIELD, FieldState, plausible
from robins.systems.rocket.field import GyroTurn as Turned
from robins.systems.rocket.parameters import FieldVector, MagneticAttitude
from robins.systems.rocket.study import FIELD_VECTOR, MAGNETIC_ATTITUDE, PATIENCE

DEG = np.pi / 180.0
AT = 150  # the sample that is bad, or the first of them
SHORT = 'duration="25 s"'
COUNTED = 'counted_from="5 s"'


def parsed(kind, name, *settings):
    text = SYSTEM.scenarios[name].read_text()
    return scenario.parse(kind, text, (SHORT, COUNTED, *settings), source=name)


class Seen(NamedTuple):
    """Results of each step of a run."""

    posterior: Belief
    predicted: Belief
    info: dict[str, Any]
    predictable: Any  # codes of the predictions


def seen_of(step):
    info = {name: (i.code, i.notes) for name, i in step.info.items()}
    return Seen(step.posterior, step.prediction.belief, info, step.prediction.code)


def found(c, worlds):
    """Results of a contender in many worlds, leading axis."""

    def one(world):
        it = c.case(world)
        return run(c.filter, c.model, it.start, it.y, it.u, it.aux, keep=seen_of).steps

    return jax.tree.map(np.asarray, each(one)(worlds))


def same(a, b):
    return all(map(np.array_equal, jax.tree.leaves(a), jax.tree.leaves(b)))


class Flight(NamedTuple):
    """A flight that measures the field vector, and what is done to its magnetometer."""

    problem: Any
    world: Any
    cases: dict[str, np.ndarray]  # measured fields
    gated: (
        Seen  # leading axis: cases, a gyro lost for a second, and last the flight along the field
    )
    along: Any  # problem of a flight that spins about the field without coning
    along_world: Any

    def of(self, case):
        return jax.tree.map(lambda x: x[list(self.cases).index(case)], self.gated)


def turned_away(world, field_n):
    """The measured field turned by 40 deg about an axis across it, from a sample to the end."""
    body = Turn.from_quat(np.array(world.q_nb[1:]), scalar_first=True).inv().apply(field_n)
    across = np.cross(body, [1.0, 0.0, 0.0])
    across *= 40 * DEG / np.linalg.norm(across, axis=1, keepdims=True)
    z = np.array(world.readings[FIELD])
    z[AT:] = Turn.from_rotvec(across[AT:]).apply(z[AT:])
    return z


def direction_of(vector_n):
    """Elevation and azimuth in degrees."""
    north, east, down = vector_n / np.linalg.norm(vector_n)
    return np.degrees(np.arcsin(-down)), np.degrees(np.arctan2(east, north))


IMPOSSIBLE = ("nan", "one axis", "inf", "-inf", "zero", "denormal", "weak", "strong", "huge")


@pytest.fixture(scope="module", name="flight")
def of_the_field():
    problem = FIELD_VECTOR.problem(parsed(FieldVector, "b4"), ("gate", "discriminator"), 0)
    world = first_run(first_worlds(problem, 1))
    good = np.array(world.readings[FIELD])
    field_n = np.array(problem.context["field_n"])
    unit = good[AT] * np.linalg.norm(field_n[AT]) / np.linalg.norm(good[AT])
    one_axis, stopped = good[AT].copy(), good[AT].copy()
    one_axis[1] = np.nan
    stopped[np.argmin(np.abs(stopped))] = 100e-6  # the end of the range of many magnetometers
    rows = (np.nan, one_axis, np.inf, -np.inf, 0.0, 5e-324, 0.29 * unit, 3.01 * unit, 1e300)
    cases = {"clean": good}
    for case, row in zip((*IMPOSSIBLE, "saturated"), (*rows, stopped), strict=True):
        cases[case] = good.copy()
        cases[case][AT] = row
    cases["turned"] = turned_away(world, field_n)
    worlds = [world._replace(readings={FIELD: jnp.asarray(z)}) for z in cases.values()]
    worlds.append(world._replace(theta_b=world.theta_b.at[AT : AT + 10].set(jnp.nan)))
    up, way = direction_of(field_n[0])
    along = (f'body.elevation="{up} deg"', f'body.azimuth="{way} deg"', 'body.cone="0 deg"')
    spinning = FIELD_VECTOR.problem(parsed(FieldVector, "b4", *along), (), 0)
    worlds.append(first_run(first_worlds(spinning, 1)))
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *worlds)
    gated = found(problem.contenders["gate"], stacked)
    return Flight(problem, world, cases, gated, spinning, worlds[-1])


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_what_no_magnetometer_reads_is_as_if_it_had_not_been_read(flight, case):
    steps = flight.of(case)
    code, _ = steps.info[FIELD]
    assert code[AT] == Code.MISSING
    posterior, predicted = (jax.tree.map(lambda x: x[AT], b) for b in steps[:2])
    assert same(posterior, predicted)
    assert same(steps, flight.of("nan"))
    assert np.all(np.isfinite(steps.posterior.factor))
    # and only that sample: before it nothing differs, after it little does
    clean = flight.of("clean").posterior
    before = jax.tree.map(lambda x: x[:AT], (steps.posterior, clean))
    assert same(*before)
    assert not same(posterior.factor, clean.factor[AT])
    factor = steps.posterior.factor
    np.testing.assert_allclose(factor[-1], clean.factor[-1], rtol=0.0, atol=1e-4)


def test_one_saturated_sample_is_refused_for_its_size(flight):
    size = np.linalg.norm(flight.cases["clean"], axis=1)
    assert np.all(size < 60e-6)  # so 100 uT on one axis has twice the size, which is plausible
    steps = flight.of("saturated")
    code, notes = steps.info[FIELD]
    assert code[AT] == Code.REFUSED
    assert np.array_equal(notes["gate.refused"][AT : AT + 2], [1, 0])
    assert np.array_equal(steps.posterior.factor[AT], steps.predicted.factor[AT])
    q, clean = (x.posterior.mean.q_nb.wxyz for x in (steps, flight.of("clean")))
    apart = Rotation(jnp.asarray(q)).inverse() @ Rotation(jnp.asarray(clean))
    assert np.max(np.abs(apart.as_rotvec())) < 0.1 * DEG


def test_a_gate_tells_of_a_field_that_stays_wrong(flight):
    code, notes = flight.of("turned").info[FIELD]
    assert np.all(code[AT : AT + PATIENCE] == Code.REFUSED)
    recovered = notes["gate.recovered"]
    assert not np.any(recovered[: AT + PATIENCE])
    assert recovered[AT + PATIENCE]
    _, notes = flight.of("clean").info[FIELD]
    assert not np.any(notes["gate.recovered"])


class Replay:
    """The discriminator, sample by sample, up to the bad one; `again` goes back to there."""

    def __init__(self, flight):
        contender = flight.problem.contenders["discriminator"]
        self.case = contender.case(flight.world)
        self.online = OnlineFilter(contender.filter, contender.model, self.case.start)
        self.states = [int(self.take(k)[1]["discriminator.state"]) for k in range(AT)]
        self._start = self.online.state, self.online.counts.copy()

    def again(self):
        self.online.state, counts = self._start
        self.online.counts = counts.copy()
        return self

    def take(self, k, field_b=None):
        """Belief before the sample, and what the filter notes of it."""
        expected = self.case.aux[FIELD][k]
        z = self.case.y[FIELD][k] if field_b is None else jnp.asarray(field_b)
        turn = jax.tree.map(lambda x: x[k], self.case.u)
        predicted = self.online.predict(turn).belief
        info = self.online.update(plausible(z[None], expected[None])[0], aux=expected)
        return predicted, info.notes


@pytest.fixture(scope="module", name="replay")
def of_the_discriminator(flight):
    return Replay(flight)


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_memory_is_left_alone_and_outcomes_are_counted(flight, replay, case):
    online = replay.again().online
    before = online.state.memory
    predicted, notes = replay.take(AT, flight.cases[case][AT])
    assert same(online.belief, predicted)
    assert same(online.state.memory, before)
    assert notes["discriminator.weight"] == 1.0
    assert online.counts == {"DONE": AT, "MISSING": 1}


def test_a_saturated_sample_is_an_outlier(flight, replay):
    online = replay.again().online
    (before,) = online.state.memory
    _, notes = replay.take(AT, flight.cases["saturated"][AT])
    assert notes["discriminator.state"] == DiscriminatorVerdict.OUTLIER
    assert notes["discriminator.weight"] < 0.01
    (after,) = online.state.memory
    assert same(after.power, before.power)  # what tells of a wrong model has not learnt of it
    _, notes = replay.take(AT + 1)
    assert notes["discriminator.state"] == DiscriminatorVerdict.CLEAN


def test_a_discriminator_tells_of_a_field_that_stays_wrong(flight, replay):
    assert DiscriminatorVerdict.MODEL not in replay.states
    wrong = flight.cases["turned"]
    replay.again()
    state = [
        int(replay.take(k, wrong[k])[1]["discriminator.state"]) for k in range(AT, AT + PATIENCE)
    ]
    assert state == [DiscriminatorVerdict.OUTLIER] * (PATIENCE - 1) + [DiscriminatorVerdict.MODEL]


def test_a_gyro_sample_that_is_none_is_not_taken_and_counted(replay):
    online = replay.again().online
    held = online.belief
    for bad in (jnp.nan, jnp.inf):
        turn = Turned(jnp.array([0.0, bad, 0.0]), jnp.zeros(()))
        assert int(online.predict(turn).code) == Code.NOT_FINITE
        assert same(online.belief, held)
    assert online.counts["NOT_FINITE"] == 2


def test_a_gyro_lost_for_a_second_is_bridged(flight):
    """The turn of a spinning body is held; what that leaves is doubted, and known again soon."""
    both = jax.tree.map(lambda x: x[[0, -2]], flight.gated.posterior)
    sigma = np.sqrt(np.sum(both.factor**2, axis=-1))
    assert np.all(np.isfinite(both.mean.q_nb.wxyz))
    assert np.all(sigma[1, AT + 9, :3] > sigma[0, AT + 9, :3])
    q = [Rotation(jnp.asarray(both.mean.q_nb.wxyz[i, -1])) for i in range(2)]
    apart = np.abs(np.asarray((q[0].inverse() @ q[1]).as_rotvec()))
    assert np.linalg.norm(apart) < 3.0 * np.linalg.norm(sigma[1, -1, :3])


@pytest.mark.parametrize(
    ("times", "fits"), [(0.0, False), (0.299, False), (0.301, True), (2.99, True), (3.01, False)]
)
def test_how_large_a_field_may_be(times, fits):
    field_n = jnp.array([[23e-6, 1e-6, 40e-6]])
    turn = Turn.random(rng=np.random.default_rng(1)).as_matrix()
    field_b = jnp.asarray(times * np.asarray(field_n) @ turn)
    got = plausible(field_b, field_n)
    np.testing.assert_array_equal(got, field_b if fits else np.full((1, 3), np.nan))


@pytest.mark.parametrize(("row", "column", "value"), [(0, 0, -1.0), (0, 3, 5.0), (2, 2, np.nan)])
def test_a_covariance_that_is_none_cannot_be_believed(row, column, value):
    P = np.eye(6)
    P[row, column] = P[column, row] = value
    with pytest.raises(ValueError, match="initial covariance"):
        Belief.of(FieldState(Rotation.identity(), jnp.zeros(3)), P)
    with pytest.raises(ValueError, match=r"\(6, 6\)"):
        Belief.of(FieldState(Rotation.identity(), jnp.zeros(3)), np.eye(5))


LOST = {"gyro": (True, False), "magnetometer": (False, True), "both": (True, True)}
TAKEN = slice(80, 150)


@pytest.fixture(scope="module", name="dropped")
def of_lost_sensors():
    """The two filters that are one, with each sensor lost for 7 s, and with both."""
    names = ("ukf", "federated-root")
    problem = MAGNETIC_ATTITUDE.problem(parsed(MagneticAttitude, "a8"), names, 0)
    world = first_run(first_worlds(problem, 1))

    def without(*lost):
        read = dict(world.readings)
        for name, no in zip((GYRO, MAGNETIC), lost, strict=True):
            if no:
                read[name] = jax.tree.map(lambda x: x.at[TAKEN].set(jnp.nan), read[name])
        return world._replace(readings=read)

    worlds = jax.tree.map(lambda *x: jnp.stack(x), *(without(*one) for one in LOST.values()))
    return {name: found(problem.contenders[name], worlds) for name in names}


@pytest.mark.parametrize("case", LOST)
def test_a_lost_sensor_leaves_its_local_filter_in_the_fusion(dropped, case):
    k = list(LOST).index(case)
    central, federated = (dropped[name].posterior for name in ("ukf", "federated-root"))
    pairs = zip(jax.tree.leaves(central.mean), jax.tree.leaves(federated.mean), strict=True)
    for of_one, of_other in pairs:
        apart = np.mod(of_one[k] - of_other[k] + np.pi, 2.0 * np.pi) - np.pi
        assert np.max(np.abs(apart)) < 1e-11
    P, Q = (b.factor[k] @ np.swapaxes(b.factor[k], 1, 2) for b in (central, federated))
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    assert np.max(np.abs(P - Q) / (sigma[:, :, None] * sigma[:, None, :])) < 1e-10
    code, notes = dropped["federated-root"].info[GYRO if LOST[case][0] else MAGNETIC]
    assert np.all(code[k, TAKEN] == Code.MISSING)
    np.testing.assert_array_equal(notes["federated.silent"][k, TAKEN], np.arange(1, 71))
    assert notes["federated.silent"][k, TAKEN.stop] == 0


@pytest.mark.parametrize("name", ["ukf", "federated-root"])
def test_without_either_what_is_known_fades_and_comes_back(dropped, name):
    k = list(LOST).index("both")
    sigma = np.sqrt(np.sum(dropped[name].posterior.factor[k] ** 2, axis=2))
    attitude = np.linalg.norm(sigma[:, :3], axis=1)
    assert np.all(np.diff(attitude[TAKEN]) > 0.0)
    assert attitude[TAKEN.stop - 1] > 3.0 * attitude[TAKEN.start - 1]
    assert attitude[TAKEN.stop + 60] < 1.1 * attitude[TAKEN.start - 1]
    steps = dropped[name]
    assert np.array_equal(steps.posterior.factor[k, TAKEN], steps.predicted.factor[k, TAKEN])
    assert np.all(np.isfinite(sigma))


def test_a_spin_about_the_field_is_said_to_be_unobserved(flight):
    field_n = np.array(flight.along.context["field_n"])
    q = Turn.from_quat(np.array(flight.along_world.q_nb[1:]), scalar_first=True)
    nose = q.apply([1.0, 0.0, 0.0])
    cosine = np.sum(nose * field_n, axis=1) / np.linalg.norm(field_n, axis=1)
    assert np.all(cosine > np.cos(1.5 * DEG))
    up, way = direction_of(np.mean(field_n, axis=0))
    (told,) = flight.along.notes
    assert f"azimuth {way % 360.0:.0f} deg, elevation {up:.0f} deg" in told
    # and so it is: of the start two components become known, and the roll does not
    factor = flight.gated.posterior.factor[-1, :, :3]
    P = factor @ np.swapaxes(factor, 1, 2)
    roll = np.sqrt(np.einsum("ki,kij,kj->k", nose, P, nose))
    rest = np.sqrt(np.trace(P, axis1=1, axis2=2) - roll**2)
    assert np.min(roll) > 0.95 * 2 * DEG  # what it begins with
    assert rest[-1] < 0.15 * 2 * DEG


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (("launch.year=2029.99999",), "20(29|30)"),
        (('launch.speed="4500 m/s"',), "850"),
        (('duration="620 s"',), "back at the radius of its launch"),
    ],
    ids=["date", "height", "ground"],
)
def test_a_flight_out_of_the_magnetic_model_is_refused(settings, words):
    given = parsed(FieldVector, "b4", 'duration="600 s"', *settings)
    with pytest.raises(ValueError, match=words):
        FIELD_VECTOR.problem(given, ("usque",), 0)


@pytest.mark.parametrize(
    ("kind", "name", "setting", "words"),
    [
        (FieldVector, "b4", "launch.year=2031.0", "year"),
        (FieldVector, "b4", "launch.year=2019.5", "year"),
        (FieldVector, "b4", 'launch.height="120 km"', "height"),
        (FieldVector, "b4", 'step="0 s"', "step"),
        (FieldVector, "b4", 'step="-0.1 s"', "step"),
        (FieldVector, "b4", 'step="20 s"', "two steps"),
        (FieldVector, "b4", 'magnetometer.lost=[{begin="9 s", end="9 s"}]', "must come after"),
        (FieldVector, "b1", 'magnetometer.disturbance.length="0.01 s"', "shorter than a step"),
        (FieldVector, "b1", 'magnetometer.disturbance.length="30 s"', "never right"),
        (MagneticAttitude, "a8", 'start.attitude="0 deg"', "attitude"),
        (MagneticAttitude, "a8", "body.e1=1.0", "e1"),
        (MagneticAttitude, "a8", 'gyro.white="-0.5 deg/s"', "white"),
        (MagneticAttitude, "a8", "gyro.white=nan", "white"),
    ],
)
def test_a_scenario_that_cannot_be_is_refused_by_name(kind, name, setting, words):
    with pytest.raises(ScenarioError, match=words):
        parsed(kind, name, setting)
