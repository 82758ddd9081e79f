"""Finds the files of one axis from user input or a machine file, and locates bundled files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, Self

from hdbridge.errors import InputError, command
from hdbridge.files.expectation import nearest

_PACKAGE = Path(__file__).resolve().parents[1]


def bundled_folder(kind: Literal["eds", "profiles"], package: Path = _PACKAGE) -> Path:
    """Returns the folder of bundled EDS files or profiles; it may be missing in a broken installation."""
    installed = package / "_bundled" / kind
    beside = package.parent / kind
    working_copy = (package.parent / "pyproject.toml").is_file() and beside.is_dir()
    return beside if working_copy and not installed.is_dir() else installed


def bundled_profile(name: str) -> Path:
    """Returns the folder of a bundled profile.

    Raises `InputError` with the existing profiles and the nearest name for an unknown one.
    """
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


def no_model(path: Path, otherwise: str = "") -> InputError:
    """Returns the error for a missing model file, with the commands that give a profile its active model.

    ``otherwise`` adds an alternative to these.
    """
    folder = path.parent
    if not (folder / "axis.yaml").is_file():
        return InputError(f"{path}: no such file")
    name = folder.name if folder == bundled_folder("profiles") / folder.name else folder
    commit = command("model", "commit", name)
    if (folder / "pending.yaml").is_file():
        advice = f"commit the pending one: {commit}"
    else:
        advice = f"calibrate first: {command('calibrate', name)}, and commit the result: {commit}"
    return InputError(f"{path}: there is no active model; {advice}{otherwise}")


TWIN_NAME: Final = "twin.yaml"


@dataclass(frozen=True, slots=True)
class Profile:
    """Files of one axis."""

    axis: Path
    model: Path
    truth: Path

    @property
    def folder(self) -> Path:
        """Folder of the axis file and of the history of its models."""
        return self.axis.parent

    @property
    def twin(self) -> Path:
        """File of the axis's twin, which may not exist."""
        return self.folder / TWIN_NAME

    @property
    def simulated(self) -> Path:
        """File that describes the simulated drive: the axis's twin if it exists, else its truth file."""
        return self.twin if self.twin.is_file() else self.truth

    @classmethod
    def find(cls, text: str, base: Path = Path()) -> Self:
        """Finds a profile by its folder, axis file or bundled name; raises `InputError` for an unknown one.

        A relative path is relative to ``base``.
        """
        path = base / text
        if not path.exists():
            path = bundled_profile(text)
        if not path.is_dir():
            return cls(path, path.parent / "model.yaml", path.parent / "truth.yaml")
        axis = path / "axis.yaml"
        if axis.is_dir() or not axis.exists():
            raise InputError(f"{path}: has no file axis.yaml; expected the folder of an axis")
        return cls(axis, path / "model.yaml", path / "truth.yaml")
