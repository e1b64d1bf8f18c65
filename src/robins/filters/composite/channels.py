"""Channels: parallel local filters, each with sensors of its own, joined into one filter.

Common parts of the federated and the distributed filter: assignment of sensors to local filters,
update of a local filter, fusion after it, and steps that cannot be taken.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from robins import manifold
from robins.errors import require
from robins.filters.belief import Belief, Code, StepInfo
from robins.filters.checks import sensor_names
from robins.filters.composite.fusion import is_singular
from robins.filters.kalman import (
    Advanced,
    Again,
    Composite,
    Filter,
    FilterState,
    Follow,
    Prediction,
    Updated,
    invalidated_unless,
    kalman,
)
from robins.filters.linearise import Transition
from robins.filters.model import Data, Motion, Sensor, as_noise
from robins.filters.trees import equal, finite, select
from robins.filters.values import kind, value
from robins.manifold import State


@value
class Channel:
    """Local filter and the sensors it uses; made by `channel`."""

    sensors: tuple[str, ...] = kind()
    filter: Filter

    @property
    def name(self) -> str:
        """Names of its sensors, for messages."""
        return "+".join(self.sensors)


def channel(sensors: str | Sequence[str], filter: Filter | None = None) -> Channel:
    """Channel of a local filter and the names of the sensors it uses.

    Args:
        sensors: a name, or several.
        filter: `kalman(...)` with rules of its own, or any other `Filter`; `kalman()` by default.

    Raises:
        ValueError: no sensor is named, or one twice.
    """
    names = sensor_names("a channel needs sensors", sensors)
    once = len(set(names)) == len(names)
    require(once, "a channel needs sensors, each named once", list(names))
    return Channel(names, kalman() if filter is None else filter)


def owners(channels: Sequence[Channel]) -> dict[str, int]:
    """Index of the channel of each sensor.

    Raises:
        ValueError: there are no channels, or a sensor belongs to two.
    """
    require(channels, "no channels: at least one local filter is wanted")
    owner: dict[str, int] = {}
    for i, one in enumerate(channels):
        for name in one.sensors:
            require(
                name not in owner,
                f"sensor '{name}' belongs to two channels: what it measures would be counted twice",
            )
            owner[name] = i
    return owner


def local_dims(channels: Sequence[Channel], dims: Mapping[str, int]) -> list[dict[str, int]]:
    """Sensor dimensions by channel, in the model's order."""
    owner = owners(channels)
    if homeless := [name for name in dims if name not in owner]:
        raise ValueError(
            f"no channel uses sensor {homeless[0]!r}: name it in one, or take it out of the model"
        )
    if unknown := [name for name in owner if name not in dims]:
        raise ValueError(
            f"channel '{channels[owner[unknown[0]]].name}' uses sensor {unknown[0]!r}; this model "
            f"has {sorted(dims)}"
        )
    return [{k: v for k, v in dims.items() if owner[k] == i} for i in range(len(channels))]


# ------------------------------------------------------------------------------ filters of filters


class JoinedMemory(NamedTuple):
    """Memory of a filter of channels besides the fused belief."""

    members: tuple[FilterState, ...]  # by channel; last the master, if there is one
    shares: Array  # (members, 1 or n) of the information
    silent: Array  # (channels,) steps since a measurement was used
    singular: Array  # (members,) steps not taken because the information was infinite


class JoinedPrediction(NamedTuple):
    """Members after a prediction, and the outcome of each filter that predicted."""

    members: tuple[FilterState, ...]
    codes: tuple[Any, ...]  # by member
    belief: Belief  # fused
    shares: Array
    transition: Transition | None = None  # of a prediction common to all
    code: Any = int(Code.DONE)  # of that prediction


@value
class JoinedFilter(Composite):
    """Local filters whose beliefs are fused after each step; its memory is a `JoinedMemory`.

    Attributes:
        channels: the local filters, each with its sensors.
        title: prefix of its notes.
        fuse: ``beliefs -> Belief`` of all members.
        apart: ``(beliefs, i) -> bool``, true if local filter i contradicts another.
        first_shares: ``belief -> shares`` at the start.
        divided: ``(belief, shares) -> beliefs`` of the members.
        moved: ``(state, motion, u) -> JoinedPrediction``.
    """

    channels: tuple[Channel, ...]
    title: str = kind()

    def fuse(self, beliefs: Sequence[Belief]) -> Belief:
        raise NotImplementedError(f"{type(self).__name__} must have `fuse`")

    def apart(self, beliefs: Sequence[Belief], i: int) -> Array:
        return disagree(beliefs, i, None)

    def first_shares(self, belief: Belief) -> Array:
        raise NotImplementedError(f"{type(self).__name__} must have `first_shares`")

    def divided(self, belief: Belief, shares: Array) -> list[Belief]:
        raise NotImplementedError(f"{type(self).__name__} must have `divided`")

    def moved(self, state: FilterState, motion: Motion, u: Data) -> JoinedPrediction:
        raise NotImplementedError(f"{type(self).__name__} must have `moved`")

    @property
    def filters(self) -> tuple[Filter, ...]:
        return tuple(one.filter for one in self.channels)

    def with_filters(self, filters: tuple[Filter, ...]) -> JoinedFilter:
        each = zip(self.channels, filters, strict=False)  # a master has no channel
        return replace(self, channels=tuple(replace(c, filter=f) for c, f in each))

    def parts(self, state: FilterState) -> tuple[FilterState, ...]:
        return state.memory.members

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        given = local_dims(self.channels, dims)
        given += [{}] * (len(self.filters) - len(given))
        shares = self.first_shares(belief)
        each = zip(self.filters, self.divided(belief, shares), given, strict=True)
        members = tuple(f.init(own, d) for f, own, d in each)
        silent, singular = (jnp.zeros(len(x), int) for x in (self.channels, members))
        return FilterState(belief, JoinedMemory(members, shares, silent, singular))

    def members(self, state: FilterState) -> tuple[tuple[Belief, ...], Follow]:
        joined: JoinedMemory = state.memory

        def follow(beliefs: Sequence[Belief], belief: Belief) -> FilterState:
            each = zip(self.filters, joined.members, beliefs, strict=True)
            states = tuple(f.reset(member, own) for f, member, own in each)
            return FilterState(belief, joined._replace(members=states))

        return tuple(member.belief for member in joined.members), follow

    def reset(self, state: FilterState, belief: Belief) -> FilterState:
        return self.members(state)[1](self.divided(belief, state.memory.shares), belief)

    def predict_separately(
        self, begun: Sequence[FilterState], motions: Sequence[Motion], u: Data, shares: Array
    ) -> JoinedPrediction:
        """Predict each member from its own state."""
        each = zip(self.filters, begun, motions, strict=True)
        done = [f.predict(member, motion, u) for f, member, motion in each]
        members = tuple(member for member, _ in done)
        codes = tuple(prediction.code for _, prediction in done)
        return JoinedPrediction(members, codes, self.fuse([m.belief for m in members]), shares)

    def _predict(self, state: FilterState, motion: Motion, u: Data) -> Advanced:
        return conclude_prediction(state, self.moved(state, motion, u))

    def _update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data) -> Updated:
        owner = owners(self.channels)
        if sensor.name not in owner:
            raise ValueError(f"no channel uses sensor '{sensor.name}'; there are {sorted(owner)}")
        joined: JoinedMemory = state.memory
        i = owner[sensor.name]
        before = joined.members[i]
        after, info = self.channels[i].filter.update(before, sensor, y, aux)
        members = (*joined.members[:i], after, *joined.members[i + 1 :])
        silent = jnp.where(info.dof > 0, joined.silent.at[i].set(0), joined.silent)
        # Where the local belief is unchanged, the fused one stays the same bit for bit.
        same = equal(before.belief, after.belief)
        belief = select(same, state.belief, self.fuse([m.belief for m in members]))
        info = self.compared(members, i, info)
        singular = jnp.stack([is_singular(m.belief) for m in members])
        ok = same | (finite(belief) & ~jnp.any(singular))
        new = FilterState(belief, joined._replace(members=members, silent=silent))
        info = invalidated_unless(ok, info, jnp.asarray(int(Code.NOT_FINITE)))
        info = info.noted(self.title, share=jnp.mean(joined.shares[i]), silent=silent[i])
        return select(ok, new, _refused(state, singular)), info

    def compared(self, members: Sequence[FilterState], i: int, info: StepInfo) -> StepInfo:
        """Information of local filter i, with code `Code.APART` if it now contradicts another."""
        locals_ = [m.belief for m in members[: len(self.channels)]]
        apart = self.apart(locals_, i) & (info.code == int(Code.DONE))
        return info._replace(code=jnp.where(apart, int(Code.APART), info.code))

    @property
    def reports(self) -> bool:
        return True

    def report(
        self, start: FilterState, final: FilterState, again: Again | None, time: ArrayLike | None
    ):
        super().report(start, final, again, time)
        for i, count in enumerate(np.asarray(final.memory.singular).tolist()):
            local = i < len(self.channels)
            name = f"channel '{self.channels[i].name}'" if local else "the master"
            require(
                count == 0,
                f"the covariance of {name} was singular in {count} steps, which were not taken: "
                "infinite information cannot be fused. Give a constraint, a measurement or a state "
                "without noise some noise, or constrain what is fused",
            )


FAR = 5.0  # difference of local filters that is not chance, in standard deviations


def disagree(beliefs: Sequence[Belief], index: int, common: int | None) -> Array:
    """() bool: a local filter differs from another by more than `FAR` standard deviations.

    Only the first ``common`` tangent components are compared; None: all. The errors of local
    filters with the same process noise are not negatively correlated, so that the sum of the
    variances is an upper bound of that of the difference.
    """
    own, others = beliefs[index], (*beliefs[:index], *beliefs[index + 1 :])
    found = jnp.zeros((), bool)
    for other in others:
        square = manifold.local(own.mean, other.mean)[:common] ** 2
        variance = own.sigma[:common] ** 2 + other.sigma[:common] ** 2
        found |= jnp.any((square > FAR**2 * variance) & (variance > 0.0))
    return found


def conclude_prediction(state: FilterState, moved: JoinedPrediction) -> Advanced:
    """State and record of the prediction of a joined filter, taken by all members or by none.

    A member that cannot take the step keeps its new memory, which records that (`Rule.settle`).
    """
    joined: JoinedMemory = state.memory
    joined = joined._replace(silent=joined.silent + 1)
    done = int(Code.DONE)
    singular = jnp.stack([is_singular(m.belief) for m in moved.members])
    sound = finite(moved.belief) & ~jnp.any(singular)
    code = jnp.where(sound, done, int(Code.NOT_FINITE))
    for one in (*reversed(moved.codes), moved.code):
        code = jnp.where(one == done, code, one)
    ok = code == done
    kept = tuple(
        old._replace(memory=select(one == done, old.memory, new.memory))
        for old, new, one in zip(joined.members, moved.members, moved.codes, strict=True)
    )
    stays = state._replace(memory=joined._replace(members=kept))
    new = FilterState(moved.belief, joined._replace(members=moved.members, shares=moved.shares))
    new = select(ok, new, _refused(stays, singular))
    return new, Prediction(moved.transition, new.belief, code)


def _refused(state: FilterState, singular: Array) -> FilterState:
    joined: JoinedMemory = state.memory
    return state._replace(memory=joined._replace(singular=joined.singular + singular.astype(int)))


def composed_motion(
    motion: Motion,
    noise: Callable[[Array], Array],
    state: Callable[[State], State] = lambda x: x,
    slope: Callable[[Array], Array] = lambda F: F,
) -> Motion:
    """Motion whose noise factor, new state and Jacobian F are each mapped by a function."""
    known = motion.linear

    def linear(x: State, u: Data):
        assert known is not None
        mean, F, given = known(x, u)
        return state(mean), slope(F), noise(as_noise(given, F.shape[0], "the motion"))

    return Motion(
        lambda x, u: state(motion.step(x, u)),
        lambda x, u: noise(motion.noise_factor(x, u)),
        None if known is None else linear,
    )


# ------------------------------------------------------------------------- sensors of the master


class MasterMemory(NamedTuple):
    """Memory of a joined filter with sensors at its master, besides the reported belief."""

    joined: FilterState  # its belief is the reported one
    master: FilterState


@value
class AtMaster(Composite):
    """Filter made by `at_master`."""

    joined: Filter
    master: Filter
    sensors: tuple[str, ...] = kind()

    held = ("joined", "master")

    def parts(self, state: FilterState) -> tuple[FilterState, ...]:
        return state.memory

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        self.check_order(dims)
        joined = self.joined.init(belief, {k: m for k, m in dims.items() if k not in self.sensors})
        require(
            self.joined.members(joined)[0],
            "at_master wants a filter of channels: one without locals uses the sensor itself",
        )
        own = self.master.init(belief, {k: m for k, m in dims.items() if k in self.sensors})
        return FilterState(joined.belief, MasterMemory(joined, own))

    def check_order(self, dims: Mapping[str, int]) -> None:
        """Refuse a model that lacks one of the sensors, or does not have them last."""
        if unknown := [name for name in self.sensors if name not in dims]:
            raise ValueError(f"at_master: no sensor {unknown[0]!r}; this model has {sorted(dims)}")
        last = list(dims)[-len(self.sensors) :]
        if late := [name for name in last if name not in self.sensors]:
            raise ValueError(
                f"at_master: sensor {late[0]!r} comes after one of the master's: put "
                f"{list(self.sensors)} last in the model"
            )

    def _predict(self, state: FilterState, motion: Motion, u: Data) -> Advanced:
        mastered: MasterMemory = state.memory
        joined, prediction = self.joined.predict(mastered.joined, motion, u)
        return FilterState(joined.belief, mastered._replace(joined=joined)), prediction

    def _update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data) -> Updated:
        mastered: MasterMemory = state.memory
        if sensor.name not in self.sensors:
            joined, info = self.joined.update(mastered.joined, sensor, y, aux)
            return FilterState(joined.belief, mastered._replace(joined=joined)), info
        begun = self.master.reset(mastered.master, state.belief)
        own, info = self.master.update(begun, sensor, y, aux)
        joined = mastered.joined._replace(belief=own.belief)
        return FilterState(own.belief, MasterMemory(joined, own)), info

    def reset(self, state: FilterState, belief: Belief) -> FilterState:
        mastered: MasterMemory = state.memory
        joined = self.joined.reset(mastered.joined, belief)
        own = self.master.reset(mastered.master, belief)
        return FilterState(joined.belief, MasterMemory(joined, own))

    def members(self, state: FilterState) -> tuple[tuple[Belief, ...], Follow]:
        mastered: MasterMemory = state.memory
        beliefs, follow = self.joined.members(mastered.joined)

        def followed(beliefs: Sequence[Belief], belief: Belief) -> FilterState:
            return FilterState(belief, mastered._replace(joined=follow(beliefs, belief)))

        return beliefs, followed


def at_master(filter: Filter, sensors: str | Sequence[str], master: Filter | None = None) -> Filter:
    """Joined filter with some sensors that update the fused belief instead of a local filter.

    A hard constraint makes the covariance of a local filter singular, so that it cannot be fused
    (eq. 51 of Zhao, Gao, Ding & Wei 2017 needs its inverse), and one that several locals use is
    counted several times. Applied to the fused belief, it is counted once and may be exact. Its
    effect on later steps depends on the use of the fused belief in the next prediction:

        distributed, intersecting   own: locals keep their own beliefs, the constraint is output
                                    only; mean: its mean is fed back; full: mean and covariance
        federated                   fusion-reset, zero-reset: shared like the rest of the belief
                                    no-reset, rescale: output only

    The sensors must come last in the model: after a local measurement the belief is fused again
    from the locals, which have not used them.

    Args:
        filter: `distributed`, `intersecting` or `federated`, of the other sensors.
        sensors: sensors that update the fused belief.
        master: filter that makes these updates, by its linearisation and its hooks `before` and
            `after`; it never predicts. `kalman()` by default.

    Raises:
        ValueError: no sensor is named; at `init`, the model has no such sensor or has another one
            after it, or the filter is not a joined one.
    """
    names = sensor_names("at_master", sensors)
    return AtMaster(filter, kalman() if master is None else master, names)
