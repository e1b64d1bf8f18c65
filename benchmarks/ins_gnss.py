"""INS/GNSS filtering per IMU epoch: robins in one run, as a stream and in a batch, against pyins.

The same simulated drive for both: 100 Hz IMU increments, position and velocity fixes at 1 Hz, 15
states, covariance once a second. pyins runs its feedback filter on pandas tables.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from pyins import filters, inertial_sensor, measurements, strapdown
from timing import best_of, show

from robins import scenario
from robins.campaign.monte_carlo import _kept
from robins.filters import OnlineFilter, run
from robins.systems.ins_gnss import SYSTEM, Drive, drive_dataset
from robins.systems.ins_gnss.model import POSITION, VELOCITY

BATCH = 256


def drive():
    text = SYSTEM.scenarios["drive"].read_text()
    settings = ['outages.first="1000 s"', "update.longest_block=1 s", 'gnss.lever_arm="0 m"']
    return scenario.parse(Drive, text, settings)


def pyins_run(d):
    """Run 0 of the drive through pyins, as a call."""
    log = drive_dataset(d, seed=0)
    columns = ["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
    time = log.imu.time_ns * 1e-9
    imu = pd.DataFrame(np.hstack([log.imu.gyro, log.imu.accel]), index=time, columns=columns)
    increments = strapdown.compute_increments_from_imu(imu, "increment")
    # both see fixes at the very time stamps of the IMU table
    at = time[np.searchsorted(log.imu.time_ns, log.gnss.time_ns)]
    place = np.c_[np.degrees(log.gnss.lat_rad), np.degrees(log.gnss.lon_rad), log.gnss.alt_m]
    position = pd.DataFrame(place, index=at, columns=["lat", "lon", "alt"])
    velocity = pd.DataFrame(log.gnss.v_n, index=at, columns=["VN", "VE", "VD"])
    truth = log.truth
    start = pd.Series(
        {
            "lat": np.degrees(truth.lat_rad[0]),
            "lon": np.degrees(truth.lon_rad[0]),
            "alt": truth.alt_m[0],
            **dict(zip(["VN", "VE", "VD"], truth.v_n[0], strict=True)),
            "roll": 0.0,
            "pitch": 0.0,
            "heading": np.degrees(d.place.heading),
        },
        name=time[0],
    )
    gyro = inertial_sensor.EstimationModel(
        bias_sd=d.imu.gyro_bias, noise=d.imu.gyro_noise, bias_walk=d.imu.gyro_bias_walk
    )
    accel = inertial_sensor.EstimationModel(
        bias_sd=d.imu.accel_bias, noise=d.imu.accel_noise, bias_walk=d.imu.accel_bias_walk
    )

    def go():
        return filters.run_feedback_filter(
            start,
            1.0,
            0.1,
            0.5,
            3.0,
            increments,
            gyro,
            accel,
            [measurements.Position(position, 1.2), measurements.NedVelocity(velocity, 0.06)],
            time_step=1.0,
        )

    return go, len(increments)


def main():
    d = drive()
    problem = SYSTEM.studies["drive"].problem(d, ("ekf",), 0)
    samples = int(np.sum(np.asarray(problem.simulate.args[1].blocks.dt) > 0))
    peer, peer_samples = pyins_run(d)
    case = jax.jit(problem.simulate)(jnp.asarray(0))
    cases = jax.jit(jax.vmap(problem.simulate))(jnp.arange(BATCH))
    contenders = {"pyins": peer}
    for name, contender in problem.contenders.items():
        f, model = contender.filter, contender.model

        def single(f=f, model=model):
            return run(f, model, case.start, case.y, case.u, case.aux, keep=_kept)

        batch = jax.jit(
            jax.vmap(lambda c, f=f, m=model: run(f, m, c.start, c.y, c.u, c.aux, keep=_kept).steps)
        )
        contenders[name] = single
        contenders[f"{name}, batch of {BATCH}"] = lambda g=batch: g(cases)
    seconds = best_of(contenders, rounds=2)
    per_sample = seconds["pyins"] / peer_samples
    show("pyins feedback filter", per_sample, 1.0, "IMU epoch")
    for name in problem.contenders:
        show(name, seconds[name] / samples, 1.0, "IMU epoch", per_sample)
        whole = seconds[f"{name}, batch of {BATCH}"] / BATCH
        show(f"{name}, batch of {BATCH}", whole / samples, 1.0, "IMU epoch and run", per_sample)

    ekf = problem.contenders["ekf"]
    online = OnlineFilter(ekf.filter, ekf.model, case.start)
    epoch = [jax.tree_util.tree_map(lambda x, k=k: x[k], (case.u, case.y, case.aux)) for k in (9,)]

    def stream():
        for u, y, aux in epoch * 20:
            online.predict(u)
            online.update(y[POSITION], POSITION, aux[POSITION])
            online.update(y[VELOCITY], VELOCITY, aux[VELOCITY])
        return online.belief

    one = best_of({"stream": stream})["stream"] / 20
    show("ekf streaming, block of 100 samples and 2 fixes", one, 1.0, "GNSS epoch")


if __name__ == "__main__":
    main()
