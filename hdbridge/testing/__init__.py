"""Simulated drive for users' own tests: on a bus, with faults by name and the true angles.

`hdbridge.pytest_plugin` creates one per test (the fixture `hdbridge_drive`); without pytest, use ``with
simulated_drive("article") as drive:``. docs/ci.md has a complete example. These names are public, like those
of `hdbridge` itself.
"""

from hdbridge.testing.simulateddrive import DriveTime, SimulatedDrive, simulated_drive
from hdbridge.testing.watched import Event, Fault, Frame, TrueState

__all__ = ["DriveTime", "Event", "Fault", "Frame", "SimulatedDrive", "TrueState", "simulated_drive"]
