"""Arrays, distances and sentences in the report of a replay of INS/GNSS, besides estimates."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from robins.dataset import Dataset
from robins.earth import Geodetic
from robins.filters import Code
from robins.filters.consistency_limits import NIS_HIGH, REFUSED_SHARE
from robins.ins.state import InsState
from robins.program.scanned import mapped_rows, named_scan
from robins.results import Variables, array, variable
from robins.systems.ins_gnss import model
from robins.systems.ins_gnss.parameters import InsGnssReplay
from robins.systems.ins_gnss.recording import Log
from robins.systems.judgement import Metrics
from robins.systems.replaying import FilterEstimates
from robins.systems.tables import place_arrays

DIVERGED = "the estimate was off and took the word of positions that stayed away"
FAR = 6.0  # difference from the smoother beyond which a replay is not to be trusted [sigma]
_OTHERS = {"velocity": "gnss.velocity_sigma", "place, velocity": "gnss.sigma, gnss.velocity_sigma"}
_RANK = {1: 0, 6: 1, 2: 2, 3: 3, 4: 3, 5: 4}  # rank of a quality, by its usual sigma
RTK_QUALITY = {1: "fix", 2: "float", 3: "sbas", 4: "dgps", 5: "single", 6: "ppp"}


def sigma_notes(dataset: Dataset, parameters: InsGnssReplay) -> list[str]:
    """Sentences on sigmas of positions that are configured or assumed, not stated by the log."""
    if parameters.gnss.sigma is not None:
        shown = " ".join(f"{x:g}" for x in parameters.gnss.sigma)
        return [f"Sigmas of positions: {shown} m north, east, down, from gnss.sigma."]
    assumed = [f for f in dataset.findings if f.code == "sigma_assumed"]
    return [
        f"{one.sentence} Set {_OTHERS.get(one.where, 'gnss.sigma')} to state it." for one in assumed
    ]


def fitting_sigma(dataset: Dataset, parameters: InsGnssReplay, metrics: Metrics) -> str:
    """Setting of the sigma of positions that the NIS asks for, where it is too low; "" else.

    Only a sigma that is assumed, neither stated by the log nor configured, is replaced: by itself
    times the root of the NIS, to one digit.
    """
    key, gnss = f"nis_{model.POSITION}", dataset.gnss
    of = next((one for one in metrics.values() if key in one), None)
    if of is None or gnss is None or gnss.assumed_m is None or parameters.gnss.sigma is not None:
        return ""
    nis, assumed = of[key], gnss.sigma_m[gnss.assumed_m.all(axis=1)]
    if not len(assumed) or nis >= of[f"{key}_band"][0]:
        return ""
    fitting = np.median(assumed, axis=0) * np.sqrt(nis)
    texts = [f"{float(f'{x:.1g}'):g} m" for x in fitting]
    return f"gnss.sigma={json.dumps(texts)}"


def antenna_of(mount: model.Mount, mean: InsState, rate_b: Array | np.ndarray) -> Geodetic:
    """Estimated position of the antenna at each epoch, for comparison with fixes."""
    return named_scan(_antenna, mount, (mean, rate_b))[1]


def _antenna(mount: model.Mount, row: tuple[InsState, Array]) -> tuple[model.Mount, Geodetic]:
    return mount, model.read_position(mount, *row)


def _displacement(places: tuple[Geodetic, Geodetic]) -> Array:
    """Displacement (3,) [m, NED] from one position to another."""
    return places[0].local(places[1])


def distances(
    log: Log, used: np.ndarray, epoch_s: np.ndarray, antenna: Geodetic
) -> dict[str, float | int]:
    """Distances of the antenna from the best fixes, aided and in outages.

    The best fixes are those of the best quality among the fixes used, or all if the receiver states
    no quality.
    """
    g = log.gnss
    use = used & np.isfinite(g.lat_rad) & np.isfinite(g.alt_m)
    if g.quality is not None and np.any(use):
        rank = np.array([_RANK.get(int(q), len(_RANK)) for q in g.quality])
        use = use & (rank == np.min(rank[use]))
    epoch = np.searchsorted(epoch_s, log.gnss_s[use] - 1e-9)
    at = jax.tree_util.tree_map(lambda x: np.asarray(x)[epoch], antenna)
    fix = Geodetic(*(v[use] for v in (g.lat_rad, g.lon_rad, g.alt_m)))
    error, withheld = mapped_rows(_displacement, (fix, at)), log.withheld[use]
    across = np.hypot(error[:, 0], error[:, 1])
    out: dict[str, Any] = {
        "aided_horizontal_rms_m": _rms(across[~withheld]),
        "aided_vertical_rms_m": _rms(error[~withheld, 2]),
        "aided_fixes": int(np.sum(~withheld)),
    }
    if np.any(withheld):
        out |= {
            "outage_horizontal_rms_m": _rms(across[withheld]),
            "outage_horizontal_max_m": float(np.max(across[withheld])),
            "outage_vertical_rms_m": _rms(error[withheld, 2]),
            "outage_fixes": int(np.sum(withheld)),
        }
    return out


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2))) if x.size else float("nan")


def fix_arrays(log: Log) -> Variables:
    """Fixes of a log, on their own time axis."""
    g = log.gnss
    out: dict[str, Any] = {"gnss_time": variable("gnss_time", log.gnss_s, "s", "time of the fixes")}
    out |= place_arrays("gnss", (g.lat_rad, g.lon_rad, g.alt_m), "{} of the fixes")
    if g.quality is not None:
        known = [q for q in RTK_QUALITY if np.any(g.quality == q)]
        out |= array(
            "gnss_quality",
            g.quality.astype(np.int32),
            flag_values=np.asarray(known, dtype=np.int32),
            flag_meanings=" ".join(RTK_QUALITY[q] for q in known),
        )
    return out


def verdict(answers: Mapping[str, FilterEstimates], metrics: Metrics, doubts: list[str]) -> str:
    """One-sentence verdict on a replay, from its first causal filter; "" without one.

    "Do not trust" if sigmas are too small by a factor of two (NIS above `NIS_HIGH`), more than a
    third of the fixes was refused, the estimate diverged, or it is more than `FAR` sigmas from that
    of its smoother. "Consistent" if there is no warning and NIS is inside its 95 % band. Else
    "With care".

    Args:
        answers: estimates by filter.
        metrics: by filter, as from `robins.systems.replaying.outcome`.
        doubts: warnings, which begin with the name of a filter.
    """
    key = f"nis_{model.POSITION}"
    name = next((n for n in answers if key in metrics[n]), None)
    if name is None:
        return ""
    nis, refused = metrics[name][key], metrics[name][f"refused_{model.POSITION}"]
    low, high = metrics[name][f"{key}_band"]
    update = answers[name].updates[model.POSITION]
    spoke, unused = np.asarray(update.dof), np.asarray(update.code) == Code.REFUSED
    count = int(np.sum((spoke > 0) | unused))
    parts = [f"position NIS {nis:.2f} ({low:.2f} to {high:.2f} is consistent)"]
    parts.append(f"{refused} of {count} fixes refused")
    far = 0.0
    if (smooth := answers.get(f"{name}+rts")) is not None:
        apart = mapped_rows(_displacement, (answers[name].mean.position, smooth.mean.position))
        far = float(np.nanmax(np.abs(apart) / np.asarray(answers[name].sigma)[:, 6:9]))
        parts.append(f"at most {far:.1f} sigmas away from the smoothed path")
    own = [one for one in doubts if one.startswith(f"{name}: ")]
    if own:
        parts.append(f"{len(own)} warning{'s' * (len(own) > 1)} below")
    bad = (
        nis > NIS_HIGH
        or refused > REFUSED_SHARE * count
        or far > FAR
        or any(DIVERGED in x for x in own)
    )
    sound = low <= nis <= high and not own
    word = "Do not trust" if bad else "Consistent" if sound else "With care"
    return f"{word}: {name}, {', '.join(parts)}."
