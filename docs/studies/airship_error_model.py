"""Cost of each slip in an error model of large misalignments, against two mechanisations.

python docs/studies/airship_error_model.py

The nine error states of the airship's paper (`robins.systems.airship.error_model`), from initial
errors of 1 to 3 m/s, 1.3 and 0.6 km, 300 m, with a gyro 77 deg/h and an accelerometer 0.06 m/s^2
off. Over 20 s the model is compared with the difference of a SINS and the truth, both mechanised in
NumPy by the same RK4 steps. Reference figures are those of an independent prototype, which does not
tell the signs and axes of its errors, nor the motion: of slips the order of size is comparable.
"""

import importlib.util
import sys
from pathlib import Path

import jax
import numpy as np

HERE = Path(__file__).resolve().parent

# phi [rad], dv [m/s], position [m], by variant and misalignment
REFERENCE = {
    ("corrected", 0): "5e-16 2e-13 3e-08",
    ("corrected", 1): "9e-16 3e-13 4e-08",
    ("corrected", 2): "2e-15 5e-14 1e-08",
    ("last-cross-term", 1): "1e-08 1e-02 1e-01",
    ("swapped-rows", 1): "3e-09 2e-06 4e+01",
    ("omitted-cross-term", 1): "1e-10 5e-04 2e-03",
    ("gyro-sign", 1): "1e-02 1e+00 1e+01",
    ("small-angle", 0): "7e-06 3e-03 3e-02",
    ("small-angle", 1): "3e-04 7e+00 8e+01",
}


def helper(name: str):
    """A module of the tests."""
    path = HERE.parents[1] / "tests" / "systems" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def main() -> None:
    """Print the table."""
    mechanised = helper("two_mechanisations")
    degrees = mechanised.MISALIGNMENTS_DEG
    flown = mechanised.fly(np.radians(degrees))
    print(f"{'variant':<20}{'phi(0) [deg]':>16}{'rad     m/s     m':>23}{'reference':>23}")
    one = {slip: (slip,) for slip in mechanised.SLIPS}
    for name, slips in {"corrected": (), **one, "as printed": mechanised.AS_PRINTED}.items():
        off = np.array(mechanised.apart(flown, mechanised.model_end(flown, slips)))
        for at, phi in enumerate(degrees):
            angles = ", ".join(f"{angle:g}" for angle in phi)
            found = " ".join(f"{x:.0e}" for x in off[:, at])
            print(f"{name:<20}{angles:>16}{found:>23}{REFERENCE.get((name, at), '-'):>23}")
    print("\n" + "\n".join(f"{name}: {text}" for name, text in mechanised.SLIPS.items()))


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    main()
