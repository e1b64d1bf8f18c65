"""The config of a flight of the airship, its parts, and its evaluation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins import manifold
from robins.bench.evaluation import MessageSeries, RunFigures, RunResult, figures_of, rms
from robins.bench.parts.station import Inputs, Part
from robins.bench.rig import LoadedRun, Timing
from robins.bench.run.setup import Setup, counted_from
from robins.bench.wire.fields import Values
from robins.earth import Geodetic
from robins.filters import Belief, Model, OnlineFilter, run
from robins.filters.kalman import FilterState
from robins.filters.machine import usual
from robins.filters.run import Step
from robins.ins.increments import Increments
from robins.ins.mechanise import Nav
from robins.manifold import Angle
from robins.rotation import Rotation
from robins.systems.airship import SYSTEM
from robins.systems.airship import instruments as fitted
from robins.systems.airship.instruments import SAR, STAR, WIND
from robins.systems.airship.model import ENU_OF_NED, NINE
from robins.systems.airship.model import navigation as nav_of
from robins.systems.airship.parameters import Airship
from robins.systems.airship.study import BLOCKS, CANDIDATES
from robins.systems.tables import block_array

_TAKEN = (fitted.RADAR, fitted.STARS, fitted.SOFT)
_ARCSEC = math.pi / 648000.0


class AirshipConfig(NamedTuple):
    """Complete input of a flight; E epochs."""

    step_ns: int
    filter: str
    model: Model
    start: Belief
    u: Increments  # (E, ...)
    y: Mapping[str, Any]  # by sensor, leading axis E
    aux: Mapping[str, Any]
    truth: Nav  # leading axis E
    frames: tuple[int, ...] = (0,)  # all steps are computed alike


def filters() -> Sequence[str]:
    """Names of the filters that need only what the wire carries."""
    of = {name: c for name, c in CANDIDATES.items() if c.states is NINE}
    fit = [name for name, c in of.items() if all(i in _TAKEN for i in c.instruments)]
    return ["ukf", *(name for name in fit if name != "ukf")]


def timing(given: Airship) -> Timing:
    """Steps of a flight, one per epoch; figures count from the first epoch in ``counted``."""
    first = max(math.ceil(given.counted.begin / given.epoch - 1e-9) - 1, 0)
    return Timing(given.epoch, round(given.duration / given.epoch), first)


def prepare(setup: Setup, given: Airship) -> AirshipConfig:
    """Config of run 0 of a campaign of this seed."""
    (study,) = SYSTEM.studies.values()
    problem = study.problem(given, (setup.filter,), setup.seed)
    of = problem.contenders[setup.filter]
    case = of.case(jax.jit(problem.simulate)(jnp.asarray(0)))
    u, y, aux, truth = jax.tree_util.tree_map(
        np.asarray, (case.u, dict(case.y), dict(case.aux), nav_of(case.truth))
    )
    return AirshipConfig(
        round(1e9 * given.epoch), setup.filter, of.model, case.start, u, y, aux, truth
    )


def _rows(part: str, message: str, rows: Mapping[str, np.ndarray]) -> Part:
    """Part that sends one row per step."""

    def act(state: None, k: int, inputs: Inputs):
        said = {name: x[k] for name, x in rows.items() if k < len(x)}
        return None, [(message, said)] if said else []

    return Part(part, {}, lambda: None, act)


def sins(config: AirshipConfig) -> Part:
    """The inertial unit: the increments of each epoch."""
    u = config.u
    rows = {"dt": u.dt, "theta_b": u.theta, "dv_b": u.dv, "dr_b": u.dr}
    return _rows("sins", "increment", {name: np.asarray(x) for name, x in rows.items()})


def radar(config: AirshipConfig) -> Part:
    """Radar and barometer."""
    place, heading, alt = config.y[SAR]
    return _rows("radar", "fix", {"place": place, "heading": heading.rad, "alt": alt[:, 0]})


def star(config: AirshipConfig) -> Part:
    """The star sensor."""
    return _rows("star", "attitude", {"euler": np.stack([a.rad for a in config.y[STAR]], axis=1)})


def air(config: AirshipConfig) -> Part:
    """Forecast and air data; silent where the filter takes none."""
    rows = {"wind_n": config.y[WIND], "through_b": config.aux[WIND]} if WIND in config.y else {}
    return _rows("air", "wind", rows)


def navigation(config: AirshipConfig) -> Part:
    """The navigation computer with any filter; a measurement that does not come is missing.

    Its state is the state of the filter and the last increment.
    """
    windy = WIND in config.y
    begin = Increments(*(np.asarray(x)[0] for x in config.u))

    @cache
    def made() -> tuple[OnlineFilter, FilterState]:  # not needed to query the inputs
        filter_ = CANDIDATES[config.filter].make()
        online = OnlineFilter(filter_, config.model, config.start, usual())
        return online, online.state

    def first() -> tuple[FilterState, Increments]:
        return made()[1], begin

    def act(state: tuple[FilterState, Increments], k: int, inputs: Inputs):
        u, fix, seen, wind = (inputs[of] for of in ("increment", "fix", "attitude", "wind"))
        held, (online, _) = u is None, made()
        online.state, increment = state
        if u is not None:
            increment = Increments(np.float64(u["dt"]), u["theta_b"], u["dv_b"], u["dr_b"])
        nothing = np.full(3, np.nan)
        fix = fix or {"place": nothing[:2], "heading": math.nan, "alt": math.nan}
        angles = nothing if seen is None else seen["euler"]
        y: dict[str, Any] = {
            SAR: (fix["place"], Angle(np.float64(fix["heading"])), np.array([fix["alt"]])),
            STAR: tuple(Angle(np.float64(a)) for a in angles),
        }
        if windy:
            y[WIND] = nothing[:2] if wind is None else wind["wind_n"]
        aux = {WIND: np.zeros(3) if wind is None else wind["through_b"]} if windy else {}
        x = np.asarray(online.step(y, increment, aux, keep=_kept))
        said = {**_state_fields(x), "held": int(held)}
        return (online.state, increment), [("state", said)]

    takes = {"increment": 0, "fix": 0, "attitude": 0, "wind": 0}
    return Part("navigation", takes, first, act, dict.fromkeys(takes))


def _kept(step: Step) -> jax.Array:
    """Attitude, velocity, position and their sigmas, in one vector."""
    belief = step.posterior
    x = nav_of(belief.mean)
    place = jnp.stack([x.position.lat, x.position.lon, x.position.alt])
    return jnp.concatenate([x.q_nb.wxyz, x.v_n, place, belief.sigma])


def _state_fields(x: np.ndarray) -> Values:
    """Fields of the state message from a vector (19,) or vectors (E, 19)."""
    place = {"lat": x[..., 7], "lon": x[..., 8], "alt": x[..., 9]}
    return {"q_nb": x[..., :4], "v_n": x[..., 4:7], **place, "sigma": x[..., 10:19]}


def inside(config: AirshipConfig, steps: int | None = None) -> dict[str, np.ndarray]:
    """Same flight inside one program: its first `steps` epochs, or all."""
    made = CANDIDATES[config.filter].make()
    y, u, aux = jax.tree_util.tree_map(lambda x: x[:steps], (config.y, config.u, config.aux))
    done = run(made, config.model, config.start, y, u, aux, keep=_kept)
    return {f"state.{name}": x for name, x in _state_fields(np.asarray(done.steps)).items()}


def errors(config: AirshipConfig, series: MessageSeries) -> np.ndarray:
    """(E, 9) true less estimated attitude [rad], velocity [m/s], position [m], each ENU."""
    q, v, *place = (np.asarray(series[f"state.{f}"]) for f in ("q_nb", "v_n", "lat", "lon", "alt"))
    truth = jax.tree_util.tree_map(lambda x: x[: len(q)], config.truth)
    estimate = Nav(Rotation(q), jnp.asarray(v), Geodetic(*place))
    off = jax.jit(jax.vmap(manifold.local))(estimate, truth)
    return np.asarray(off) @ ENU_OF_NED.T


def judge(flight: LoadedRun, result: RunResult) -> RunFigures:
    """Errors over the counted epochs."""
    series, counted = result.series, slice(counted_from(flight, result.steps), None)
    error, sigma = errors(result.config, series), series["state.sigma"] @ np.abs(ENU_OF_NED).T
    arrays: dict[str, Any] = {}
    for block in BLOCKS:
        arrays |= block_array("error", block, error[None, :, block.where])
        arrays |= block_array("sigma", block, sigma[None, :, block.where])
    attitude = rms(error[counted, :3])
    metrics = {
        "attitude_rms_arcsec": None if attitude is None else attitude / _ARCSEC,
        "velocity_rms_m_s": rms(error[counted, 3:6]),
        "horizontal_rms_m": rms(error[counted, 6:8]),
    }
    counts = {"steps_without_increment": int(np.sum(series["state.held"]))}
    return RunFigures(metrics, counts, arrays=arrays, lines=figures_of(metrics))
