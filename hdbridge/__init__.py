"""hdbridge: a CANopen CiA-402 master that makes a harmonic-drive axis reach its commanded angle.

These names are the library's public interface. docs/api.md describes each, and they change only with a note
in the changelog. Each is loaded on first use, so importing hdbridge costs nothing. Everything else may change
without notice.
"""

from __future__ import annotations

import sys

# Nothing else is imported here: Ctrl-C during an import that precedes `main` would print a traceback.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any, Final

    from hdbridge.analysis.diagnosis import diagnose
    from hdbridge.axis import AxisConfig
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.client import AsyncClient, Client
    from hdbridge.commissioning.calibration import fit
    from hdbridge.control.bench import Bench
    from hdbridge.control.compensation import Compensation, Inverse
    from hdbridge.drive import Drive, open_bus
    from hdbridge.errors import (
        BusError,
        BusInUseError,
        DaemonError,
        DriveError,
        HdbridgeError,
        IdentityError,
        InputError,
        LeaseError,
        OutputError,
        RefusedError,
        SafetyStop,
        SdoError,
        TransitionError,
    )
    from hdbridge.motion.procedures.stepping import Stepping
    from hdbridge.motion.procedures.trajectory import Trajectory
    from hdbridge.records.record import Record
    from hdbridge.records.recording import Recording
    from hdbridge.simulated import simulated

__version__ = "0.1.0"

__all__ = [
    "AsyncClient",
    "AxisConfig",
    "Bench",
    "BusError",
    "BusInUseError",
    "Client",
    "Compensation",
    "DaemonError",
    "Drive",
    "DriveError",
    "HdbridgeError",
    "IdentityError",
    "InputError",
    "Inverse",
    "LeaseError",
    "OutputError",
    "Record",
    "Recording",
    "RefusedError",
    "SafetyStop",
    "SdoError",
    "Stepping",
    "Trajectory",
    "TransitionError",
    "TransmissionModel",
    "diagnose",
    "fit",
    "open_bus",
    "simulated",
]

_MODULES: Final = {
    "AsyncClient": "client",
    "AxisConfig": "axis",
    "Bench": "control.bench",
    "Client": "client",
    "Compensation": "control.compensation",
    "Drive": "drive",
    "Inverse": "control.compensation",
    "Record": "records.record",
    "Recording": "records.recording",
    "Stepping": "motion.procedures.stepping",
    "Trajectory": "motion.procedures.trajectory",
    "TransmissionModel": "axis.model",
    "diagnose": "analysis.diagnosis",
    "fit": "commissioning.calibration",
    "open_bus": "drive",
    "simulated": "simulated",
}
"""Module of each public name, except the errors."""


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'hdbridge' has no attribute '{name}'")
    from importlib import import_module  # noqa: PLC0415

    found = getattr(import_module(f"hdbridge.{_MODULES.get(name, 'errors')}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*(each for each in globals() if each.startswith("__")), *__all__})


class _FrontDoor(type(sys)):  # type: ignore[misc]
    """Makes `hdbridge.simulated` always the function, although importing the module of the same name would
    replace it.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not (isinstance(value, type(sys)) and name in __all__):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _FrontDoor
