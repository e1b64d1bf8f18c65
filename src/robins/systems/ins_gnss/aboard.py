"""INS/GNSS filter for embedded use: a problem to test it, and the constants of its loop in C.

The C counterpart of `LiveInsGnss` is next to the rig `ins_gnss` of the bench:
`navigation_blocks.h` integrates samples and cuts them into blocks, `navigation_rest.h` detects
standstill, `navigation_start.h` finds the start, `navigation_board.c` handles epochs, late fixes
and the wire. A drive or a log gives the rates of samples and fixes, and the data on which the
filter is traced and tested.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import jax
import numpy as np

from robins.dataset import Dataset
from robins.errors import RobinsError
from robins.ins.blocks import reach_of_rate, usual_width
from robins.ins.increments import Increments
from robins.systems.ins_gnss import model
from robins.systems.ins_gnss.log import recorded
from robins.systems.ins_gnss.parameters import InsGnssReplay
from robins.systems.ins_gnss.recording import axes_of
from robins.systems.parts import ImuBlock
from robins.systems.study import Case, Problem

_EPOCHS = 64  # of the drive or log, on which the filter is traced and tested
_DELAY_S = 1.0  # largest delay of a fix, as in `LiveInsGnss`
_MOST_START_S = 600.0  # of samples kept for the start, likewise
_PATIENCE_S = 0.1  # duration of a jump of the stamps after which it is accepted, likewise
_FIELDS = {
    ("predict_input", "increments_dt"): "s, of each piece of the block; 0 for none",
    ("predict_input", "increments_theta"): "rad, FRD: turn over it against the stars",
    ("predict_input", "increments_dv"): "m/s, FRD at its beginning: specific force times time",
    ("predict_input", "noise_scale"): "of the noise: 1, more where samples are missing",
    ("update_gnss_position_reading", "lat"): "rad, of the antenna; NaN: no fix",
    ("update_gnss_position_reading", "lon"): "rad",
    ("update_gnss_position_reading", "alt"): "m, above the ellipsoid",
}


def export_sources(
    given: InsGnssReplay,
    dataset: Dataset,
    rates_hz: tuple[float, float],
    name: str,
    suspects: tuple[str, ...],
    label: str,
) -> tuple[Problem, str]:
    """Problem to test an exported filter, and the text of `navigation_given.h`.

    Args:
        given: parameters of the filter.
        dataset: the drive or the log, with fixes.
        rates_hz: of samples and fixes.
        name: of the filter.
        suspects: instruments in the order of the wire.
        label: of the drive or log, for errors.

    Raises:
        RobinsError: the log cannot be navigated, or the loop in C lacks a required feature.
    """
    _refuse_what_c_lacks(given, dataset)
    # as for a live filter, which cannot find the share from the log
    gnss = given.gnss.model_copy(update={"lasting_share": 0.0})
    given = given.model_copy(update={"gnss": gnss})
    try:
        pieces, contender = recorded(dataset, given)
    except ValueError as error:
        raise RobinsError(f"it cannot be navigated: {error}", label) from error
    piece = pieces[0]
    usual = usual_width(given.update.longest_block, 1.0 / rates_hz[0]) + 8
    world = _first_epochs(piece.world, usual)
    chosen = contender(name)
    problem = Problem(
        epoch_s=piece.epoch_s[:_EPOCHS],
        blocks=model.state_blocks(given.imu.scale_states),
        sensors=model.SENSORS,
        simulate=lambda run: world,
        contenders={name: chosen},
        claims=lambda metrics: [],
        fields=_FIELDS,
    )
    wide = not hasattr(chosen.case(world).start.mean, "q_nb")
    macros = {
        "MEAN(field)": f"mean_{'ins_' if wide else ''}##field",
        "REPORT_WRONG(result, to)": _wrong_to_wire(chosen.filter.suspects, suspects),
    }
    return problem, _given_h(given, rates_hz, world, macros)


def _refuse_what_c_lacks(given: InsGnssReplay, dataset: Dataset) -> None:
    """Refuse parameters and logs that the loop in C does not support.

    Raises:
        RobinsError: one is not supported.
    """
    g = given.gnss
    lacks = (
        (
            given.start.known_heading is not None,
            "start.known_heading is given, and the loop in C takes the heading from the course",
            "leave it out",
        ),
        (
            dataset.gnss is not None and dataset.gnss.v_n is None,
            "the loop in C begins by velocities, and the receiver of this log states none",
            "take a log with velocities",
        ),
        (
            g.sigma is not None or g.velocity_sigma is not None,
            "gnss.sigma or gnss.velocity_sigma is set, and the loop in C has those of the fixes",
            "leave them out",
        ),
        (
            bool(g.lasting_share),
            "gnss.lasting_share is set, and the start in C has no errors that last",
            "leave it out",
        ),
        (
            given.aids.non_holonomic,
            "aids.non_holonomic is set, and the loop in C knows no road",
            "--set aids.non_holonomic=false, here and on the bench",
        ),
    )
    for there, what, mend in lacks:
        if there:
            raise RobinsError(what, "--board", mend)


_SENSORS = (model.POSITION, model.VELOCITY, model.STANDSTILL, model.STILL_RATE)


def _first_epochs(world: Case, width: int) -> Case:
    """First epochs of a piece, in blocks of `width` increments, with the sensors on the wire."""
    heard = {name: world.y[name] for name in _SENSORS if name in world.y}
    about = {name: world.aux[name] for name in heard if name in world.aux}
    rows = world._replace(start=(), y=heard, aux=about)
    first: Case = jax.tree_util.tree_map(lambda a: np.asarray(a)[:_EPOCHS], rows)
    inc = first.u.increments
    if np.any(inc.dt[:, width:] > 0.0):
        what = f"a block of the first {_EPOCHS} holds more than {width} samples: stamps in bursts"
        raise RobinsError(what, "--board", "give a log whose samples come evenly at its beginning")
    more = max(0, width - inc.dt.shape[1])
    padded = (np.pad(a, [(0, 0), (0, more), (0, 0)][: a.ndim])[:, :width] for a in inc[:3])
    return first._replace(start=world.start, u=ImuBlock(Increments(*padded), first.u.noise_scale))


def _wrong_to_wire(suspects: tuple[str, ...], wire: tuple[str, ...]) -> str:
    """C expression that copies the probabilities of a result in the order of the wire."""
    where = {name: f"(result).wrong[{i}]" for i, name in enumerate(suspects)}
    return ", ".join(f"(to)[{k}] = {where.get(one, 'NAN')}" for k, one in enumerate(wire))


def _given_h(
    given: InsGnssReplay, rates_hz: tuple[float, float], world: Case, macros: Mapping[str, str]
) -> str:
    """Text of `navigation_given.h`: constants of the part, and sizes of its buffers."""
    g, aids, longest_s = given.gnss, given.aids, given.update.longest_block
    sample_s, fix_s = (1.0 / rate for rate in rates_hz)
    window_s = fix_s if g.velocity_window is None else g.velocity_window
    reach_s = reach_of_rate(sample_s)
    epochs = math.ceil(_DELAY_S / min(longest_s, fix_s))
    defined = {
        "SAMPLE_S": sample_s,
        "REACH_S": reach_s,  # half width about an epoch over which rates are averaged
        "LONGEST_S": longest_s,
        "LONGEST_GAP_NS": f"{round(1e9 * given.update.longest_gap)}LL",
        "PATIENCE": max(3, round(_PATIENCE_S * rates_hz[0])),
        "GAP_NOISE": given.update.gap_noise,
        "DELAY_S": _DELAY_S,
        "BACK_S": _DELAY_S + 2.0 * reach_s + max(window_s, 1.5),
        "WINDOW_S": window_s,
        "LATENCY_S": g.latency,
        "LEVER_ARM": ", ".join(map(repr, g.lever_arm)),
        "LEAST_SIGMA": g.least_sigma,
        "LEAST_VELOCITY_SIGMA": g.least_velocity_sigma,
        "TILT": given.start.tilt,
        "START_POSITION": given.start.position,
        "COURSE_SPEED": given.start.course_speed,
        "MOVING_SPEED": aids.moving_speed,
        "QUIET_RATE": aids.quiet_rate,
        "QUIET_ACCEL": aids.quiet_accel,
        "REST_WIDTH": max(2, round(aids.window / sample_s)),
        "LEVEL_WIDTH": max(2, round(2.0 * aids.window / sample_s)),
        "WAIT_S": 1.5 * max(1.0, fix_s),  # validity of a fix as evidence of motion or rest
        "MOST_START_S": _MOST_START_S,
        "STEPS": math.ceil(1.1 * _MOST_START_S / sample_s),
        "FIXES": math.ceil(1.1 * _MOST_START_S / fix_s) + 64,
        "PAST": 4 * epochs + 16,
        "PIECES": world.u.increments.dt.shape[1],
        "VELOCITIES": int(model.VELOCITY in world.y),
        "REST": int(model.STANDSTILL in world.y),
        **macros,
    }
    axes = (", ".join(map(repr, row)) for row in axes_of(given.imu.orientation).tolist())
    rows = ", ".join(f"{{{row}}}" for row in axes)
    lines = [
        "/* What the part was told when it was exported: s, m, m/s; sizes of what it keeps. */",
        "#ifndef NAVIGATION_GIVEN_H\n#define NAVIGATION_GIVEN_H",
        *(f"#define {name} {value}" for name, value in defined.items()),
        "/* from the axes of the unit to forward-right-down */",
        f"static const double C_BS[3][3] = {{{rows}}};",
        "/* by which the sigmas of a fix of this quality are multiplied */",
        "static inline double factor_of(int quality) {",
        "  switch (quality) {",
        *(f"    case {int(k)}: return {v!r};" for k, v in sorted(g.sigma_factor.items())),
        "    default: return 1.0;",
        "  }\n}\n#endif\n",
    ]
    return "\n".join(lines)
