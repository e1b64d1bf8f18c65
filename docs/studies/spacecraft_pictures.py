"""A picture of a spacecraft over one orbit: attitude, momenta of the wheels, dipoles.

python docs/studies/spacecraft_pictures.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from robins.rotation import conjugate, from_rotvec, multiply, rotate, to_euler
from robins.sim.attitude_control import (
    allocate,
    allocation_matrix,
    controller,
    desaturation_dipole,
    torque,
)
from robins.sim.attitude_reference import nadir, slews
from robins.sim.orbit import circular_orbit, field_along_orbit
from robins.sim.spacecraft import advance, craft_state, rate_b, spacecraft, wheel_momentum_b

PICTURES = Path(__file__).resolve().parents[1] / "pictures"
COLOURS = ("#d55e00", "#0072b2", "#009e73", "#777777")
DT = 0.1
COUNT = 56_770  # one turn

INERTIA = np.array([[1.9, 0.02, -0.03], [0.02, 2.1, 0.01], [-0.03, 0.01, 2.4]])
DIAGONAL = 3**-0.5
AXES = np.column_stack([np.eye(3), np.full(3, DIAGONAL)])


def one_orbit() -> dict[str, np.ndarray]:
    """Pointing down with a roll from side to side, started 10 deg off with wheels that spin."""
    craft = spacecraft(INERTIA, AXES, 5e-3, 0.1, 5.0, [0.05, -0.03, 0.04])
    gains, pinv = controller(INERTIA), jnp.asarray(allocation_matrix(AXES))
    time = DT * np.arange(COUNT)
    orbit = circular_orbit(500e3, np.radians(97.4), 0.3, 0.1, time)
    down = nadir(orbit)
    wanted = slews(down, np.radians([20.0, 0.0, 0.0]), 1200.0, time, fade_in_s=1200.0)
    begin = multiply(down.q_ib[0], from_rotvec(jnp.radians(jnp.array([6.0, -5.0, 6.0]))))
    start = craft_state(craft, begin, down.omega_b[0], 0.02)

    def step(state: Any, given: Any) -> Any:
        q_ref, omega_ref, alpha_ref, place, field = given
        held = wheel_momentum_b(craft, state.wheel_h)
        field_b = rotate(conjugate(state.q_ib), field)
        dipole = desaturation_dipole(gains.desaturation_k, held, field_b, craft.dipole_limit_a_m2)
        rate = rate_b(craft, state)
        asked = torque(gains, state.q_ib, rate, q_ref, omega_ref, alpha_ref, held)
        wheels = allocate(pinv, asked - jnp.cross(dipole, field_b))
        after = advance(craft, state, wheels, dipole, place, field, jnp.zeros(3), DT)
        return after, (state.q_ib, state.wheel_h, dipole)

    given = (*wanted, orbit.r_i_m, field_along_orbit(orbit))
    q, h, dipole = jax.jit(lambda s: jax.lax.scan(step, s, given)[1])(start)
    angles = np.degrees(np.stack(to_euler(multiply(conjugate(down.q_ib), q)), -1))
    return {"time": time, "angles": angles, "wheels": np.asarray(h), "dipole": np.asarray(dipole)}


def draw() -> None:
    """Three panels over one time."""
    found = one_orbit()
    minutes, every = found["time"] / 60.0, slice(None, None, 20)
    figure, panels = plt.subplots(3, 1, figsize=(7.0, 6.2), sharex=True, layout="constrained")
    rows = (
        ("angles", ("roll", "pitch", "yaw"), "attitude against\nnadir [deg]", 1.0),
        ("wheels", ("wheel x", "wheel y", "wheel z", "wheel (1, 1, 1)"), "momentum\n[mN m s]", 1e3),
        ("dipole", ("coil x", "coil y", "coil z"), "dipole [A m²]", 1.0),
    )
    for axes, (name, labels, words, unit) in zip(panels, rows, strict=True):
        for column, label, colour in zip(found[name].T, labels, COLOURS, strict=False):
            axes.plot(
                minutes[every], unit * column[every], color=colour, label=label, linewidth=1.3
            )
        axes.axhline(0.0, color="#000000", linewidth=0.5)
        axes.set(ylabel=words, xlim=(0.0, minutes[-1]))
        axes.legend(frameon=False, ncols=len(labels), fontsize=8, loc="upper right")
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.18 * (high - low))  # the legend's
    panels[-1].set(xlabel="time [min]")
    figure.savefig(PICTURES / "spacecraft_orbit.png", dpi=150)


if __name__ == "__main__":
    draw()
