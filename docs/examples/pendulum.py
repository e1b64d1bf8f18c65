"""A pendulum that swings and a camera that watches it, as two parts on the bench.

The pendulum has an angle phi [rad] from straight down and a rate [rad/s]: phi'' = -(g/l) sin phi.
The camera measures the angle and runs an extended Kalman filter that believes the same equation.
"""

from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from robins.bench import Part, Rig, RunFigures, Wire
from robins.bench.run.setup import counted_from
from robins.bench.wire.fields import f64, message, size
from robins.filters import Belief, Model, Motion, OnlineFilter, Sensor, kalman
from robins.results import array
from robins.scenario import Parameters, Quantity, default

WIRE = Wire(
    ("pendulum", "camera"),
    (
        message(
            16,
            "swing",
            "The pendulum as it truly is.",
            f64("angle", 1, "rad", "from straight down", 10.0),
            f64("rate", 1, "rad/s", "of the angle", 100.0),
        ),
        message(
            17,
            "estimate",
            "What the camera makes of it.",
            f64("angle", 1, "rad", "from straight down", 10.0),
            f64("rate", 1, "rad/s", "of the angle", 100.0),
            size("sigma", 2, "rad, rad/s", "stated of angle and rate", 100.0),
        ),
    ),
)


class Pendulum(Parameters):
    """Parameters of a scenario."""

    duration: Annotated[float, Quantity("time", above="0 s")] = default("20 s")
    step: Annotated[float, Quantity("time", above="0 s")] = default("20 ms")
    counted_from: Annotated[float, Quantity("time", least="0 s")] = default("2 s")
    length: Annotated[float, Quantity("length", above="0 m")] = default("1 m")
    start: Annotated[float, Quantity("angle")] = default("30 deg")
    camera: Annotated[float, Quantity("angle", above="0 deg")] = default("1 deg")


class Kit(NamedTuple):
    """The numbers of a run, which every part has a copy of."""

    step_ns: int
    given: Pendulum
    noise: np.ndarray  # (E,) rad, of the camera
    frames: tuple[int, ...] = (0,)  # all steps are computed alike


@jax.jit
def swing(w2, T, x, u):
    """A step by the midpoint rule; w2 is g/l."""

    def slope(x):
        return jnp.array([x[1], -w2 * jnp.sin(x[0])])

    return x + T * slope(x + 0.5 * T * slope(x))


def moves(given: Pendulum) -> Partial:
    return Partial(swing, 9.81 / given.length, given.step)


def pendulum(config: Kit) -> Part:
    move = moves(config.given)

    def act(x, step, inputs):
        x = np.asarray(move(jnp.asarray(x), None))
        return x, [("swing", {"angle": x[0], "rate": x[1]})]

    return Part("pendulum", {}, lambda: np.array([config.given.start, 0.0]), act)


def camera(config: Kit) -> Part:
    pushes = jnp.diag(jnp.array([0.0, 1e-3]))  # rad/s a step, of what the model leaves out
    sees = Sensor(lambda x, aux: x[:1], jnp.array([config.given.camera]), name="camera")
    start = Belief(jnp.array([0.0, 0.0]), jnp.diag(jnp.array([1.0, 1.0])))
    online = OnlineFilter(kalman(), Model(Motion(moves(config.given), pushes), (sees,)), start)
    first = online.state

    def act(state, step, inputs):
        online.state = state
        online.predict()
        if (seen := inputs["swing"]) is not None:
            online.update(np.array([seen["angle"] + config.noise[step]]))
        x, factor = (np.asarray(a) for a in online.belief[:2])
        sigma = np.linalg.norm(factor, axis=1)
        return online.state, [("estimate", {"angle": x[0], "rate": x[1], "sigma": sigma})]

    return Part("camera", {"swing": 0}, lambda: first, act, {"swing": {"angle": 0.1, "rate": 0.0}})


class PendulumRig(Rig[Pendulum, Kit]):
    name = "pendulum"
    wire = WIRE
    sends = {"pendulum": ("swing",), "camera": ("estimate",)}
    takes = {"pendulum": (), "camera": ("swing",)}
    parameters = Pendulum
    truth = "swing"

    def prepare(self, setup, given):
        noise = np.random.default_rng(setup.seed).normal(size=round(given.duration / given.step))
        return Kit(round(given.step * 1e9), given, given.camera * noise)

    def judge(self, flight, result):
        series, first = result.series, counted_from(flight, result.steps)
        error = np.degrees(series["swing.angle"] - series["estimate.angle"])[:, None]
        sigma = np.degrees(series["estimate.sigma"][:, :1])
        rms = float(np.sqrt(np.nanmean(error[first:] ** 2)))
        about = {"unit": "deg", "frame": "pendulum", "axes": ("angle",)}
        return RunFigures(
            metrics={"angle_rms_deg": rms},
            arrays=array("error", error[None], "angle", **about)
            | array("sigma", sigma[None], "angle", **about),
            lines=[f"angle rms       {rms:10.3f} deg"],
        )


rig = PendulumRig()
