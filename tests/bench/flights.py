"""A run of any rig without lines: its parts one after the other, in one process."""

from robins.bench.run.telemetry import Telemetry


def flown(
    rig, kit, steps, lost=lambda name, k: False, begin=0, states=None, wrong=lambda name, k, x: x
):
    """What the parts say, as a bench would note it, and their last states.

    All must be sound. A message for which ``lost(name, step)`` holds reaches nobody, but is noted;
    what others hear is ``wrong(name, step, values)``. Parts take messages of the same step from
    those before them in the order of the rig.
    """
    parts = [rig.build[name](kit) for name in rig.parts]
    states = states or {part.name: part.begin() for part in parts}
    telemetry, heard = Telemetry(rig, steps, kit.step_ns), {}
    for k in range(begin, steps):
        heard, before = {}, heard
        for part in parts:
            inputs = {name: (heard, before)[lag].get(name) for name, lag in part.takes.items()}
            states[part.name], sent = part.act(states[part.name], k, inputs)
            for name, values in sent:
                payload = rig.wire.encode(name, values)
                assert rig.wire.unsound(name, payload) is None
                if not lost(name, k):
                    heard[name] = wrong(name, k, rig.wire.decode(name, payload))
                telemetry.observe(name, (k + 1) * kit.step_ns, payload)
    return telemetry.flown, states
