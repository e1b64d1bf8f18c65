"""Figures of merit of the satellite."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

_ARCSEC = math.pi / 648000.0


def attitude_metrics(statistics: Any) -> dict[str, Any]:
    """Of "attitude-loop": components 0 to 2 are the attitude's, body axes.

    ``attitude_rms_arcsec`` is the root sum square of the three axes of the error of attitude
    determination, pooled over epochs and runs, ``attitude_rms_spread_arcsec`` the standard
    deviation of the same figure from run to run, ``pointing_rms_arcsec`` that of where the craft
    points, whoever is to blame. Peaks are the greatest lengths of each, mean over the runs.
    """
    s = statistics
    axes = np.sqrt(np.mean(s.run_rms[:, :3] ** 2, axis=0)) / _ARCSEC
    by_run = np.linalg.norm(s.run_rms[:, :3], axis=1) / _ARCSEC
    pointing = np.linalg.norm(s.run_output_rms("pointing"), axis=1) / _ARCSEC
    out: dict[str, Any] = {
        "attitude_rms_arcsec": float(np.linalg.norm(axes)),
        "attitude_rms_spread_arcsec": float(np.std(by_run, ddof=1)) if s.runs > 1 else float("nan"),
        "pointing_rms_arcsec": float(np.sqrt(np.mean(pointing**2))),
        **{f"{a}_rms_arcsec": float(x) for a, x in zip("xyz", axes, strict=True)},
        "attitude_peak_arcsec": float(np.mean(s.norm_peaks("attitude"))) / _ARCSEC,
        "pointing_peak_arcsec": float(np.mean(s.run_output_worst("pointing"))) / _ARCSEC,
        "bias_rms_arcsec_s": float(np.linalg.norm(np.sqrt(np.mean(s.run_rms[:, 3:6] ** 2, axis=0))))
        / _ARCSEC,
    }
    blocks = s.block_anees()
    out["nees_per_dim"] = float(np.mean(blocks["attitude"][s.counted]))
    out["anees_share_inside"] = s.anees_share_inside()
    out["diverged_runs"] = s.diverged
    return out
