"""A run of any rig without lines: its parts one after the other, in one process."""

from stations import parts

from robins.bench.accounting import Latencies
from robins.bench.evaluation import RunResult
from robins.bench.run.telemetry import Telemetry


def ran_of(series, config=None):
    """The result of a run in which nothing else happened."""
    return RunResult(
        series, config, len(series.time_s), 0.0, Latencies(), {}, {}, {}, [], 0, "", False
    )


def in_order(rig, made):
    """Parts, each after those whose messages of the same step it takes."""
    done = {}
    while len(done) < len(rig.parts):
        heard = {message for name in done for message in rig.sends[name]} | {*rig.console}
        for name in rig.parts:
            now = {message for message, lag in made[name].takes.items() if lag == 0}
            if name not in done and now <= heard:
                done[name] = made[name]
    return list(done.values())


def series(
    rig, config, steps, lost=lambda name, k: False, begin=0, states=None, wrong=lambda name, k, x: x
):
    """Messages of the parts, as a bench would note them, and their last states with their inputs.

    All must be sound. A message for which ``lost(name, step)`` holds reaches nobody, but is noted;
    what others hear is ``wrong(name, step, values)``. From ``begin`` on it continues with the
    states of an earlier run, and notes nothing of the steps before.
    """
    made = in_order(rig, parts(config, rig))
    states = dict(states or {part.name: part.begin() for part in made})
    telemetry, heard = Telemetry(rig, steps, config.step_ns), states.pop("heard", {})
    for k in range(begin, steps):
        heard, before = {}, heard
        for part in made:
            inputs = {name: (heard, before)[lag].get(name) for name, lag in part.takes.items()}
            states[part.name], sent = part.act(states[part.name], k, inputs)
            for name, values in sent:
                payload = rig.wire.encode(name, values)
                assert rig.wire.unsound(name, payload) is None
                if not lost(name, k):
                    heard[name] = wrong(name, k, rig.wire.decode(name, payload))
                telemetry.observe(name, (k + 1) * config.step_ns, payload)
    return telemetry.series, {**states, "heard": heard}
