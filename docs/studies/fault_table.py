"""Faults by families of filters: which are borne, which are reported, which stay silent.

python docs/studies/fault_table.py [--development] > docs/faults.md

A seeded simulation of a position with its rate, measured by two sensors; each filter runs over all
faults as one compiled batch. `--development` takes the seeds on which the limits of `doubts`, the
tests it makes and the set-up of families here were chosen, which are others than those of the page.
"""

import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from robins.filters import (
    Belief,
    Model,
    Motion,
    Sensor,
    adaptive,
    channel,
    cubature,
    delayed,
    distributed,
    doubts,
    federated,
    guarded,
    imm,
    intersecting,
    iterated,
    kalman,
    particle,
    run,
    unscented,
)
from robins.filters import rules as r

TESTS = Path(__file__).parents[2] / "tests"
STEPS, DT_S, SEEDS, SOUND = 400, 0.1, 3, 40
HALF = STEPS // 2
F = np.array([[1.0, DT_S], [0.0, 1.0]])
Q = 0.2 * np.array([[DT_S**3 / 3, DT_S**2 / 2], [DT_S**2 / 2, DT_S]])
L = np.linalg.cholesky(Q)
P0 = np.eye(2)
H = {"a": np.array([[1.0, 0.0]]), "b": np.array([[1.0, 0.0]])}
# families whose innovations follow each other by design, and the sensors
LASTING = {"consider": ("a", "b"), "constant_gain": ("a", "b")}
FAR = 5.0  # sigmas of an error that ends a run badly


def model(q=1.0, sigma=1.0) -> Model:
    """The process noise and the sensors' noise as a filter believes them, as multiples of both."""

    noise, step = jnp.ones(1) * sigma, Partial(_move, jnp.asarray(F))
    sensors = tuple(Sensor(Partial(_look, jnp.asarray(h)), noise, 1, k) for k, h in H.items())
    return Model(Motion(step, jnp.asarray(L) * q), sensors)


def _move(F, x, u):
    return F @ x


def _look(H, x, aux):
    return H @ x


def steady() -> dict[str, np.ndarray]:
    """Gains of both sensors after a long time."""
    P, gains = P0, {}
    for _ in range(5000):
        P = F @ P @ F.T + Q
        for name, h in H.items():
            gains[name] = P @ h.T / (h @ P @ h.T + 1.0)
            P = P - gains[name] @ h @ P
    return gains


def families() -> dict:
    """Filters by name; True: it states bounds, not standard deviations."""
    eye, both = jnp.eye(2), [channel("a"), channel("b")]
    stay = [[0.98, 0.02], [0.02, 0.98]]
    strong = {
        "strong_tracking " + form: r.strong_tracking(form=form)
        for form in ("outside", "lumped", "multiple", "projected")
    }
    rules = {
        "gate": r.gate(),
        "huber": r.huber(),
        "igg3": r.igg3(),
        "student_t": r.student_t(),
        "correntropy": r.correntropy(),
        "sage_husa": r.sage_husa(),
        "variational_bayes": r.variational_bayes(),
        "innovation_fading": r.innovation_fading(),
        "fading_memory": r.fading_memory(1.02),
        **strong,
        "discriminator": r.discriminator(),
        "equality": r.equality(jnp.array([[0.0, 1.0]]), jnp.zeros(1), noise=[50.0]),
        "inequality": r.inequality(jnp.array([[0.0, 1.0]]), [-50.0], [50.0]),
        "projection": r.projection("a"),
    }
    # whose gain is not that of least variance
    others = {
        "h_infinity": r.h_infinity(30.0, eye),
        "adaptive_h_infinity": r.adaptive_h_infinity(eye),
        "consider": r.consider([1]),
        "constant_gain": r.constant_gain({k: jnp.asarray(v) for k, v in steady().items()}),
        "channel_inflation": r.channel_inflation(0.05, jnp.asarray(H["a"].T)),
    }
    plain = {
        "kalman": kalman(),
        "joseph": kalman(form="joseph"),
        "unscented": kalman(unscented()),
        "cubature": kalman(cubature()),
        "iterated": kalman(iterated()),
    }
    composite = {
        "imm": imm([kalman(), kalman(rules=[r.fading_memory(1.2)])], stay),
        "adaptive": adaptive(),
        "federated": federated(both),
        "distributed": distributed(both),
        "intersecting": intersecting(both),
        "delayed": delayed(kalman(), model(), 2),
        "guarded": guarded(kalman(), kalman(), assumption="b", judges="a"),
        "particle": particle(300, 0),
    }
    plain |= {k: kalman(rules=[v]) for k, v in rules.items()}
    held = {k: (kalman(rules=[v]), k.endswith("h_infinity")) for k, v in others.items()}
    return held | {k: (v, False) for k, v in (plain | composite).items()}


def world(seed: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Truth (T, 2) and what both sensors give of it, each (T, 1)."""
    rng = np.random.default_rng(seed)
    x, truth = np.linalg.cholesky(P0) @ rng.standard_normal(2), []
    for _ in range(STEPS):
        x = F @ x + L @ rng.standard_normal(2)
        truth.append(x)
    X = np.array(truth)
    return X, {k: X @ h.T + rng.standard_normal((STEPS, 1)) for k, h in H.items()}


def faults() -> dict:
    """Changes of (truth, readings, start), and of the beliefs, by row of the table."""
    span, t = slice(HALF, HALF + 40), np.arange(STEPS)[:, None]

    def of(sensor, change, **believed):
        def changed(X, y, m0, rng):
            return X, y | {sensor: change(y[sensor].copy(), X, rng)}, m0

        return changed, believed

    def put(where, value):
        return lambda y, X, rng: np.where((t >= where.start) & (t < where.stop), value, y)

    def outliers(share, size):
        def change(y, X, rng):
            return y + size * np.sign(rng.standard_normal(y.shape)) * (rng.random(y.shape) < share)

        return change

    def begun(m, **believed):
        return (lambda X, y, m0, rng: (X, y, np.asarray(m))), believed

    def same(X, y, m0, rng):
        return X, y, m0

    def jumped(X, y, m0, rng):
        step = np.where(t >= HALF, 100.0, 0.0) * np.array([[1.0, 0.0]])
        return X + step, {k: y[k] + step[:, :1] for k in y}, m0

    def both(share):
        return lambda X, y, m0, rng: (X, {k: np.where(share(rng), np.nan, y[k]) for k in y}, m0)

    late = slice(HALF, STEPS)
    return {
        "F01 NaN of one sensor, 40 steps": of("b", put(span, np.nan)),
        "F02 infinite, 40 steps": of("b", put(span, np.inf)),
        "F02 1e308 once": of("b", put(slice(HALF, HALF + 1), 1e308)),
        "F05 1e9 once": of("b", put(slice(HALF, HALF + 1), 1e9)),
        "F05 5 % at 10 sigma": of("b", outliers(0.05, 10.0)),
        "F05 30 % at 5 sigma": of("b", outliers(0.3, 5.0)),
        "F10 both absent for 100 steps": both_absent(t),
        "F12 readings of 7 steps ago": of("b", lambda y, X, rng: np.roll(y, 7, axis=0)),
        "F13 feet for metres": of("b", lambda y, X, rng: y / 0.3048),
        "F14 sign turned": of("b", lambda y, X, rng: -y),
        "F20 start 20 sigma away": begun([20.0, 0.0]),
        "F20 start 1e4 away": begun([1e4, 0.0]),
        "F21 noise believed 1e-3": (same, {"sigma": 1e-3}),
        "F21 process noise believed 0": (same, {"q": 0.0}),
        "F22 stuck from the middle on": of("b", lambda y, X, rng: np.where(t < HALF, y, y[HALF])),
        "F22 stuck for 40 steps": of(
            "b", lambda y, X, rng: np.where((t < HALF) | (t >= HALF + 40), y, y[HALF])
        ),
        "F22 quantised to 5 sigma": of("b", lambda y, X, rng: 5.0 * np.round(y / 5.0)),
        "F22 saturated at 3": of("b", lambda y, X, rng: np.clip(y, -3.0, 3.0)),
        "F22 scale 0": of("b", lambda y, X, rng: 0.0 * y),
        "F24 bias step of 20 sigma": of("b", lambda y, X, rng: y + 20.0 * (t >= HALF)),
        "F24 ramp of 1 sigma/s": of("b", lambda y, X, rng: y + DT_S * np.maximum(t - HALF, 0)),
        "F24 true jump of 100": (jumped, {}),
        "F25 a lost for ever": of("a", put(late, np.nan)),
        "F44 process noise 10 times too small": (same, {"q": 0.1}),
        "F44 process noise 4 times too large": (same, {"q": 4.0}),
        "F44 noise 4 times too small": (same, {"sigma": 0.25}),
        "F44 noise 4 times too large": (same, {"sigma": 4.0}),
        "F44 noise of the sensor doubled late": of(
            "b", lambda y, X, rng: y + np.where(t < HALF, 0.0, 4.0) * rng.standard_normal(y.shape)
        ),
    }


def both_absent(t):
    """Neither sensor speaks for a while."""
    gone = (t >= HALF) & (t < HALF + 100)
    return (lambda X, y, m0, rng: (X, {k: np.where(gone, np.nan, v) for k, v in y.items()}, m0)), {}


def batch(seed: int) -> tuple[list[str], dict]:
    """Names of all runs and their arrays, stacked: sound ones first, then each fault's."""
    table, names, rows = faults(), [], []
    cases = [("", k, None) for k in range(SOUND)]
    cases += [(name, k, change) for name, change in table.items() for k in range(SEEDS)]
    for i, (name, _, change) in enumerate(cases):
        X, y = world(seed + i)
        m0, believed = np.zeros(2), {}
        if change is not None:
            X, y, m0 = change[0](X, y, m0, np.random.default_rng(seed + 10_000 + i))
            believed = change[1]
        names.append(name)
        rows.append(
            {
                "X": X,
                "y": y,
                "m0": m0,
                "q": believed.get("q", 1.0),
                "sigma": believed.get("sigma", 1.0),
            }
        )
    return names, jax.tree_util.tree_map(lambda *x: np.stack(x), *rows)


def answers(
    filter_, bounds: bool, assumed: tuple, rows: dict
) -> tuple[np.ndarray, list[list[str]]]:
    """Largest error over sigma at the end of each run, and the sentences on it."""

    def one(row):
        start = Belief(row["m0"], jnp.asarray(np.linalg.cholesky(P0)))
        found = run(filter_, model(row["q"], row["sigma"]), start, row["y"])
        return found.mean, found.sigma, found.tally, found.steps.info

    mean, sigma, tally, info = jax.device_get(jax.jit(jax.vmap(one))(rows))
    with np.errstate(all="ignore"):
        far = np.abs(mean - rows["X"]) / sigma
    far = np.max(np.median(far[:, -STEPS // 10 :], axis=1), axis=-1)
    looks = tally.with_innovations(info, rows["y"])
    each = [jax.tree_util.tree_map(lambda x, i=i: x[i], looks) for i in range(len(far))]
    return np.nan_to_num(far, nan=np.inf), [doubts(t, bounds, assumed) for t in each]


# Rows of the fault table that are not about a filter alone, and the test that holds each.
ELSEWHERE = {
    "F03, F06, F07, F10 of logs": "logs/test_clean.py::test_many_bad_samples_of_every_kind_at_once",
    "F04": "logs/test_clean.py::test_other_arrays_of_numbers_give_the_same",
    "F08": "filters/test_delayed.py::test_belief_and_memories_end_as_in_order",
    "F09": "systems/test_live_ins_gnss.py::test_a_fix_of_the_future_waits",
    "F11": "logs/test_clean.py::test_a_clock_that_steps_costs_the_shorter_part",
    "F12 of logs": "logs/test_doctor_motion.py::test_a_delay_is_measured_by_the_gyros",
    "F15": "test_rotation.py::pitch_deg",
    "F16": "filters/test_gate.py::test_a_jump_across_the_seam_is_followed_where_samples_agree",
    "F17": "ins/test_mechanise.py::test_poles_are_refused_with_the_reason",
    "F18": "report/test_report_maps.py::test_crossing_180_degrees_draws_no_line_across_the_map",
    "F19": "earth/test_wgs84.py::test_gravity_near_the_ground_is_the_series_in_height",
    "F21 in full": "filters/test_robustness.py::test_extreme_variances_give_the_closed_form",
    "F23": "systems/test_marg_replay.py::free fall",
    "F25 of an INS": "ins/test_mechanise.py::test_schuler_oscillation_after_an_hour_without_aids",
    "F26": "ins/test_increments.py::test_coning_drift_stays_at_its_bound",
    "F27": "logs/test_timebase.py::test_seconds_are_exact_to_the_nanosecond",
    "F28": "filters/test_h_infinity.py::test_what_is_not_feasible_is_refused_by_name",
    "F29": "logs/test_text_columns.py::ends early",
    "F30": "test_scenario.py::F30",
    "F31": "bench/test_corruption.py::Damaged frames of each kind",
    "F32": "bench/test_cable.py::test_ends_are_gone_with_the_cable",
    "F33": "bench/test_clocks.py::test_a_long_step_is_caught_up_with_or_skipped",
    "F34": "bench/test_live_history.py::test_a_day_is_flat_in_memory",
    "F35": "campaign/test_campaign_folder.py::test_killed_at_any_moment_it_goes_on",
    "F36": "logs/test_log_writing.py::test_a_full_disk_is_told_and_a_device_is_never_replaced",
    "F37": "campaign/test_store.py::test_shards_of_others_with_a_checksum_that_fits",
    "F38": "campaign/test_campaign_folder.py::test_a_run_shown_alone_is_that_of_the_campaign",
    "F39": "campaign/test_campaign_folder.py::test_a_run_in_lanes_is_that_of_the_campaign",
    "F40 in part": "campaign/test_campaign_folder.py::test_what_was_claimed_by_the_dead",
    "F41": "campaign/test_campaign_folder.py::test_runs_that_diverge_are_named",
    "F42 in part": "campaign/test_campaign_folder.py::test_ctrl_c_ends_all_at_once_and_it_goes_on",
    "F44 by NEES": "filters/test_consistency.py::test_a_filter_wrong_by_four_is_found_out",
}
UNSEEN = (
    "the rule widens what is measured, so the innovations of the position are as large as they "
    "should be; the rate, which is not measured, is off by more than its standard deviation"
)
# Why a cell stays silent: of a fault and families.
EXPLAINED = {
    ("F21 process noise believed 0", "projection"): UNSEEN,
    ("F21 process noise believed 0", "strong_tracking projected"): UNSEEN,
    ("F21 process noise believed 0", "adaptive_h_infinity"): UNSEEN,
    ("F21 process noise believed 0", "channel_inflation"): UNSEEN,
    ("F44 process noise 10 times too small", "projection"): UNSEEN,
    ("F44 process noise 10 times too small", "strong_tracking projected"): UNSEEN,
    ("F44 process noise 10 times too small", "consider"): (
        "the rate is not estimated, so innovations last in a right filter too, and only their size "
        "is judged"
    ),
}


def page(cells: dict, alarms: list, errors: dict, sound: int) -> str:
    """The page of the documents."""
    names = list(dict.fromkeys(fault for fault, _ in cells))
    everyone = list(dict.fromkeys(family for _, family in cells))
    lines = [
        "# Filters under faults: which family notices",
        "",
        "Faults of the test bench are on [its page](bench.md#faults).",
        "",
        "Made by `python docs/studies/fault_table.py`. What `doubts` tests, its limits and the "
        "set-up of the families were chosen on other seeds (`--development`). A position with",
        f"its rate is measured by two sensors over {STEPS} steps, {SEEDS} runs a cell. "
        "`.`: in every run the error ends within",
        "5 sigma. `+`: likewise, and `doubts` names a reason in some run. `T`: some run ends "
        "beyond 5 sigma, and `doubts` names",
        "a reason in each of these. `S`: one of these is silent.",
        "",
        f"Of {len(cells)} cells {list(cells.values()).count('S')} are silent. "
        f"`doubts` names a reason in {len(alarms)} of {sound} sound runs over "
        f"{len(everyone)} families.",
        "",
        "The gains of " + " and ".join(f"`{k}`" for k in LASTING) + " leave innovations that "
        "follow each other, by design: there only their size",
        "and repeated readings count. A sensor that gives one number throughout is a "
        "pseudo-measurement, and one whose",
        "resolution is above a tenth of the innovation's sigma may repeat itself: neither counts "
        "as stuck.",
        "",
        "| | fault |",
        "|---|---|",
        *(f"| {i} | {name} |" for i, name in enumerate(names, 1)),
        "",
        "| family | " + " | ".join(str(i) for i in range(1, len(names) + 1)) + " |",
        "|---|" + "---|" * len(names),
        *(
            f"| `{family}` | " + " | ".join(cells[name, family] for name in names) + " |"
            for family in everyone
        ),
        "",
        "## Silent cells",
        "",
        "| fault | family | error over sigma at the end | why |",
        "|---|---|---|---|",
        *(
            f"| {name} | `{family}` | {', '.join(errors[name, family])} | "
            f"{EXPLAINED.get((name, family), 'not known')} |"
            for (name, family), cell in cells.items()
            if cell == "S"
        ),
        "",
        "## Doubted sound runs",
        "",
        *([f"- `{family}`: {'; '.join(said)}." for family, said in alarms] or ["None."]),
        "",
        "## Rows held by tests",
        "",
        "| rows | tests |",
        "|---|---|",
        *(f"| {rows} | `tests/{e.replace('::', '`: ')} |" for rows, e in ELSEWHERE.items()),
        "",
        "No test holds F43 for whole logs, F42 for locale and hash seed, and F40 for a worker that "
        "never returns.",
        "",
    ]
    return "\n".join(lines)


def main(development: bool) -> None:
    """Print the page."""
    for entry in ELSEWHERE.values():
        file, _, words = entry.partition("::")
        if words not in (TESTS / file).read_text("utf-8"):
            raise SystemExit(f"no such test: {entry}")
    names, rows = batch(100_000 if development else 500_000)
    cells, alarms, errors, sound = {}, [], {}, 0
    for family, (filter_, bounds) in families().items():
        far, said = answers(filter_, bounds, LASTING.get(family, ()), rows)
        sound += names.count("")
        alarms += [(family, one) for name, one in zip(names, said, strict=True) if not name and one]
        for name in dict.fromkeys(n for n in names if n):
            at = [i for i, n in enumerate(names) if n == name]
            bad = [i for i in at if far[i] > FAR]
            silent = [i for i in bad if not said[i]]
            some = any(said[i] for i in at)
            cells[name, family] = "S" if silent else "T" if bad else "+" if some else "."
            errors[name, family] = [f"{far[i]:.3g}" for i in silent]
        print(family, [n for n, f in cells if f == family and cells[n, f] == "S"], file=sys.stderr)
    print(page(cells, alarms, errors, sound))


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main("--development" in sys.argv)
