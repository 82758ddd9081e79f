"""Which model compensates an axis, and which part of it; made ready for the control process.

What is built here is built in a worker thread, and becomes the model in use only when the control process has
taken it. What is in use is remembered in a file of the runtime folder, with the number of the control process
that has it: a service that begins anew learns it from there.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from hdbridge.axis import Identity
from hdbridge.control.bench import compensation_for
from hdbridge.control.compensation import Compensation
from hdbridge.errors import InputError
from hdbridge.evaluation.stepping import Scheme
from hdbridge.files.atomic import write_atomically
from hdbridge.model import TransmissionModel, store

if TYPE_CHECKING:
    from hdbridge.daemon.machine import Axis


@dataclass(frozen=True, slots=True)
class InUse:
    """The model of an axis, and which part of it compensates."""

    model: TransmissionModel
    scheme: Scheme
    version: int | None
    """Its number in the history; None where it has none."""
    file: Path
    adapted: TransmissionModel | None = None
    """The model as the load encoder has moved its parameters; None: as it was committed."""

    @property
    def compensating(self) -> TransmissionModel:
        """What compensates: the part of the model, as it was moved."""
        return self.scheme.of(self.adapted or self.model)

    def compensation(self, axis: Axis) -> Compensation:
        """Its inverse, for the control process. InputError where it cannot be for this axis."""
        return compensation_for(axis.config, self.compensating)


@dataclass(frozen=True, slots=True)
class Choice:
    """What is to be used next, made ready."""

    in_use: InUse
    pickled: bytes
    """The compensation; the control process is the only one that unpickles it."""

    @property
    def compensating(self) -> bool:
        """Whether the correction is faded in."""
        return self.in_use.scheme is not Scheme.NONE


class AxisModels:
    """The models of one axis."""

    def __init__(self, axis: Axis) -> None:
        """In use is what the control process begins with: the active model, by the machine's scheme."""
        self._axis = axis
        self.in_use = self._of(axis.model(), axis.compensation)

    @property
    def default(self) -> InUse:
        """What a control process that begins now has."""
        return self._of(self._axis.model(), self._axis.compensation)

    def check_drive(self, identity: Identity) -> None:
        """InputError where the model in use is of another drive than the one that answers."""
        self.in_use.model.check_bound_to(self._axis.config, identity)

    def with_scheme(self, scheme: Scheme) -> Choice:
        """The model in use by another scheme. InputError where the model has nothing to extend it with."""
        in_use = self.in_use
        if scheme is Scheme.EXTENDED and not in_use.model.effects:
            raise InputError(
                f"{self._axis.name}: there is no model to compensate with; calibrate first, or use 'none'"
            )
        return self.made(replace(in_use, scheme=scheme))

    def found(self, version: int | Literal["pending", "active"], identity: Identity) -> Choice:
        """A model of the profile, by the present scheme.

        InputError where there is no such model, or it is of another axis, drive or gear.
        """
        found = store.find(self._axis.profile.folder, str(version))
        found.content.check_bound_to(self._axis.config, identity)
        return self.made(InUse(found.content, self.in_use.scheme, found.number, found.path))

    def activate(
        self, version: int | Literal["pending", "active"], identity: Identity, date: datetime
    ) -> None:
        """Make what is in use, found under this name, the active model of the profile."""
        folder, in_use = self._axis.profile.folder, self.in_use
        number = in_use.version
        if version == store.PENDING:
            number = store.commit(folder, date, identity)
        elif version != store.ACTIVE and not store.find(folder, str(version)).active:
            number = store.activate(folder, int(version), "through the daemon", date, identity)
        self.in_use = InUse(in_use.model, in_use.scheme, number, self._axis.profile.model)

    def made(self, in_use: InUse) -> Choice:
        """Ready for the control process."""
        return Choice(in_use, pickle.dumps(in_use.compensation(self._axis)))

    def moved(self, model: TransmissionModel) -> Choice:
        """What is in use with other parameters: ``model`` is the whole of it, as it was moved."""
        return self.made(replace(self.in_use, adapted=model))

    def taken(self, choice: Choice) -> None:
        """The control process has it."""
        self.in_use = choice.in_use

    def recall(self, scheme: Scheme, version: int | None) -> None:
        """The control process has this already: a service before has changed it."""
        in_use = self.in_use
        if version is not None and version != in_use.version:
            found = store.find(self._axis.profile.folder, str(version))
            self.in_use = InUse(found.content, scheme, version, found.path)
        else:
            self.in_use = InUse(in_use.model, scheme, in_use.version, in_use.file)

    def _of(self, model: TransmissionModel, scheme: Scheme) -> InUse:
        """The active model; its number where it is in the history."""
        profile = self._axis.profile
        number = None
        if profile.model.exists():
            number = store.find(profile.folder, store.ACTIVE).number
        return InUse(model, scheme, number, profile.model)


class _Remembered(BaseModel):
    """What one axis used."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scheme: Scheme
    version: int | None


class _Memory(BaseModel):
    """The content of the file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    loop_pid: int
    axes: dict[str, _Remembered]


def remember(path: Path, loop_pid: int, models: Mapping[str, AxisModels]) -> None:
    """Keep for the next service what the present control process uses."""
    axes = {
        name: _Remembered(scheme=each.in_use.scheme, version=each.in_use.version)
        for name, each in models.items()
    }
    write_atomically(path, _Memory(loop_pid=loop_pid, axes=axes).model_dump_json() + "\n")


def recall(path: Path, loop_pid: int, models: Mapping[str, AxisModels]) -> None:
    """Take what the service before has remembered, where the same control process still runs."""
    try:
        memory = _Memory.model_validate_json(path.read_text(encoding="utf-8"))
    except (OSError, ValidationError, UnicodeDecodeError):
        return
    if memory.loop_pid != loop_pid:
        return
    for name, axis in models.items():
        known = memory.axes.get(name)
        if known is not None:
            axis.recall(known.scheme, known.version)
