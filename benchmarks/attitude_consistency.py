"""Heading NEES of a trial, against the one that it would have if the filter were right.

    python benchmarks/attitude_consistency.py --broad FOLDER --repoimu FOLDER

The heading error of a trial changes so slowly that its mean square over its variance is nearly the
square of one draw, with a spread far beyond that of a mean of many. So the NEES of a trial is
compared with what errors drawn from the filter's own covariances give in this very trial: with
P- = L L' the predicted and P = S S' the updated covariance, errors e = S z of a filter that is
right go on by

    z_k = S_k' P-_k^-1 F S_{k-1} z_{k-1} + w,

with w that fills up to unit variance, and smoothed ones go back by

    z_k = (F S_k)' P-_{k+1}^-1 S_{k+1} z_{k+1} + w,    w of covariance 1 - (F S_k)' P-^-1 F S_k.

What no state carries (`[stated]`) is one draw a trial.

Columns: the NEES, its mean over the draws (one, if the draws are right), the share of draws with a
NEES within 0.5 to 2, and the share below the NEES of the trial. If the filter is right the last is
uniform over trials: a Kolmogorov-Smirnov test says how probable a deviation as large is. The trials
are the development trials of `attitude_board.py`. OMP_NUM_THREADS=1 makes it quicker.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from attitude_board import READERS
from scipy.stats import kstest

from robins.filters import rts_smoother, run
from robins.systems.marg import MargReplay, model_of, one_prior, prepare
from robins.systems.marg.model import HEADING
from robins.systems.marg.replay import orientation_errors, truth_at

DRAWS = 200


def left_over(M: np.ndarray) -> np.ndarray:
    """(K, n, n) roots of 1 - M' M; what is beyond one, where a rule forgot the field, is 0."""
    _, size, vt = np.linalg.svd(M)
    return np.sqrt(np.maximum(1.0 - size**2, 0.0))[:, None, :] * vt.transpose(0, 2, 1)


def drawn(steps: Any, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(count, DRAWS) heading errors, causal and smoothed [rad], as the filter thinks they are."""
    S = np.asarray(steps.posterior.factor)[:count]
    L = np.asarray(steps.prediction.belief.factor)[:count]
    spread = np.asarray(steps.prediction.transition.spread)[:count]
    known = np.linalg.pinv(L)  # gravity may be known exactly
    after, before = known @ S, known @ spread
    back = before.transpose(0, 2, 1) @ after
    fresh, fresh_back = left_over(back), left_over(before)
    z = rng.standard_normal((S.shape[1], DRAWS))
    causal, smoothed = np.empty((2, count, DRAWS))
    for k in range(count):
        if k > 0:
            z = back[k].T @ z + fresh[k] @ rng.standard_normal(z.shape)
        causal[k] = S[k, HEADING] @ z
    for k in reversed(range(count)):
        if k < count - 1:
            z = back[k + 1] @ z + fresh_back[k + 1] @ rng.standard_normal(z.shape)
        smoothed[k] = S[k, HEADING] @ z
    return causal, smoothed


def main() -> None:
    """Print a line a trial, and the tests."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    for name in ("broad", "repoimu"):
        parser.add_argument(f"--{name}", type=Path, action="append", default=[])
    given, rng, p = vars(parser.parse_args()), np.random.default_rng(0), MargReplay()
    found: dict[tuple[str, str], list[tuple[float, float, float, float]]] = {}
    print(f"| trial, way | NEES | of draws | within 0.5 to 2 | below |\n|{'---|' * 5}")
    for name, folders in given.items():
        for trial in (t for folder in folders for t in READERS[name](folder) if t.development):
            log = prepare(trial.log, p)
            w, count = log.world, len(log.rows)
            answer = run(one_prior(p), model_of(p), w.start, w.y, w.u, w.aux, machine="vm")
            beliefs = answer.steps.posterior, rts_smoother(answer, machine="vm")
            assert trial.log.attitude is not None
            true, counts = truth_at(trial.log.attitude, log.time_ns[log.rows])
            turned, lasted = (np.asarray(a) for a in (w.u.samples.angle, w.u.samples.dt_s))
            floor = np.hypot(p.stated.heading, p.stated.delay * turned / lasted)
            for way, belief, errors in zip(
                ("causal", "smoothed"), beliefs, drawn(answer.steps, count, rng), strict=True
            ):
                q = np.asarray(belief.mean.q_nb.wxyz)
                sigma = np.hypot(np.asarray(belief.sigma)[:, HEADING], floor)
                seen = (orientation_errors(q, true).heading / sigma)[counts]
                nees = float(np.mean(seen**2))
                errors = errors + floor[:, None] * rng.standard_normal(DRAWS)
                would = np.mean((errors / sigma[:, None])[counts] ** 2, axis=0)
                inside = float(np.mean((would > 0.5) & (would < 2.0)))
                row = nees, float(np.mean(would)), inside, float(np.mean(would < nees))
                found.setdefault((trial.set, way), []).append(row)
                print(f"| {trial.name}, {way} | " + " | ".join(f"{x:.2f}" for x in row) + " |")
    head = "mean NEES | within 0.5 to 2 | a filter that is right | KS distance | probability"
    print(f"\n| set, trials, way | {head} |\n|{'---|' * 6}")
    for (which, way), rows in found.items():
        nees, _, share, below = np.array(rows).T
        test = kstest(below, "uniform")
        print(
            f"| {which}, {len(rows)}, {way} | {nees.mean():.2f} | "
            f"{np.mean((nees > 0.5) & (nees < 2.0)):.2f} | {share.mean():.2f} | "
            f"{test.statistic:.2f} | {test.pvalue:.2f} |"
        )


if __name__ == "__main__":
    main()
