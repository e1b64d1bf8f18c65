"""Guarantee of an H-infinity filter, found without its Riccati equation.

python docs/studies/worst_case_gain.py [picture]

Attitude matching of a slave inertial unit with its master, nine states, weights R = I and L = I
(`robins.systems.transfer_alignment.attitude_matching.model`). Three forms of the filter against
each other, the gain that the worst disturbances have against the gamma asked for, and the least
gamma in three units of angle: the same filter of the same aircraft is harmless in one and
impossible in another. Reference values are those of an independent prototype.
"""

import importlib.util
import sys
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

from robins.filters import kalman, run
from robins.filters.analysis.worst_case import gamma_min, worst_case_gain
from robins.filters.rules.h_infinity import Infeasible, h_infinity, with_gamma

HERE = Path(__file__).resolve().parent


def helper(name: str):
    """A module of the tests."""
    path = HERE.parents[1] / "tests" / "filters" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


matching, dense = helper("attitude_matching"), helper("dense_h_infinity")
WEIGHT = np.eye(9)
FILTER = kalman(rules=[h_infinity(np.inf, WEIGHT)])


def row(what: str, found: str, reference: str) -> None:
    """A line of the table."""
    print(f"{what:<58} {found:>14} {reference:>14}")


def filtered(unit: str, gamma: float, steps: int = 400):
    """A run, and what its worst-case gain wants to know of it."""
    model, start, F, aux = matching.run_with(matching.in_unit(unit, steps))
    one = with_gamma(FILTER, gamma)
    return model, start, run(one, model, start, np.zeros((steps, 3)), F, aux), F, aux


def least(unit: str, steps: int = 400, P0: str = "physical", rtol: float = 1e-6) -> float:
    """gamma_min."""
    model, start, F, aux = matching.run_with(matching.in_unit(unit, steps, P0))
    return gamma_min(model, start, np.zeros((steps, 3)), WEIGHT, F, aux, rtol=rtol)


def gain(unit: str, gamma: float, steps: int) -> float:
    """Worst-case gain of the filter for this gamma."""
    model, start, solution, F, aux = filtered(unit, gamma, steps)
    return worst_case_gain(model, start, solution, WEIGHT, F, aux)


def three_forms(gamma: float) -> float:
    """Largest difference of the Riccati variables, in standard deviations."""
    s = matching.in_unit("deg")
    ours = np.asarray(filtered("deg", gamma)[2].steps.prediction.belief.covariance)
    joseph, krein = (
        form(s.F, s.G @ s.G.T, s.H, np.eye(3), np.diag(s.sigma**2), WEIGHT, gamma)
        for form in (dense.joseph_riccati, dense.krein_riccati)
    )
    sigma = np.sqrt(np.diagonal(joseph, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    return max(float(np.max(np.abs(a - b) / scale)) for a, b in ((ours, joseph), (ours, krein)))


def draw(steps: int, smallest: float, target: Path) -> None:
    """Worst-case gain over gamma, and the local bound along the run."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 4.0), layout="constrained")
    shares = np.concatenate([[1.0001], np.geomspace(1.01, 6.0, 9)])
    gains = np.array([gain("deg", share * smallest, steps) for share in shares]) / smallest
    kalman_gain = gain("deg", np.inf, steps) / smallest
    left.plot(shares, gains, "o-", label="H-infinity filter")
    left.plot(shares, shares, "k:", label="gamma itself")
    left.axhline(kalman_gain, color="tab:red", ls="--", label="Kalman filter")
    left.set(xlim=(0.9, 6.1), ylim=(0.998, 1.5 * kalman_gain - 0.5))
    left.set(xlabel="gamma / gamma_min", ylabel="worst-case gain / gamma_min")
    left.set_title(f"{steps} updates, degrees, R = I, L = I")
    left.legend()
    time_s = matching.PERIOD_S * np.arange(1, 401)
    for unit, colour in (("deg", "tab:blue"), ("arcmin", "tab:orange")):
        over_all = least(unit)
        for share, style in ((np.inf, "-"), (1.0001, "--")):
            notes = filtered(unit, share * over_all)[2].steps.info["attitude_matching"].notes
            label = f"{unit}, " + ("Kalman" if share == np.inf else "gamma_min")
            bound = notes["h_infinity.bound"] / over_all
            right.plot(time_s, bound, style, color=colour, label=label)
    right.set(xlabel="time [s]", ylabel="local bound / gamma_min", ylim=(0.0, None))
    right.set_title("what gamma must exceed, 400 updates")
    right.legend(loc=(0.14, 0.68), fontsize="small")
    figure.savefig(target, dpi=110)
    print(f"wrote {target.name}")


def main(picture: Path) -> None:
    """Print the table, save the picture."""
    print(f"{'':<58} {'here':>14} {'reference':>14}")
    smallest = least("deg", 80, rtol=1e-8)
    row("gamma_min, 80 updates [deg]", f"{smallest:.5f}", "3.18570")
    for share, reference in ((1.0001, "1.0000003"), (1.5, "1.0163"), (np.inf, "1.0216")):
        ratio = f"{gain('deg', share * smallest, 80) / smallest:.7f}"
        row(f"worst-case gain / gamma_min at gamma = {share:g} gamma_min", ratio, reference)
    arcmin = least("arcmin", 400)
    kalman_gain = gain("arcmin", np.inf, 400)
    row("Kalman filter over 400 updates [arcmin]", f"{kalman_gain:.3f}", "111.560")
    for unit, digits, physical, identity in (
        ("rad", 3, "0.172", "15.71"),
        ("deg", 3, "4.656", "15.71"),
        ("arcmin", 2, "100.69", "15.84"),
    ):
        value = arcmin if unit == "arcmin" else least(unit)
        row(f"gamma_min, 400 updates, physical P0 [{unit}]", f"{value:.{digits}f}", physical)
        value = least(unit, P0="identity")
        row(f"gamma_min, 400 updates, P0 = I [{unit}]", f"{value:.2f}", identity)
    row("three forms over 400 updates, scaled", f"{three_forms(1.05 * least('deg')):.0e}", "9e-14")
    try:
        filtered("arcmin", 50.0)
    except Infeasible as error:
        row("gamma = 50 [arcmin] refused at update", str(error.step + 1), "6")
    draw(80, smallest, picture)


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    plt.switch_backend("agg")
    given = Path(sys.argv[1]) if len(sys.argv) > 1 else None
    main(given or HERE.parent / "pictures" / "worst_case_gain.png")
