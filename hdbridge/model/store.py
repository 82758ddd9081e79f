"""The models of a profile: the active one, one that waits to be committed, and every one that there was.

    profiles/NAME/axis.yaml           written by a person
                  model.yaml          the active model, the one that commands use
                  pending.yaml        proposed by a calibration or diagnosis, not yet committed
                  history/0001.yaml   each version that was ever active, byte for byte
                  history/log.yaml    what was activated when, and why

Each file is replaced atomically, in such an order that a kill at any moment leaves a usable profile: a
version is in the history before it becomes active, and the log is written last. Which version is active is
not noted anywhere, so it cannot be noted wrongly: it is the one whose bytes model.yaml has.

The date of each step is passed in.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from hdbridge.axis import AxisConfig, Identity
from hdbridge.errors import InputError
from hdbridge.files.yamlfile import dump_yaml, read_yaml, write_atomically
from hdbridge.model import TransmissionModel

PENDING = "pending"
ACTIVE = "active"
_HEADER = "# What was activated when, by hdbridge; read it with `hdbridge model log`.\n"

Action = Literal["found", "commit", "activate", "rollback"]


class Activation(BaseModel):
    """A line of the log."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    date: str = Field(description="when, ISO 8601")
    action: Action = Field(description="how it became active")
    version: int = Field(ge=1, description="number of the version")
    reason: str = Field("", description="why, in words")


class LogFile(BaseModel):
    """The content of ``history/log.yaml``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_: Literal["hdbridge.history/1"] = Field(
        alias="schema", description="kind and version of this file"
    )
    activations: tuple[Activation, ...] = Field(description="what was activated, oldest first")


@dataclass(frozen=True, slots=True)
class Version:
    """A model of the profile."""

    number: int | None
    """None for the pending model, and for an active one that was put there or edited by hand."""
    path: Path
    active: bool
    date: str
    """When it was made, as its file says."""
    reason: str
    model: TransmissionModel
    activations: tuple[Activation, ...] = ()

    @property
    def name(self) -> str:
        """As commands call it: its number, ``pending`` or ``active``."""
        return str(self.number) if self.number else ACTIVE if self.active else PENDING


def log(profile: Path) -> list[Version]:
    """Every model of the profile: the pending one, an active one that is not in the history, newest first."""
    activations = _activations(profile)
    active = _bytes(profile / "model.yaml")
    versions = []
    known = False
    for number, path in sorted(_history(profile).items(), reverse=True):
        is_active = path.read_bytes() == active
        known = known or is_active
        own = tuple(each for each in activations if each.version == number)
        versions.append(_version(number, path, is_active, own))
    if active is not None and not known:
        versions.insert(0, _version(None, profile / "model.yaml", True))
    if (profile / "pending.yaml").exists():
        versions.insert(0, _version(None, profile / "pending.yaml", False))
    return versions


def find(profile: Path, name: str) -> Version:
    """A model by name: ``active``, ``pending`` or a version's number; InputError says which there are."""
    versions = log(profile)
    for version in versions:
        if name in {version.name, f"{version.number:04d}" if version.number else ""} or (
            name == ACTIVE and version.active
        ):
            return version
    names = ", ".join(dict.fromkeys(each for version in versions for each in _names(version)))
    raise InputError(
        f"{profile}: there is no model '{name}'; expected one of: {names or 'none yet, calibrate first'}"
    )


def propose(
    profile: Path, model: TransmissionModel, reason: str, date: datetime, identity: Identity | None = None
) -> Path:
    """Keep a model as pending, bound to the profile's axis and the drive that answered.

    It takes the place of another pending one. Returns the file. InputError where it is of another gear ratio.
    """
    axis = AxisConfig.load(profile)
    model.check_ratio(axis)
    provenance = {**model.provenance, "date": _iso(date), "reason": reason}
    with _locked(profile):
        replace(model, provenance=provenance).bound_to(axis, identity).save(profile / "pending.yaml")
    return profile / "pending.yaml"


def commit(profile: Path, date: datetime, identity: Identity | None = None) -> int:
    """Make the pending model the active one; returns its number.

    ``identity`` is what the drive answers now; InputError where it, the axis or the gear is not the model's.
    """
    pending = profile / "pending.yaml"
    with _locked(profile):
        content = _bytes(pending)
        if content is None:
            raise InputError(f"{profile}: there is no pending model; calibrate first")
        reason = _check(profile, pending, identity).provenance.get("reason", "")
        number = _activate(profile, content, "commit", str(reason), date)
        pending.unlink()
    return number


def discard(profile: Path) -> None:
    """Throw the pending model away; InputError when there is none."""
    with _locked(profile):
        try:
            (profile / "pending.yaml").unlink()
        except FileNotFoundError:
            raise InputError(f"{profile}: there is no pending model") from None


def activate(
    profile: Path, version: int, reason: str, date: datetime, identity: Identity | None = None
) -> int:
    """Make a version of the history the active model; the one before stays in the history."""
    path = _history(profile).get(version)
    if path is None:
        numbers = ", ".join(map(str, sorted(_history(profile)))) or "none yet, calibrate first"
        raise InputError(f"{profile}: there is no version {version}; expected one of: {numbers}")
    with _locked(profile):
        _check(profile, path, identity)
        return _activate(profile, path.read_bytes(), "activate", reason, date)


def rollback(profile: Path, reason: str, date: datetime, identity: Identity | None = None) -> int:
    """Undo the last activation that is not undone yet; returns the number that is active now."""
    with _locked(profile):
        active = _bytes(profile / "model.yaml")
        earlier = undone(_activations(profile), _number(profile, active) if active is not None else None)
        path = _history(profile).get(earlier) if earlier else None
        if path is None:
            raise InputError(
                f"{profile}: no model was active before this one; there is nothing to roll back to"
            )
        _check(profile, path, identity)
        return _activate(profile, path.read_bytes(), "rollback", reason, date)


def undone(activations: Sequence[Activation], active: int | None) -> int | None:
    """The version that a roll-back returns to, from the log and the version that is active now.

    Roll-backs undo activations one by one, as an editor's undo does. The log may lack the last step, where a
    kill came between it and the log: the active version tells. None for ``active`` means a model that is
    not in the history.
    """
    stack: list[int] = []
    for each in activations:
        if each.action == "rollback" and each.version in stack:
            _unwind(stack, each.version)
        elif not stack or stack[-1] != each.version:
            stack.append(each.version)
    if active is None:
        return stack[-1] if stack else None
    if active in stack:
        _unwind(stack, active)
        stack.pop()
    return stack[-1] if stack else None


def _unwind(stack: list[int], version: int) -> None:
    """Take from the stack what stands above a version in it."""
    while stack[-1] != version:
        stack.pop()


def _activate(profile: Path, content: bytes, action: Action, reason: str, date: datetime) -> int:
    """History first, then the active model, the log last."""
    activations = _activations(profile)
    before = _bytes(profile / "model.yaml")
    if before is not None and before != content and _number(profile, before) is None:
        try:
            TransmissionModel.from_text(before.decode())
        except (InputError, UnicodeDecodeError):  # edited by hand and broken: kept, but it is no version
            write_atomically(_history_folder(profile) / "unreadable.yaml", before)
        else:
            reason_found = "was there, but not in the history"
            activations.append(
                Activation(
                    date=_iso(date), action="found", version=_keep(profile, before), reason=reason_found
                )
            )
            _write_log(profile, activations)
    number = _keep(profile, content)
    write_atomically(profile / "model.yaml", content)
    activations.append(Activation(date=_iso(date), action=action, version=number, reason=reason))
    _write_log(profile, activations)
    return number


def _keep(profile: Path, content: bytes) -> int:
    """The number of the version with this content, put into the history if it is not there."""
    number = _number(profile, content)
    if number is None:
        number = max(_history(profile), default=0) + 1
        write_atomically(_history_folder(profile) / f"{number:04d}.yaml", content)
    return number


def _history_folder(profile: Path) -> Path:
    folder = profile / "history"
    try:
        folder.mkdir(exist_ok=True)
    except OSError as problem:
        raise InputError(f"{folder}: cannot be made: {problem.strerror}") from None
    return folder


def _check(profile: Path, path: Path, identity: Identity | None) -> TransmissionModel:
    model = TransmissionModel.load(path)
    model.check_bound_to(AxisConfig.load(profile), identity)
    return model


def _number(profile: Path, content: bytes) -> int | None:
    history = sorted(_history(profile).items(), reverse=True)
    return next((number for number, path in history if path.read_bytes() == content), None)


def _history(profile: Path) -> dict[int, Path]:
    return {int(path.stem): path for path in (profile / "history").glob("*.yaml") if path.stem.isdecimal()}


def _activations(profile: Path) -> list[Activation]:
    path = profile / "history" / "log.yaml"
    return list(read_yaml(path).validate(LogFile).activations) if path.exists() else []


def _write_log(profile: Path, activations: Sequence[Activation]) -> None:
    data = {
        "schema": "hdbridge.history/1",
        "activations": [each.model_dump(exclude_defaults=True) for each in activations],
    }
    write_atomically(profile / "history" / "log.yaml", _HEADER + dump_yaml(data))


def _version(number: int | None, path: Path, active: bool, own: tuple[Activation, ...] = ()) -> Version:
    model = TransmissionModel.load(path)
    date, reason = (str(model.provenance.get(key, "")) for key in ("date", "reason"))
    return Version(number, path, active, date, reason, model, own)


def _names(version: Version) -> list[str]:
    return [version.name, ACTIVE] if version.active else [version.name]


def _bytes(path: Path) -> bytes | None:
    with suppress(FileNotFoundError):
        return path.read_bytes()
    return None


def _iso(date: datetime) -> str:
    return date.astimezone(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


@contextmanager
def measuring(axis_file: Path) -> Iterator[None]:
    """One measurement at a time for a profile, also between processes: of two proposals one would be lost.

    InputError, at once, where another process has it. The lock goes with its process, whatever ends it.
    """
    try:
        file = os.open(axis_file, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as problem:
        raise InputError(f"{axis_file}: cannot be read: {problem.strerror}") from None
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"{axis_file}: another hdbridge process is measuring this axis, to propose a model for it; "
                "wait until it has ended, or stop it"
            ) from None
        yield
    finally:
        os.close(file)


@contextmanager
def _locked(profile: Path) -> Iterator[None]:
    """One change at a time, also between processes; the lock goes with its process."""
    try:
        folder = os.open(profile, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as problem:
        raise InputError(f"{profile}: not a profile's folder: {problem.strerror}") from None
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)
