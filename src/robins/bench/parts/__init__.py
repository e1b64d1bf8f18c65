"""The parts of a vehicle, each at the end of a line.

- `station`: the protocol of a part, without a port. `node`: a part as a process.
"""

from robins.bench.parts.station import Part, Station, ready, serve

__all__ = ["Part", "Station", "ready", "serve"]
