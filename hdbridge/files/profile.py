"""Files of one axis, found from user input or a machine file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from hdbridge.errors import InputError
from hdbridge.files.bundled import bundled_profile

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
        """File of the twin, which may not exist."""
        return self.folder / TWIN_NAME

    @property
    def simulated(self) -> Path:
        """File that describes the simulated drive: the axis's twin if there is one, else its truth file."""
        return self.twin if self.twin.is_file() else self.truth

    @classmethod
    def find(cls, text: str, base: Path = Path()) -> Self:
        """Finds a profile by folder, axis file or bundled name; raises `InputError` if there is none.

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
