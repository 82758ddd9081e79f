"""Simulated CiA-402 drive for tests: pytest's fixture ``hdbridge_drive``; docs/ci.md has an example.

pytest loads this file in every run of an environment with hdbridge installed. It therefore imports only
pytest; the simulation is loaded by the first test that uses a drive.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Final

import pytest

if TYPE_CHECKING:
    from hdbridge.testing import SimulatedDrive

FIXTURE: Final = "hdbridge_drive"
MARKER: Final = "hdbridge_drive"
_DEFAULTS: Final = {"profile": "demo", "bus": "virtual", "seed": "0", "truth": ""}
_HELP: Final = {
    "profile": "the axis: a folder with axis.yaml, or a profile that comes with hdbridge (article, demo)",
    "bus": "virtual, lockstep, or INTERFACE:CHANNEL of python-can such as socketcan:vcan0",
    "seed": "seed of the simulated axis's noise",
    "truth": "a truth file in place of the profile's twin.yaml or truth.yaml",
}


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds the options ``--hdbridge-...`` and ini-file keys with the same meaning."""
    group = parser.getgroup("hdbridge", "simulated CiA-402 drive (fixture hdbridge_drive)")
    for name, what in _HELP.items():
        help_text = f"{what}; default {_DEFAULTS[name]}" if _DEFAULTS[name] else what
        group.addoption(f"--hdbridge-{name}", metavar=name.upper(), default=None, help=help_text)
        parser.addini(f"hdbridge_{name}", f"for the fixture hdbridge_drive: {help_text}", default="")


def pytest_configure(config: pytest.Config) -> None:
    """Registers the marker."""
    config.addinivalue_line(
        "markers",
        f"{MARKER}(profile='demo', bus='virtual', seed=0, truth=None, firmware={{}}): the drive that the "
        "fixture hdbridge_drive makes; before the command line and the ini file",
    )


@pytest.fixture
def hdbridge_drive(request: pytest.FixtureRequest) -> Iterator[SimulatedDrive]:
    """Simulated CiA-402 drive on a bus, with faults by name and the true angles: ``hdbridge.testing``."""
    from hdbridge.errors import HdbridgeError  # noqa: PLC0415 - nothing is loaded before a test needs it
    from hdbridge.testing import simulated_drive  # noqa: PLC0415

    complaint = ""
    with ExitStack() as stack:
        try:
            drive = stack.enter_context(simulated_drive(**_wanted(request)))
        except HdbridgeError as error:
            complaint = str(error)
        if complaint:
            pytest.fail(f"{FIXTURE}: {complaint}", pytrace=False)
        yield drive


@pytest.hookimpl(hookwrapper=True)  # also known to older versions of pytest
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, Any, None]:
    """Adds the drive's history to the report of a failed test."""
    report: pytest.TestReport = (yield).get_result()
    drive = getattr(item, "funcargs", {}).get(FIXTURE)
    if drive is not None and report.when == "call" and report.failed:
        report.sections.append(("simulated drive", drive.report()))


def _wanted(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Collects the settings from the marker, the command line, the ini file and the defaults, in this order
    of precedence.

    A relative path is relative to the test's folder (marker), the working folder (command line) or the ini
    file's folder.
    """
    config = request.config
    marks: dict[str, Any] = {}
    for marker in request.node.iter_markers(MARKER):  # the nearest first
        known = (*_DEFAULTS, "firmware")
        unknown = sorted({*marker.kwargs} - {*known})
        if marker.args or unknown:
            found = f"found {', '.join(unknown)}" if unknown else f"found {marker.args!r} without a name"
            pytest.fail(f"the marker {MARKER}: {found}; expected {', '.join(known)}", pytrace=False)
        marks = {**marker.kwargs, **marks}
    ini_folder = config.inipath.parent if config.inipath is not None else config.rootpath
    wanted: dict[str, Any] = {}
    for name, default in _DEFAULTS.items():
        value: Any
        if name in marks:
            value, folder = marks[name], request.path.parent
        elif (option := config.getoption(f"--hdbridge-{name}")) is not None:
            value, folder = option, config.invocation_params.dir
        else:
            value, folder = config.getini(f"hdbridge_{name}") or default, ini_folder
        if name in ("profile", "truth") and value and (folder / str(value)).exists():
            value = folder / str(value)
        wanted[name] = value
    wanted |= {"seed": _seed(wanted["seed"]), "truth": wanted["truth"] or None}
    return {**wanted, "firmware": marks.get("firmware", {})}


def _seed(value: Any) -> Any:
    """Converts a seed to an integer if possible; invalid values are reported later."""
    try:
        return int(value) if isinstance(value, str) else value
    except ValueError:
        return value
