"""The files of one axis, found from what a person types or a machine file says."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hdbridge.errors import InputError
from hdbridge.files.bundled import bundled_profile

TWIN_NAME: Final = "twin.yaml"


@dataclass(frozen=True, slots=True)
class Profile:
    """The files of one axis."""

    axis: Path
    model: Path
    truth: Path

    @property
    def folder(self) -> Path:
        """Where the axis file lies, and with it the history of its models."""
        return self.axis.parent

    @property
    def twin(self) -> Path:
        """The twin's file, which may not be there."""
        return self.folder / TWIN_NAME

    @property
    def simulated(self) -> Path:
        """What the simulated drive of this axis is: its twin where there is one, else the truth file."""
        return self.twin if self.twin.is_file() else self.truth

    @classmethod
    def find(cls, text: str, base: Path = Path()) -> Profile:
        """From a folder, an axis file, or the name of a bundled profile; InputError where it is neither.

        ``base`` is the folder that a relative path starts from.
        """
        path = base / text
        if not path.exists():
            path = bundled_profile(text)
        if not path.is_dir():
            return cls(path, path.parent / "model.yaml", path.parent / "truth.yaml")
        if not (path / "axis.yaml").exists():
            raise InputError(f"{path}: there is no axis.yaml in this folder; expected the folder of an axis")
        return cls(path / "axis.yaml", path / "model.yaml", path / "truth.yaml")
