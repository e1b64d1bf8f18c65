"""Every rule, on one model of one T, n and m: alone, turned off, in filters where it acts, misused.

A new rule is a row in `RULES`, in `OFF` if it has such a limit, in one of `ACTING`, and rows in
`MISUSED`; test_rule_laws.py and test_compose.py hold it to what all rules promise.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from dense_kalman import System, simulate
from jax.tree_util import Partial

from robins.filters import Belief, Code, Model, Motion, Observation, Sensor, adaptive, kalman
from robins.filters.rules import (
    adaptive_h_infinity,
    channel_inflation,
    consider,
    constant_gain,
    correntropy,
    discriminator,
    equality,
    fading_memory,
    gate,
    h_infinity,
    huber,
    igg3,
    inequality,
    innovation_fading,
    only,
    per_step,
    projection,
    sage_husa,
    strong_tracking,
    student_t,
    variational_bayes,
)
from robins.manifold import Angle

# --------------------------------------------------------------------------------------- the model

T, N, M = 24, 4, 3
RAD = 0.01  # unit of the heading: its outliers stay far below half a turn
# Heading, its rate, a position and its rate. Nothing follows from the heading itself, so that it
# may start anywhere on its circle.
SYSTEM = System(
    F=np.array(
        [[1.0, 0.2 * RAD, 0.1 * RAD, 0], [0, 0.9, 0.1, 0], [0, 0, 0.95, 0.2], [0, 0, 0, 0.9]]
    ),
    G=np.diag([0.1 * RAD, 0.3, 0.2, 0.4]) + 0.05 * np.diag([1.0, 1.0, 1.0], -1),
    H=np.array([[1.0, 0, 0, 0], [0, 1.0, 0.2, 0], [0, 0, 1.0, -0.5]]),
    W=np.array([[0.5 * RAD, 0, 0], [0.3, 0.8, 0], [0, -0.2, 0.6]]),
    m0=np.array([0.0, 1.0, 0.5, -1.0]),
    P0=np.diag([RAD**2, 1.0, 2.0, 1.0])
    + 0.3 * np.eye(4, k=1) * [0, 0, 1, 1]
    + 0.3 * np.eye(4, k=-1) * [0, 1, 1, 0],
)
START = SYSTEM.start()


def troubled() -> np.ndarray:
    """Gaps in components and whole rows, noise larger than told, outliers, a jump that stays."""
    y = 1.5 * simulate(SYSTEM, 7, T, 0.12)[1]
    unit = np.array([RAD, 1.0, 1.0])
    y[4] += 15.0 * unit
    y[9, 1] -= 30.0
    y[11:13] += 40.0 * unit
    y[16:] += np.array([9.0, -12.0, 14.0]) * unit
    y[7] = y[19] = np.nan
    return y


Y = troubled()
GONE = np.flatnonzero(np.all(np.isnan(Y), axis=1))


def line(scale=1.0) -> Model:
    """The system, its measurement noise so many times as large."""
    model = SYSTEM.model()
    (sensor,) = model.sensors
    return Model(model.motion, (Sensor(sensor.read, scale * sensor.noise, M),))


def _turn(F, x, u):
    return {"heading": x["heading"].retract(F[:1, 1:] @ x["rest"]), "rest": F[1:, 1:] @ x["rest"]}


def _look(H, x, aux):
    return x["heading"], H[1:, 1:] @ x["rest"]


# The same with the heading on its circle, and measurements that cross the seam.
CIRCLE = Model(
    Motion(Partial(_turn, jnp.array(SYSTEM.F)), jnp.array(SYSTEM.G)),
    (Sensor(Partial(_look, jnp.array(SYSTEM.H)), jnp.array(SYSTEM.W), M),),
)
SEAM = np.pi - np.nanmedian(Y[:, 0])
AROUND = (Angle(jnp.asarray((Y[:, 0] + SEAM + np.pi) % (2 * np.pi) - np.pi)), jnp.asarray(Y[:, 1:]))
FACING = Belief(
    {"heading": Angle(SEAM + START.mean[0]), "rest": START.mean[1:]}, factor=START.factor
)


def seen(residual, accepted=(True, True), deficit=None) -> Observation:
    """An observation of two components: H P H' + Omega has diagonal 5.25 and 2, R 4 and 2."""
    return Observation(
        sensor="y",
        prior=START,
        residual=jnp.array(residual),
        present=jnp.array([True, True]),
        accepted=jnp.array(accepted),
        spread=jnp.array([[1.0, 0.0, 2.0, 0.0], [0.0, 1.0, 0.0, 0.0]]),
        excess=jnp.array([[0.5], [1.0]]),
        noise=jnp.array([[2.0, 0.0], [1.0, 1.0]]),
        size=jnp.ones(2),
        deficit=deficit,
    )


# ---------------------------------------------------------------------------------------- the rules

SEEN = SYSTEM.H
L = np.array([[100.0, 0.5, 0.0, -0.3], [0.0, 2.0, 1.0, 0.0]])
ROW = np.array([[0.0, 1.0, 0.5, 0.0]])

RULES = {
    "gate": gate(),
    "huber": huber(),
    "igg3": igg3(),
    "student_t": student_t(),
    "correntropy": correntropy(),
    "sage_husa": sage_husa(),
    "innovation_fading": innovation_fading(),
    "fading_memory": fading_memory(1.02),
    "variational_bayes": variational_bayes(),
    "strong_tracking outside": strong_tracking(form="outside"),
    "strong_tracking lumped": strong_tracking(form="lumped"),
    "strong_tracking multiple": strong_tracking(form="multiple"),
    "strong_tracking projected": strong_tracking(form="projected"),
    "discriminator": discriminator(),
    "h_infinity": h_infinity(20.0, jnp.eye(N)),  # which what strong tracking inflates allows too
    "adaptive_h_infinity": adaptive_h_infinity(jnp.eye(N)[:2]),
    "equality": equality(jnp.array([[1.0, 0.0, 1.0, 0.0]]), jnp.array([0.5])),
    "inequality": inequality(jnp.array([[1.0, 0.0, 0.0, 0.0]]), [-10.0], [10.0]),
    "consider": consider([3]),
    "projection": projection("y"),
    "constant_gain": constant_gain({"y": 0.3 * SEEN.T}),
    "channel_inflation": channel_inflation(0.5, SEEN.T),
    "gate only": only("y", gate()),
}
SILENT = {"consider"}  # says nothing that StepInfo does not say

# Limits that are the Kalman filter bit for bit, on whatever data.
OFF = {
    "huber by probability": huber(1),
    "huber": huber(threshold=math.inf),
    "igg3": igg3(1e9, 2e9),
    "igg3 for ever": igg3(1e9, 2e9, patience=None),
    "student_t of both": student_t(math.inf, whose="both"),
    "student_t": student_t(math.inf),
    "correntropy": correntropy(math.inf),
    "sage_husa": sage_husa(0.9, "QR", 1.0, 1.0),
    "variational_bayes": variational_bayes(0.9, 2, 5.0, 1.0, 1.0),
    "fading_memory": fading_memory(1),
    "innovation_fading": innovation_fading(limit=1),
    "strong_tracking outside": strong_tracking(threshold=math.inf),
    "strong_tracking multiple": strong_tracking(threshold=math.inf, form="multiple"),
    "strong_tracking projected": strong_tracking(threshold=math.inf, form="projected"),
    "discriminator": discriminator(probability=1, threshold=math.inf),
    "consider, by index": consider([]),
    "consider, by mask": consider(np.zeros(N, bool)),
    "channel_inflation": channel_inflation(0, SEEN.T),
    "h_infinity": h_infinity(math.inf, L),
    "adaptive_h_infinity": adaptive_h_infinity(L, floor=math.inf, ceiling=math.inf),
    "adaptive_h_infinity, patent": adaptive_h_infinity(
        L, floor=math.inf, ceiling=math.inf, compensate_first=True
    ),
}
# And those that are it to rounding.
NEARLY_OFF = {
    "equality": equality(ROW, [0.3], noise=np.array([1e12])),
    "inequality, active set": inequality(ROW, [-math.inf], [math.inf]),
    "inequality, truncation": inequality(ROW, [-math.inf], [math.inf], "truncation"),
}
# What a rule notes that has nothing to do.
QUIET = {
    "huber.weight": 1.0,
    "igg3.weight": 1.0,
    "igg3.recovered": 0.0,
    "student_t.weight": 1.0,
    "student_t.prior": 1.0,
    "correntropy.weight": 1.0,
    "innovation_fading.lambda": 1.0,
    "strong_tracking.lambda": 1.0,
    "discriminator.state": 0.0,
    "discriminator.weight": 1.0,
    "discriminator.lambda": 1.0,
    "gate.recovered": 0.0,
}
QUIET_WHEN_OFF = QUIET | {"channel_inflation.lambda": 0.0, "h_infinity.gamma": math.inf}

# Filters in which each rule acts on `Y`; no rule is left out.
ACTING = {
    "robust": [
        *(fading_memory(1.05), innovation_fading(2, 50.0), consider([3])),
        *(huber(), correntropy()),
    ],
    "gated": [gate(0.999, 2, "reinitialise"), student_t(whose="both"), strong_tracking(0.9)],
    "learning": [sage_husa(0.9, "QR", 0.01, 100.0), variational_bayes(0.9)],
    "strong tracking, multiple": [
        strong_tracking(0.9, form="multiple", weights=[2.0, 1.0, 1.6, 0.5])
    ],
    "discriminating": [discriminator(2, 0.999, 0.9, limit=20.0), channel_inflation(0.5, SEEN.T)],
    "h_infinity": [igg3(patience=2), h_infinity(300.0, L)],
    "adaptive_h_infinity": [adaptive_h_infinity(L, window=4)],
    "given": [only("y", gate(0.999, 2)), constant_gain({"y": 0.3 * SEEN.T})],
}


def plain(x):
    """The state as one vector, on the line or on the circle."""
    return jnp.concatenate([jnp.atleast_1d(leaf) for leaf in jax.tree.leaves(x)])


# These hold what they promise after each update, measured or not.
HOLDING = {
    "bounded": [
        equality(lambda x: plain(x)[3], jnp.array(0.5), noise=[0.3]),
        inequality(lambda x: jnp.asarray(ROW) @ plain(x), [-1.0], [1.0], "truncation"),
    ]
}
# `local_bound` has no derivative, by its docstring, and this rule follows it at every step.
NO_SLOPE = {"adaptive_h_infinity"}
# What a sensor teaches these is known by component.
LEARNING = [sage_husa(adapt="R"), variational_bayes(), innovation_fading()]

# --------------------------------------------------------------------------- failing, and returning

ABSURD = 1e30
TWO = [[1.0, 0.0], [1.0, 0.0]]
FIRST = TWO[:1]
# A rule, standard deviations of a state (0, 0), a reading of its second component, and the code.
FAILING = {
    "equality": (equality(FIRST, [5.0]), (0, 1), 0.5, Code.CONTRADICTED),
    "equality of a function": (
        equality(lambda x: x[:1], jnp.array([5.0])),
        (0, 1),
        math.nan,
        Code.CONTRADICTED,
    ),
    "equality by a metric": (
        equality(FIRST, [5.0], np.eye(2)),
        (0, 1),
        0.5,
        Code.CONTRADICTED,
    ),
    "equality refused": (equality(FIRST, [99.0], gate=0.99), (1, 1), 0.5, Code.PARTLY_MISSING),
    "inequality": (inequality(TWO, [2, -math.inf], [math.inf, 1]), (1, 1), 0.5, Code.CONTRADICTED),
    "truncation": (
        inequality(TWO, [2, -math.inf], [math.inf, 1], "truncation"),
        (1, 1),
        0.5,
        Code.CONTRADICTED,
    ),
    "inequality of the known": (inequality(FIRST, [2.0]), (0, 1), 0.5, Code.CONTRADICTED),
    "truncation of the known": (
        inequality(FIRST, [2.0], None, "truncation"),
        (0, 1),
        0.5,
        Code.CONTRADICTED,
    ),
    "projection": (projection("y"), (1, 0), 5.0, Code.CONTRADICTED),
    "gate": (gate(), (1, 1), ABSURD, Code.REFUSED),
    "huber": (huber(), (1, 1), ABSURD, Code.REFUSED),
    "student_t": (student_t(), (1, 1), ABSURD, Code.REFUSED),
    "student_t of both": (student_t(whose="both"), (1, 1), ABSURD, Code.REFUSED),
    "correntropy": (correntropy(), (1, 1), ABSURD, Code.REFUSED),
    "igg3": (igg3(), (1, 1), ABSURD, Code.REFUSED),
    "discriminator": (discriminator(), (1, 1), ABSURD, Code.REFUSED),
}
# Filters that must come back from a jump of the state, and how many refusals in a row they keep.
RETURNING = {
    "gate": (kalman(rules=[gate()]), 10),
    "gate by component": (kalman(rules=[gate(scope="component")]), 10),
    "igg3": (kalman(rules=[igg3()]), 10),
    "huber": (kalman(rules=[huber()]), 30),
    "student_t": (kalman(rules=[student_t()]), 30),
    "correntropy": (kalman(rules=[correntropy()]), 30),
    "discriminator": (kalman(rules=[discriminator()]), 29),
    "discriminator that refuses": (kalman(rules=[discriminator(robust="gate")]), 29),
    "adaptive": (adaptive(), 30),
}

# ------------------------------------------------------------------------------------------ misused

NAN, INF = math.nan, math.inf
BASE = {
    h_infinity: {"gamma": 50.0, "weight": L},
    adaptive_h_infinity: {"weight": L},
    channel_inflation: {"lambda_": 1.0, "B": SEEN.T},
    inequality: {"g": np.eye(1, N)},
}
HALF, QUARTER = [[1.0, 0.0]], np.deg2rad(90.0)
# A rule, what is wrong in its arguments, and the words of the refusal.
MISUSED = [
    (gate, {"probability": 0.0}, "gate probability must lie between 0 and 1, got 0.0"),
    (gate, {"probability": 1.0}, "gate probability must"),
    (gate, {"probability": NAN}, "gate probability must"),
    (gate, {"patience": -1}, "gate patience must be at least 0 to inflate, got -1"),
    (gate, {"patience": 0, "recovery": "reinitialise"}, "gate patience must be at least 1"),
    (gate, {"recovery": "hope"}, "gate recovery must be .*'inflate' or .*, got 'hope'"),
    (gate, {"scope": "half"}, "gate scope must be 'joint' or 'component', got 'half'"),
    (huber, {"probability": 0.0}, r"huber probability must lie in \(0, 1\], got 0.0"),
    (huber, {"probability": 1.1}, "huber probability"),
    (huber, {"probability": NAN}, "huber probability"),
    (huber, {"threshold": 0.0}, "huber threshold must be positive, got 0.0"),
    (huber, {"patience": -1}, "huber patience must not be negative, got -1"),
    (student_t, {"patience": -1}, "student_t patience must not be negative, got -1"),
    (correntropy, {"patience": -1}, "correntropy patience must not be negative, got -1"),
    (igg3, {"k0": 4.0}, "igg3 needs 0 < k0 < k1 < inf, got k0 = 4.0, k1 = 4.0"),
    (igg3, {"k0": 0.0}, "igg3 needs"),
    (igg3, {"k1": INF}, "igg3 needs"),
    (igg3, {"floor": 1.0}, r"igg3 floor must lie in \[0, 1\), got 1.0"),
    (igg3, {"patience": -1}, "igg3 patience must not be negative, got -1"),
    (student_t, {"dof": 0.0}, "student_t dof must be positive, got 0.0"),
    (student_t, {"dof": NAN}, "student_t dof"),
    (student_t, {"iterations": 0}, "student_t iterations must be at least 1, got 0"),
    (student_t, {"whose": "Q"}, "student_t whose must be 'R' or 'both', got 'Q'"),
    (correntropy, {"kernel": 0.0}, "correntropy kernel must be positive, got 0.0"),
    (correntropy, {"kernel": NAN}, "correntropy kernel"),
    (correntropy, {"iterations": 0}, "correntropy iterations must be at least 1"),
    (innovation_fading, {"window": 0}, "innovation_fading window must be 1 sample or more, got 0"),
    (innovation_fading, {"limit": 0.5}, "innovation_fading limit must be finite and not"),
    (innovation_fading, {"limit": INF}, "innovation_fading limit must"),
    (innovation_fading, {"limit": NAN}, "innovation_fading limit must"),
    (fading_memory, {"factor": 0.99}, "fading_memory factor must be finite and not below 1"),
    (fading_memory, {"factor": INF}, "fading_memory factor must"),
    (fading_memory, {"factor": NAN}, "fading_memory factor must"),
    (per_step, {"memory_s": 0.0, "step_s": 1.0}, "fading_memory memory_s must be positive"),
    (
        per_step,
        {"memory_s": 1.0, "step_s": 0.0},
        "fading_memory step_s must be positive and finite",
    ),
    (innovation_fading, {"reach": 0.5}, "innovation_fading reach must be at least 1, got"),
    (innovation_fading, {"reach": NAN}, "innovation_fading reach must"),
    (sage_husa, {"forgetting": 0.0}, r"sage_husa forgetting must lie in \(0, 1\], got 0.0"),
    (sage_husa, {"forgetting": NAN}, "sage_husa forgetting must"),
    (sage_husa, {"forgetting": 1.1}, "sage_husa forgetting must"),
    (sage_husa, {"floor": 0.0}, r"sage_husa floor must lie in \(0, 1\], got 0.0"),
    (sage_husa, {"floor": 1.5}, "sage_husa floor must"),
    (sage_husa, {"ceiling": 0.9}, "sage_husa ceiling must be finite and not below 1"),
    (sage_husa, {"ceiling": INF}, "sage_husa ceiling must"),
    (sage_husa, {"adapt": "P"}, "sage_husa adapt must be 'R', 'Q' or 'QR', got 'P'"),
    (variational_bayes, {"forgetting": 0.0}, "variational_bayes forgetting must"),
    (variational_bayes, {"iterations": 0}, "variational_bayes iterations must be 1 or more"),
    (variational_bayes, {"initial_dof": 0.0}, "variational_bayes initial_dof must be pos"),
    (variational_bayes, {"initial_dof": INF}, "variational_bayes initial_dof must"),
    (variational_bayes, {"floor": -1.0}, "variational_bayes floor must"),
    (variational_bayes, {"ceiling": 0.5}, "variational_bayes ceiling must"),
    (strong_tracking, {"rho": 0.0}, "rho"),
    (strong_tracking, {"rho": 1.1}, "rho"),
    (strong_tracking, {"beta": 0.9}, "beta"),
    (strong_tracking, {"threshold": -1.0}, "threshold"),
    (strong_tracking, {"limit": 0.5}, "limit"),
    (strong_tracking, {"limit": INF}, "limit"),
    (strong_tracking, {"weights": [1.0, 1.0]}, "'multiple'"),
    (strong_tracking, {"form": "multiple", "weights": [1.0, -1.0]}, "weights"),
    (strong_tracking, {"form": "multiple", "weights": [0.0, 0.0]}, "weights"),
    (strong_tracking, {"form": "multiple", "weights": [1.0, 1.0]}, "2, the state has 4"),
    (discriminator, {"patience": 0}, "patience"),
    (discriminator, {"probability": 0.0}, "probability"),
    (discriminator, {"probability": 1.1}, "probability"),
    (discriminator, {"rho": 0.0}, "rho"),
    (discriminator, {"threshold": -1.0}, "threshold"),
    (discriminator, {"limit": 0.5}, "limit"),
    (discriminator, {"weights": [1.0, 1.0]}, "'multiple'"),
    (discriminator, {"fade": "multiple", "weights": [0.0, 0.0]}, "weights"),
    (h_infinity, {"gamma": 0.0}, "gamma must be positive"),
    (h_infinity, {"gamma": -1.0}, "gamma must be positive"),
    (h_infinity, {"gamma": NAN}, "gamma must be positive"),
    (h_infinity, {"gamma": 1e-310}, "gamma must be positive"),
    (h_infinity, {"weight": np.array([1.0, NAN])}, "not finite"),
    (h_infinity, {"weight": np.zeros((2, 4))}, "no error would count"),
    (h_infinity, {"weight": 1.0}, r"has shape \(\)"),
    (h_infinity, {"weight": np.ones((1, 2, 4))}, r"has shape \(1, 2, 4\)"),
    (h_infinity, {"weight": np.eye(3)}, "weight has 3 columns, the state has 4 components"),
    (h_infinity, {"margin": 0.0}, "margin must lie between 0 and 1"),
    (h_infinity, {"margin": 1.0}, "margin must lie between 0 and 1"),
    (h_infinity, {"policy": "ignore"}, "policy must be 'raise', "),
    (h_infinity, {"estimate": "smoothed"}, "estimate must be 'a-posteriori', "),
    (h_infinity, {"estimate": "a-priori", "policy": "compensate"}, "use 'raise_gamma'"),
    (adaptive_h_infinity, {"zeta": 0.0}, "zeta must be positive"),
    (adaptive_h_infinity, {"zeta": NAN}, "zeta must be positive"),
    (adaptive_h_infinity, {"window": 0}, "window must be at least one"),
    (adaptive_h_infinity, {"floor": 1.0}, "1 < floor <= ceiling"),
    (adaptive_h_infinity, {"floor": NAN}, "1 < floor <= ceiling"),
    (adaptive_h_infinity, {"ceiling": 1.01}, "1 < floor <= ceiling"),
    (adaptive_h_infinity, {"weight": np.zeros(4)}, "no error would count"),
    (adaptive_h_infinity, {"weight": np.array([1.0, INF])}, "not finite"),
    (adaptive_h_infinity, {"weight": np.eye(3)}, "weight has 3 columns, the state has 4"),
    (consider, {"states": [-1]}, "different indices"),
    (consider, {"states": [0, 0]}, "different indices"),
    (consider, {"states": [0.5]}, "different indices"),
    (consider, {"states": [[0, 1]]}, "different indices"),
    (consider, {"states": [4]}, "has state 4, the last one is 3"),
    (consider, {"states": [True, False]}, r"mask is \(2,\)"),
    (channel_inflation, {"lambda_": -1.0}, "lambda must be a number from 0 on, got -1.0"),
    (channel_inflation, {"lambda_": INF}, "got inf"),
    (channel_inflation, {"lambda_": NAN}, "got nan"),
    (channel_inflation, {"B": [0.0, 1.0]}, r"B has shape \(2,\), \(n, q\)"),
    (channel_inflation, {"B": [[NAN], [1.0]]}, "not finite"),
    (channel_inflation, {"B": np.ones((3, 1))}, r"B is \(3, 1\), the state needs \(4, q\)"),
    (channel_inflation, {"B": lambda mean: mean}, r"B is \(4,\), the state needs \(4, q\)"),
    (constant_gain, {"gains": {}}, "give at least one gain"),
    (constant_gain, {"gains": {"y": [[NAN]]}}, "gain of 'y' has entries that are not finite"),
    (constant_gain, {"gains": {"z": SEEN.T}}, r"no sensor 'z'; this model has \['y'\]"),
    (
        constant_gain,
        {"gains": {"y": np.zeros((3, 1))}},
        r"\(3, 1\), state and sensor need \(4, 3\)",
    ),
    (
        equality,
        {"g": [[1, 2, 0], [0, 1, 0], [1, 3, 0]], "d": [1, 1, 2]},
        r"rank 2 for 3 .*row 2.*leave it",
    ),
    (equality, {"g": [[1, 2], [2, 4]], "d": [1, 3]}, r"rank 1 .*row 1.*contradicts"),
    (equality, {"g": [[0.0, 0.0]], "d": [0.0]}, r"rank 0 .*row 0.*is zero"),
    (equality, {"g": [[0.0, 0.0]], "d": [1.0]}, "contradicts"),
    # as printed in the paper, at a heading of east
    (equality, {"g": np.diag([np.sin(QUARTER), np.cos(QUARTER)])}, "rank 1 .*row 1"),
    (equality, {"g": [[1.0, 0.0], [1.0, 1e-8]]}, "rank 1"),
    (
        equality,
        {"g": np.ones((3, 2)), "d": np.ones(3), "noise": [0.0, 0.1, 0.0]},
        r"rank 1 for 2 .*row 2",
    ),
    (equality, {"g": HALF, "d": [NAN]}, "d has entries"),
    (equality, {"g": [[1.0, INF]]}, "D has entries"),
    (equality, {"g": [1.0, 0.0]}, r"must be \(c, n\)"),
    (equality, {"g": HALF, "d": [1.0, 2.0]}, r"d is \(2,\)"),
    (equality, {"g": HALF, "weight": "P"}, "weight must be"),
    (equality, {"g": HALF, "weight": np.ones((2, 2))}, "positive definite"),
    (equality, {"g": HALF, "gate": 1.0}, "gate must lie"),
    (equality, {"g": lambda x: x[:1], "iterations": 0}, "iterations must be"),
    (equality, {"g": np.eye(1, 3)}, "one column for each of 4 states"),
    (equality, {"g": np.eye(1, 4), "weight": np.eye(3)}, "the state needs"),
    (equality, {"g": lambda x: x[0], "noise": np.ones(2)}, "noise of the constraint"),
    (equality, {"g": lambda x: jnp.zeros(5)}, "5 components, the state only 4"),
    (inequality, {}, "wants lower or upper"),
    (inequality, {"lower": [1.0], "upper": [0.0]}, "must not exceed"),
    (inequality, {"lower": [NAN]}, "NaN"),
    (inequality, {"lower": [INF]}, "must not exceed"),
    (inequality, {"lower": 0.0}, r"must be \(c,\)"),
    (inequality, {"lower": [0.0], "upper": [1.0, 2.0]}, "and alike"),
    (inequality, {"lower": [0.0], "method": "clip"}, "method must be 'active-set' or 'truncation'"),
    (inequality, {"lower": [0.0, 1.0]}, "a row for each bound"),
    (inequality, {"lower": [0.0], "g": [[0.0, 0.0]]}, "row 0 of D is zero"),
    (inequality, {"lower": [0.0], "g": [[NAN, 0.0]]}, "D has entries"),
    (inequality, {"lower": [0.0], "g": [[1.0]]}, "one column for each of 4 states"),
    (inequality, {"lower": [0.0, 0.0], "g": lambda x: x}, "2 bounds for 4 components"),
    (projection, {"sensors": ()}, "name at least one"),
    (projection, {"sensors": "y", "weight": "P"}, "weight must be"),
    (projection, {"sensors": "y", "weight": np.ones((4, 4))}, "positive definite"),
    (projection, {"sensors": "y", "weight": np.eye(3)}, "the state needs"),
    (only, {"sensors": (), "rule": gate()}, "name at least one"),
    (only, {"sensors": "z", "rule": gate()}, r"'gate' is for \['z'\], this filter has \['y'\]"),
]
# What is not a number is another kind of mistake.
MISTYPED = [
    (h_infinity, {"gamma": "50"}, "gamma must be one real number"),
    (h_infinity, {"gamma": np.ones(2)}, "gamma must be one real number"),
    (h_infinity, {"weight": np.ones((2, 4)) * 1j}, "real numbers are wanted"),
]
