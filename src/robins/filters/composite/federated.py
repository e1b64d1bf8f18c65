"""Federated filter: parallel local filters whose information is shared and fused.

Each local filter has sensors of its own, and a share of the prior information and of the process
noise, so that their information adds up to the whole (Carlson 1990):

    fuse     Y_g = sum_i Y_i + Y_m,  x_g = Y_g^-1 (sum_i Y_i x_i + Y_m x_m)
    share    x_i = x_g,  P_i = P_g / b_i,  Q_i = Q / b_i,  sum_i b_i + b_m = 1

    mode          at the start of each step
    fusion-reset  locals and master take their shares of the fused belief
    no-reset      locals continue from their own beliefs; the master only fuses
    zero-reset    locals lose their information, the master keeps it
    rescale       locals keep c Y_i, the master takes the (1 - c) Y_i that they give away

After a zero-reset a local filter has no prior to test measurements against, and sigma points of an
unknown state lie outside the range of any model: use Taylor and no robust rules.

A local filter without measurements stays in the fusion: it holds a share of the information, and
leaving it out would multiply P by 1 / (1 - b_i). With linear models fusion-reset with scalar or
root sharing, and zero-reset, *are* the centralised filter. With a ``timeout``, a local filter that
has used no measurement for so many steps (none came, or its rules refused them) gives its share
away at the next reset: the others get it in proportion to theirs, and it keeps `FLOOR` until it
uses a measurement again.

A share a_ij in (0, 1) is the part of the information about state j that local filter i gets (b_i if
it is the same for all states). There are four ways to choose them (Zhao, Li & Wang 2016; Xiong et
al. 2013):

    equal          b_i  = 1 / N
    trace          b_i  ~ 1 / tr P_i                        states scaled first
    diagonal       a_ij ~ 1 / P_i,jj
    observability  a_ij ~ sigma_ij,  sigma_ij^2 = (O_i' O_i)_jj,
                   O_i = [R_i^-1/2 H_i; R_i^-1/2 H_i F; ...; R_i^-1/2 H_i F^(k-1)] D

With a reset at every step and linear models shares cannot change the fused accuracy. They matter
where a local filter tests measurements by its own covariance, and where it is not reset. In terms
of O = U S V', sigma_j^2 is sum_l S_l^2 V_jl^2: a singular value belongs to a direction, not to the
state of the same index. D, the standard deviations of the belief, makes the states unit-free.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import linalg, manifold
from robins.errors import require
from robins.filters.belief import Belief, Code, Number
from robins.filters.checks import one_of
from robins.filters.composite.channels import (
    Channel,
    JoinedFilter,
    JoinedPrediction,
    composed_motion,
    owners,
)
from robins.filters.composite.fusion import Sharing, check_sharing, information_sum, part
from robins.filters.kalman import Filter, FilterState, kalman
from robins.filters.linearise import Linearisation, taylor
from robins.filters.model import Data, Given, Model, Motion
from robins.filters.values import Numbers, is_known, kind, number, value
from robins.manifold import State

# Least share: a share of zero would be an infinite covariance.
FLOOR = 0.05


def floored(weights: Array) -> Array:
    """Shares from weights (N, ...): they sum to one over N, and none is below about `FLOOR`.

    If all weights are zero, the shares are equal. Shares that sum to one and lie above the floor
    are returned unchanged, to rounding.
    """
    total = jnp.sum(weights, axis=0, keepdims=True)
    some = total > 0.0
    a = jnp.where(some, weights / jnp.where(some, total, 1.0), 1.0 / weights.shape[0])
    a = jnp.maximum(a, FLOOR)
    return a / jnp.sum(a, axis=0, keepdims=True)


def equal_shares(count: int) -> Array:
    """(N, 1) equal shares."""
    return jnp.full((count, 1), 1.0 / count)


def trace_shares(beliefs: Sequence[Belief], sigma: Array) -> Array:
    """(N, 1) shares inverse to the trace of each local covariance.

    Args:
        beliefs: beliefs of the local filters.
        sigma: (n,) unit of each state, such as its fused standard deviation.
    """
    unit = jnp.where(sigma > 0.0, sigma, 1.0)
    return floored(jnp.stack([1.0 / jnp.sum((b.sigma / unit) ** 2) for b in beliefs])[:, None])


def diagonal_shares(beliefs: Sequence[Belief]) -> Array:
    """(N, n) shares inverse to the variance of each state in each local filter."""
    return floored(jnp.stack([1.0 / b.sigma**2 for b in beliefs]))


def observability_shares(
    model: Model,
    belief: Belief,
    channels: Sequence[Channel],
    steps: int | None = None,
    u: Data = None,
    aux: Mapping[str, Data] | None = None,
) -> np.ndarray:
    """(N, n) shares by the observability of each state in each channel; computed before a run.

    A state that no channel observes is shared equally.

    Args:
        model: motion and sensors, linearised at the belief.
        belief: point of linearisation; its standard deviations are the units of the states.
        channels: from `channel`.
        steps: number k of blocks in O_i; by default n, the dimension of the state.
        u: input of the motion for one step.
        aux: what sensors need besides the state, by sensor name.

    Raises:
        KeyError: a channel names a sensor that the model does not have.
        ValueError: there is less than one step, or a sensor has no noise, thus infinite weight.
    """
    n = manifold.dim(belief.mean)
    count = n if steps is None else steps
    require(count >= 1, f"observability over {count} steps: at least one is wanted")
    way, unit = taylor(), Belief(belief.mean, jnp.eye(n))
    F = np.asarray(way.transition(unit, model.motion, u).spread)  # F times the identity
    D = np.asarray(belief.sigma)
    sees = np.zeros((len(channels), n))
    for i, one in enumerate(channels):
        for name in one.sensors:
            sensor, extra = model.sensor(name), (aux or {}).get(name)
            seen = way.observation(unit, sensor, sensor.read(belief.mean, extra), extra)
            root = linalg.tria(seen.noise)
            if not bool(jnp.all(jnp.diagonal(root) > 0.0)):
                raise ValueError(f"sensor '{name}' has components without noise: give it some")
            block = np.asarray(linalg.solve_lower(root, seen.spread))
            for _ in range(count):
                sees[i] += np.sum((block * D) ** 2, axis=0)
                block = block @ F
    return np.asarray(jax.device_get(floored(jnp.sqrt(jnp.asarray(sees)))))


Mode = Literal["fusion-reset", "no-reset", "zero-reset", "rescale"]

HALF = (
    "sharing='half' is no upper bound where states with different shares are correlated, and adds "
    "information at every reset (det P falls with no data at all): use 'root', which conserves it"
)

# Share of a local filter in zero-reset. A filter cannot start without information, so it gets this
# share of the prior, and the master the rest: the sum is exact.
_TRACE = 1e-8


@value
class Federated(JoinedFilter):
    """Filter made by `federated`.

    The belief of its state is the fused one, after a prediction and after each sensor. The
    `StepInfo` of an update (innovation, gain, NIS, log-likelihood) is that of the sensor's local
    filter, which has less information than the whole: the log-likelihoods of a run do not sum to
    that of the data. Notes: ``federated.share``, the mean share of that local filter, and
    ``federated.silent``, steps since it used a measurement.

    Rules of a local filter act on its share. With sharing after the prediction, a local filter with
    rules makes its own prediction, by a motion that leads to its share of the common prediction;
    one without rules only updates.
    """

    centre: Filter  # predicts the fused belief and the master's
    fixed: Numbers | None  # (channels,) or (channels, n) shares, if given
    master: Numbers  # () share of the master
    keep: Numbers  # () c of mode "rescale"
    timeout: Numbers | None  # () steps
    mode: Mode = kind()
    sharing: Sharing = kind()
    weighing: str = kind()  # "given", or the way in which shares are chosen
    has_master: bool = kind()
    late: bool = kind()  # shared after the prediction

    @property
    def count(self) -> int:
        """Number of channels."""
        return len(self.channels)

    @property
    def filters(self) -> tuple[Filter, ...]:
        return (*super().filters, self.centre) if self.has_master else super().filters

    def with_filters(self, filters: tuple[Filter, ...]) -> JoinedFilter:
        centre = filters[-1] if self.has_master else self.centre
        return replace(super().with_filters(filters), centre=centre)

    def fuse(self, beliefs: Sequence[Belief]) -> Belief:
        return information_sum(beliefs)

    def divided(self, belief: Belief, shares: Array) -> list[Belief]:
        return [Belief(belief.mean, one) for one in part(belief.factor, shares, self.sharing)]

    def first_shares(self, belief: Belief) -> Array:
        n = belief.factor.shape[0]
        if self.mode == "zero-reset":
            return jnp.array([[_TRACE]] * self.count + [[1.0 - self.count * _TRACE]])
        if self.fixed is None:
            a = equal_shares(self.count)
            return self.with_master(a if self.weighing != "diagonal" else jnp.tile(a, (1, n)))
        if self.fixed.ndim == 2 and self.fixed.shape[1] != n:
            raise ValueError(f"shares are for {self.fixed.shape[1]} states, the belief has {n}")
        return self.with_master(floored(jnp.asarray(self.fixed.reshape(self.count, -1))))

    def with_master(self, a: Array) -> Array:
        """Shares of the channels, scaled to sum to 1 - b_m, then b_m of the master if any."""
        if not self.has_master:
            return a
        own = jnp.full((1, a.shape[1]), self.master)
        return jnp.concatenate([(1.0 - self.master) * a, own])

    def next_shares(self, state: FilterState) -> Array:
        """Shares of a step, with those of silent local filters given to the others."""
        a = self.chosen_shares(state)
        if self.timeout is None:
            return a
        # The master's share does not change; where all are silent, none can take a share.
        heard = (state.memory.silent.astype(float) < self.timeout)[:, None]
        mine = a[: self.count]
        left = floored(jnp.where(heard, mine, 0.0)) * jnp.sum(mine, axis=0, keepdims=True)
        return jnp.where(jnp.any(heard), a.at[: self.count].set(left), a)

    def chosen_shares(self, state: FilterState) -> Array:
        """Shares as given, or from the covariances of the local filters."""
        locals_ = [m.belief for m in state.memory.members[: self.count]]
        if self.weighing == "trace":
            return self.with_master(trace_shares(locals_, state.belief.sigma))
        if self.weighing == "diagonal":
            return self.with_master(diagonal_shares(locals_))
        return self.first_shares(state.belief)

    def begun(self, state: FilterState, a: Array) -> list[FilterState]:
        """Members at the start of a step, after the reset of the mode."""
        members = state.memory.members
        if self.mode == "no-reset":
            return list(members)
        reset = self.mode == "fusion-reset"
        beliefs = self.divided(state.belief, a) if reset else _rescaled(members, self.keep)
        return [f.reset(m, b) for f, m, b in zip(self.filters, members, beliefs, strict=True)]

    def moved(self, state: FilterState, motion: Motion, u: Data) -> JoinedPrediction:
        a = self.next_shares(state)
        if self.late:
            return self.predict_fused(state, motion, u, a)

        def own(i: int) -> Motion:
            return composed_motion(motion, lambda noise: part(noise, a, self.sharing)[i])

        motions = [own(i) for i in range(len(self.filters))]
        return self.predict_separately(self.begun(state, a), motions, u, a)

    def predict_fused(
        self, state: FilterState, motion: Motion, u: Data, a: Array
    ) -> JoinedPrediction:
        """Predict the fused belief, then divide it among the members."""
        _, common = self.centre.predict(self.centre.init(state.belief, {}), motion, u)
        members, codes, own = [], [], False
        beliefs = self.divided(common.belief, a)
        for f, member, belief in zip(self.filters, state.memory.members, beliefs, strict=True):
            code = int(Code.DONE)
            if member.memory == ():  # a Kalman filter without rules
                member = f.reset(member, belief)
            else:
                own = True
                seen = _share_motion(motion, common.belief, belief)
                member, prediction = f.predict(f.reset(member, state.belief), seen, u)
                code = prediction.code
            members.append(member)
            codes.append(code)
        # The parts of half sharing do not sum to the whole, and rules may have changed a share.
        lossless = not own and (self.sharing != "half" or a.shape[1] == 1)
        fused = common.belief if lossless else self.fuse([m.belief for m in members])
        return JoinedPrediction(
            tuple(members), tuple(codes), fused, a, common.transition, common.code
        )


def federated(
    channels: Sequence[Channel],
    mode: Mode = "fusion-reset",
    sharing: Sharing = "root",
    shares: str | Given = "equal",
    master: Number = 0.0,
    *,
    keep: Number = 0.5,
    after_prediction: bool | None = None,
    linearise: Linearisation | None = None,
    timeout: int | None = None,
) -> Filter:
    """Federated Kalman filter (Carlson 1990); runs, streams and batches like any `Filter`.

    Args:
        channels: from `channel`; every sensor of the model belongs to exactly one.
        mode: "fusion-reset", "no-reset", "zero-reset" or "rescale" (module docstring).
        sharing: "root", "scalar" or "half" (`robins.filters.composite.fusion`).
        shares: "equal"; "trace" or "diagonal", from the local covariances at every step; or (N,) or
            (N, n) numbers that sum to one with the master's, such as `observability_shares`.
            Shares below 0.05 are raised to it.
        master: share of a master, which has no sensors, from 0 to below 1.
        keep: c of mode "rescale", the share of its information that a local filter keeps.
        after_prediction: fusion-reset: predict the fused belief, then share it (True), or share it
            and predict each part (False). By default True with root sharing, which is exact only in
            this way, else False.
        linearise: linearisation of the fused prediction, as in the locals; `taylor()` by default.
        timeout: fusion-reset: number of steps without a used measurement after which the share of a
            local filter goes to the others, until it uses one again; None: never. With linear
            models it changes the fused belief only if local filters have rules.

    Raises:
        ValueError: a sensor is in two channels; the mode, the sharing or the kind of shares is
            unknown; shares do not sum to one; the mode has no master or no timeout; at `init`, a
            sensor has no channel.
    """
    owners(channels)
    _check_kinds(mode, sharing, after_prediction)
    within = "the master's share must lie from 0 to below 1"
    of_master = number(within, master, lambda b: (b >= 0.0) & (b < 1.0))
    has_master = _has_master(mode, shares, of_master)
    fixed = _fixed_shares(shares, len(channels), of_master)
    weighing = shares if isinstance(shares, str) else "given"
    if sharing == "scalar" and (weighing == "diagonal" or (fixed is not None and fixed.ndim == 2)):
        raise ValueError("scalar sharing takes one share a channel: use 'root' for one a state")
    usual = sharing == "root" if after_prediction is None else after_prediction
    return Federated(
        channels=tuple(channels),
        title="federated",
        centre=kalman(linearise),
        fixed=fixed,
        master=of_master,
        keep=number("keep must lie between 0 and 1", keep, lambda c: (c > 0.0) & (c < 1.0)),
        timeout=_steps(mode, timeout),
        mode=mode,
        sharing=sharing,
        weighing=weighing,
        has_master=has_master,
        late=mode == "zero-reset" or (mode == "fusion-reset" and usual),
    )


def _check_kinds(mode: str, sharing: str, after_prediction: bool | None) -> None:
    one_of("mode", mode, Mode)
    check_sharing(sharing)
    if after_prediction and mode != "fusion-reset":
        raise ValueError(f"sharing after the prediction is of mode 'fusion-reset', not {mode!r}")
    if sharing == "half":
        warnings.warn(HALF, UserWarning, stacklevel=3)


def _steps(mode: str, timeout: int | None) -> Numbers | None:
    """Timeout [steps], refused in modes that have none."""
    if timeout is None:
        return None
    require(mode == "fusion-reset", f"mode {mode!r} does not share anew: it has no timeout")
    short = "federated timeout must be at least one step"
    return number(short, timeout, lambda steps: steps >= 1)


def _rescaled(members: Sequence[FilterState], keep: Numbers) -> list[Belief]:
    """Locals with c Y_i, and the master with Y_m + (1 - c) sum Y_i, which needs no subtraction."""
    *locals_, master = (m.belief for m in members)
    kept = [Belief(b.mean, b.factor / jnp.sqrt(keep)) for b in locals_]
    weights = jnp.array([1.0] + [1.0 - keep] * len(locals_))
    return [*kept, information_sum([master, *locals_], weights)]


def _share_motion(motion: Motion, common: Belief, mine: Belief) -> Motion:
    """Motion that predicts, from the fused belief, a share of the common prediction.

    With S- the factor of the common prediction and S_i that of the share, T = S_i S-^-1 maps one
    covariance to the other: T (F P F' + Q) T' = P_i. So the motion is followed by T about the
    predicted mean, and its noise is multiplied by T.
    """
    solid, _ = linalg.guard(common.factor)
    T = linalg.solve_lower_transposed(solid, mine.factor.T).T

    def moved(x: State) -> State:
        return manifold.retract(common.mean, T @ manifold.local(common.mean, x))

    return composed_motion(motion, lambda noise: T @ noise, moved, lambda F: T @ F)


def _has_master(mode: str, shares: str | Given, master: Numbers) -> bool:
    """True if there is a master; refuse one, or shares, that the mode excludes."""
    some = not is_known(master) or bool(master > 0.0)
    if mode == "rescale" and not some:
        raise ValueError(
            "mode 'rescale' needs a master to take what the locals give away: give it a share"
        )
    chosen = some or not isinstance(shares, str) or shares != "equal"
    if mode == "zero-reset" and chosen:
        raise ValueError("mode 'zero-reset' leaves everything to the master: shares have no say")
    return some or mode == "zero-reset"


def _fixed_shares(shares: str | Given, count: int, master: Numbers) -> Numbers | None:
    """Shares of the channels, scaled to sum to one; None if they are not given as numbers."""
    if isinstance(shares, str):
        if shares == "observability":
            raise ValueError(
                "shares by observability need the model: give observability_shares(model, belief, "
                "channels) as shares"
            )
        if shares not in ("equal", "trace", "diagonal"):
            raise ValueError(
                f"shares must be 'equal', 'trace', 'diagonal' or numbers, got {shares!r}"
            )
        return None
    a = np.asarray(shares, dtype=float) if is_known(shares) else jnp.asarray(shares, dtype=float)
    if a.ndim not in (1, 2) or a.shape[0] != count:
        raise ValueError(f"shares have shape {a.shape}: ({count},) or ({count}, n) is wanted")
    if is_known(a) and (not np.all(np.isfinite(a)) or np.any(a < 0.0)):
        raise ValueError(f"shares must be finite and not negative, got {a.tolist()}")
    total = a.sum(axis=0)
    if is_known((total, master)) and np.any(np.abs(total + master - 1.0) > 1e-9):
        raise ValueError(
            f"shares sum to {total.tolist()}, with the master's {master} they must sum to one"
        )
    return a / total
