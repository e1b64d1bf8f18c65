"""Timing that can be compared: rounds of all contenders in turn, the best round of each."""

from __future__ import annotations

import time
from collections.abc import Callable

import jax


def best_of(
    contenders: dict[str, Callable[[], object]],
    rounds: int = 5,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Seconds of the best round of each, after one call of each that may compile.

    The contenders take turns, so a machine that slows down slows all of them. Small differences
    between steps that run on one core show better by ``clock=time.process_time``.
    """
    for call in contenders.values():
        jax.block_until_ready(call())
    best = dict.fromkeys(contenders, float("inf"))
    for _ in range(rounds):
        for name, call in contenders.items():
            start = clock()
            jax.block_until_ready(call())
            best[name] = min(best[name], clock() - start)
    return best


def show(title: str, seconds: float, unit: float, label: str, peer: float | None = None) -> None:
    """One line: what, how long per unit, and how many times faster than the peer."""
    ratio = "" if peer is None else f"   {peer / seconds:8.1f} x faster than its peer"
    print(f"{title:<46}{seconds / unit * 1e6:10.3f} us per {label}{ratio}", flush=True)
