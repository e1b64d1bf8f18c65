"""A balloon that climbs, and a barometer: a first system, drawn from the model of its filters."""

import jax.numpy as jnp

import robins as rb

climb = rb.Motion(
    step=lambda x, u: jnp.array([x[0] + x[1], x[1]]),  # height [m], climb rate [m/s], after 1 s
    noise=jnp.array([0.02, 0.05]),
)
barometer = rb.Sensor(read=lambda x, aux: x[:1], noise=jnp.array([3.0]), name="barometer")

study = rb.study_from_model(
    rb.Model(climb, (barometer,)),
    start=rb.Belief.of(mean=jnp.array([100.0, 4.0]), covariance=jnp.diag(jnp.array([25.0, 1.0]))),
    filters={"kf": rb.kalman(), "huber": rb.kalman(rules=[rb.huber()])},
    steps=300,
    states={"height": "m", "climb": "m/s"},
    readings={"barometer": "m"},
)
