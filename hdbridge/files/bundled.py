"""Location of the profiles and EDS files that come with hdbridge.

In an installed wheel they are in ``hdbridge/_bundled``, in a working copy in the folders ``eds`` and
``profiles`` next to the package.
"""

from pathlib import Path
from typing import Literal

from hdbridge.errors import InputError
from hdbridge.files.expectation import nearest

_PACKAGE = Path(__file__).resolve().parents[1]


def bundled_folder(kind: Literal["eds", "profiles"], package: Path = _PACKAGE) -> Path:
    """Returns the folder of bundled EDS files or profiles; it may be missing in a broken installation."""
    installed = package / "_bundled" / kind
    beside = package.parent / kind
    working_copy = (package.parent / "pyproject.toml").is_file() and beside.is_dir()
    return beside if working_copy and not installed.is_dir() else installed


def bundled_profile(name: str) -> Path:
    """Returns the folder of a bundled profile; raises `InputError` with the existing ones and the nearest."""
    folder = bundled_folder("profiles")
    if name and (folder / name / "axis.yaml").is_file():
        return folder / name
    known = sorted(each.parent.name for each in folder.glob("*/axis.yaml"))
    close = nearest(name, known)
    expected = ", ".join(known) or f"none found in {folder}"
    hint = f"; did you mean '{close}'?" if close else ""
    raise InputError(
        f"{name}: no such file or folder, nor a bundled profile; expected a path or one of: {expected}{hint}"
    )
