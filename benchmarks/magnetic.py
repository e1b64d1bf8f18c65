"""The magnetic field at 1e5 places and dates in one call, beside pygeomag's time per place."""

import importlib.util

import numpy as np
from timing import best_of, show

from robins.earth.magnetic import field_along, field_n, wmm

COUNT, PEERS = 100_000, 300


def main():
    rng = np.random.default_rng(0)
    lat, lon = rng.uniform(-1.57, 1.57, COUNT), rng.uniform(-np.pi, np.pi, COUNT)
    alt, year = rng.uniform(0.0, 6e5, COUNT), rng.uniform(2025.0, 2030.0, COUNT)
    time = np.arange(COUNT) * 0.01
    path = 0.7 + 1e-9 * time, 0.2 + 1e-9 * time, 1e3 + 0.0 * time, 2026.5
    model = wmm(2025)
    tasks = {
        "everywhere, field_n": lambda: field_n(model, lat, lon, alt, year),
        "everywhere, field_along": lambda: field_along(model, lat, lon, alt, year),
        "along a path at 100 Hz, knots of 1 s": lambda: field_along(model, *path, time),
    }
    if importlib.util.find_spec("pygeomag"):
        from pygeomag import GeoMag

        peer = GeoMag(base_year=2025)
        places = list(zip(np.degrees(lat), np.degrees(lon), alt / 1e3, year, strict=True))[:PEERS]
        tasks["pygeomag"] = lambda: [peer.calculate(*place) for place in places]
    best = best_of(tasks)
    beside = best.pop("pygeomag", None)
    for name, seconds in best.items():
        show(name, seconds, COUNT, "place", None if beside is None else beside / PEERS * COUNT)
    if beside is not None:
        show("pygeomag", beside, PEERS, "place")


if __name__ == "__main__":
    main()
