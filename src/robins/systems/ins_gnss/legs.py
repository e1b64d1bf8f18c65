"""The legs of a scenario's drive as commands of `robins.sim.commands`."""

from __future__ import annotations
