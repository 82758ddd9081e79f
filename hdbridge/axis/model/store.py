"""Storage of the models of a profile: the active one, a pending one, and all earlier ones.

    profiles/NAME/axis.yaml           written by the user
                  model.yaml          the active model, used by the commands
                  pending.yaml        proposed by a calibration or diagnosis, not yet committed
                  history/0001.yaml   each version that was ever active, byte for byte
                  history/log.yaml    what was activated when, and why

Twins are stored in the same way under their own file names (`hdbridge.twin.twin`). All statements about
models in this module apply to any content of a `Store`.

Each file is replaced atomically. The order of writing ensures that a kill at any moment leaves a usable
profile: a version is in the history before it becomes active, and the log is written last. The number of the
active version is not stored. It is that of the version with the same bytes as model.yaml.

The caller passes the date of each step.
"""

import fcntl
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Generic, Literal, Protocol, Self, TypeVar

from pydantic import Field

from hdbridge.axis import AxisConfig, Identity
from hdbridge.axis.model import TransmissionModel
from hdbridge.errors import InputError
from hdbridge.files.atomic import check_writable, make_folder
from hdbridge.files.yamlfile import dump_yaml, read_yaml, write_atomically
from hdbridge.strictness import Strict

PENDING = "pending"
ACTIVE = "active"
_HEADER = "# What was activated when, by hdbridge; read it with `{}`.\n"

Action = Literal["found", "commit", "activate", "rollback"]


class Activation(Strict):
    """An entry of the log: one change of the active version."""

    date: str = Field(description="date, ISO 8601")
    action: Action = Field(description="action")
    version: int = Field(ge=1, description="version number")
    reason: str = Field("", description="reason for the activation, in words")


class LogFile(Strict):
    """Content of ``history/log.yaml``."""

    schema_: Literal["hdbridge.history/1"] = Field(
        alias="schema", description="schema and version of this file"
    )
    activations: tuple[Activation, ...] = Field(description="activations, oldest first")


class Kept(Protocol):
    """Interface of a store's content, whose provenance binds it to an axis and its drive."""

    @property
    def provenance(self) -> Mapping[str, Any]: ...
    def with_provenance(self, **provenance: Any) -> Self:
        """Returns the same content with these entries added to its provenance."""
        ...

    def save(self, path: Path | str) -> None: ...
    def check_ratio(self, axis: AxisConfig) -> None: ...
    def bound_to(self, axis: AxisConfig, identity: Identity | None = None) -> Self: ...
    def check_bound_to(self, axis: AxisConfig, identity: Identity | None = None) -> None: ...


K = TypeVar("K", bound=Kept)


@dataclass(frozen=True, slots=True)
class Version(Generic[K]):
    """A version in a store: its content, its location and its activations."""

    number: int | None
    """Number in the history; None for the pending model, and for an active model copied or edited by hand."""
    path: Path
    active: bool
    date: str
    """Date of creation, as stated in the file."""
    reason: str
    content: K
    activations: tuple[Activation, ...] = ()

    @property
    def name(self) -> str:
        """Name of the version in commands: its number, ``pending`` or ``active``."""
        return str(self.number) if self.number else ACTIVE if self.active else PENDING


@dataclass(frozen=True, slots=True)
class Store(Generic[K]):
    """All versions of one kind of content in a profile's folder."""

    noun: str
    """Name of the kind of content, for messages."""
    active: str
    """File name of the active version."""
    pending: str
    """File name of the pending version."""
    history: str
    """Name of the folder that contains all versions."""
    first: str
    """Advice for an empty store, for messages."""
    command: str
    """Command that prints the log, for the log's header."""
    load: Callable[[Path], K]

    def log(self, profile: Path) -> list[Version[K]]:
        """Returns all versions: pending, an active version that is not in the history, then the history.

        The history is sorted from newest to oldest. Another process, such as the daemon, may commit the
        pending version while this runs.
        """
        activations = self._activations(profile)
        active = _bytes(profile / self.active)
        versions = []
        known = False
        for number, path in sorted(self._history(profile).items(), reverse=True):
            is_active = path.read_bytes() == active
            known = known or is_active
            own = tuple(each for each in activations if each.version == number)
            versions.append(self._version(number, path, is_active, own))
        if active is not None and not known:
            versions.insert(0, self._version(None, profile / self.active, True))
        pending = profile / self.pending
        if pending.exists():
            try:
                versions.insert(0, self._version(None, pending, False))
            except InputError:
                if pending.exists():
                    raise
                return self.log(profile)  # it has been committed or discarded meanwhile
        return versions

    def find(self, profile: Path, name: str) -> Version[K]:
        """Returns a version by name: ``active``, ``pending`` or a number.

        Raises `InputError` with the existing names for an unknown one.
        """
        versions = self.log(profile)
        for version in versions:
            if name in {version.name, f"{version.number:04d}" if version.number else ""} or (
                name == ACTIVE and version.active
            ):
                return version
        names = ", ".join(dict.fromkeys(each for version in versions for each in _names(version)))
        raise InputError(
            f"{profile}: there is no {self.noun} '{name}'; "
            + (f"expected one of: {names}" if names else f"none is stored yet: {self.first}")
        )

    def check_pending(self, profile: Path) -> None:
        """Raises `InputError` if a pending version cannot be written; to be called before a measurement."""
        check_writable(profile / self.pending)

    def propose(
        self,
        profile: Path,
        content: K,
        reason: str,
        date: datetime,
        identity: Identity | None = None,
    ) -> Path:
        """Stores content as the pending version, bound to the profile's axis and drive; returns the file.

        Replaces a previous pending version. Raises `InputError` if the gear ratio differs from the axis
        file's.
        """
        axis = AxisConfig.load(profile)
        content.check_ratio(axis)
        with _locked(profile):
            dated = content.with_provenance(date=_iso(date), reason=reason)
            dated.bound_to(axis, identity).save(profile / self.pending)
        return profile / self.pending

    def commit(self, profile: Path, date: datetime, identity: Identity | None = None) -> int:
        """Makes the pending version active; returns its number.

        ``identity`` is the identity read from the drive. Raises `InputError` if the pending version belongs
        to another drive, axis or gear.
        """
        pending = profile / self.pending
        with _locked(profile):
            content = _bytes(pending)
            if content is None:
                raise InputError(f"{profile}: there is no pending {self.noun}; {self.first}")
            reason = self._check(profile, pending, identity).provenance.get("reason", "")
            number = self._activate(profile, content, "commit", str(reason), date)
            pending.unlink()
        return number

    def discard(self, profile: Path) -> None:
        """Deletes the pending version; raises `InputError` if nothing is pending."""
        with _locked(profile):
            try:
                (profile / self.pending).unlink()
            except OSError as problem:
                if (profile / self.pending).exists():
                    raise InputError(
                        f"{profile / self.pending}: {problem.strerror}; nothing was deleted"
                    ) from None
                raise InputError(f"{profile}: there is no pending {self.noun}") from None

    def activate(
        self, profile: Path, version: int, reason: str, date: datetime, identity: Identity | None = None
    ) -> int:
        """Makes a version of the history active, and returns its number; the previous one stays stored."""
        path = self._history(profile).get(version)
        if path is None:
            numbers = ", ".join(map(str, sorted(self._history(profile))))
            raise InputError(
                f"{profile}: there is no version {version}; "
                + (f"expected one of: {numbers}" if numbers else f"none is stored yet: {self.first}")
            )
        with _locked(profile):
            self._check(profile, path, identity)
            return self._activate(profile, path.read_bytes(), "activate", reason, date)

    def rollback(self, profile: Path, reason: str, date: datetime, identity: Identity | None = None) -> int:
        """Undoes the last activation that is not yet undone; returns the number of the active version."""
        with _locked(profile):
            active = _bytes(profile / self.active)
            earlier = undone(
                self._activations(profile), self._number(profile, active) if active is not None else None
            )
            path = self._history(profile).get(earlier) if earlier else None
            if path is None:
                raise InputError(
                    f"{profile}: no {self.noun} was active before this one; there is nothing to roll back to"
                )
            self._check(profile, path, identity)
            return self._activate(profile, path.read_bytes(), "rollback", reason, date)

    def _activate(self, profile: Path, content: bytes, action: Action, reason: str, date: datetime) -> int:
        """Writes content to the history, then as the active version, the log last; returns its number."""
        activations = self._activations(profile)
        before = _bytes(profile / self.active)
        if before is not None and before != content and self._number(profile, before) is None:
            try:
                self.load(profile / self.active)
            except (InputError, UnicodeDecodeError):  # damaged by a manual edit: saved, but not as a version
                write_atomically(make_folder(profile / self.history) / "unreadable.yaml", before)
            else:
                reason_found = "found as the active version, but not in the history"
                activations.append(
                    Activation(
                        date=_iso(date),
                        action="found",
                        version=self._keep(profile, before),
                        reason=reason_found,
                    )
                )
                self._write_log(profile, activations)
        number = self._keep(profile, content)
        write_atomically(profile / self.active, content)
        activations.append(Activation(date=_iso(date), action=action, version=number, reason=reason))
        self._write_log(profile, activations)
        return number

    def _keep(self, profile: Path, content: bytes) -> int:
        """Adds content to the history, unless it is already there, and returns its version number."""
        number = self._number(profile, content)
        if number is None:
            number = max(self._history(profile), default=0) + 1
            write_atomically(make_folder(profile / self.history) / f"{number:04d}.yaml", content)
        return number

    def _check(self, profile: Path, path: Path, identity: Identity | None) -> K:
        content = self.load(path)
        content.check_bound_to(AxisConfig.load(profile), identity)
        return content

    def _number(self, profile: Path, content: bytes) -> int | None:
        history = sorted(self._history(profile).items(), reverse=True)
        return next((number for number, path in history if path.read_bytes() == content), None)

    def _history(self, profile: Path) -> dict[int, Path]:
        return {
            int(path.stem): path for path in (profile / self.history).glob("*.yaml") if path.stem.isdecimal()
        }

    def _activations(self, profile: Path) -> list[Activation]:
        path = profile / self.history / "log.yaml"
        return list(read_yaml(path).validate(LogFile).activations) if path.exists() else []

    def _write_log(self, profile: Path, activations: Sequence[Activation]) -> None:
        data = {
            "schema": "hdbridge.history/1",
            "activations": [each.model_dump(exclude_defaults=True) for each in activations],
        }
        write_atomically(profile / self.history / "log.yaml", _HEADER.format(self.command) + dump_yaml(data))

    def _version(
        self, number: int | None, path: Path, active: bool, own: tuple[Activation, ...] = ()
    ) -> Version[K]:
        content = self.load(path)
        date, reason = (str(content.provenance.get(key, "")) for key in ("date", "reason"))
        return Version(number, path, active, date, reason, content, own)


def undone(activations: Sequence[Activation], active: int | None) -> int | None:
    """Returns the version that a roll-back would activate, given the log and the active version.

    Roll-backs undo activations one by one, like the undo function of an editor. After a kill the log may lack
    the last step. The active version then indicates that step. ``active`` is None for a model outside the
    history.
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
    """Removes all entries above ``version`` from the stack."""
    while stack[-1] != version:
        stack.pop()


def _names(version: Version[K]) -> list[str]:
    return [version.name, ACTIVE] if version.active else [version.name]


def _bytes(path: Path) -> bytes | None:
    with suppress(FileNotFoundError):
        return path.read_bytes()
    return None


def _iso(date: datetime) -> str:
    return date.astimezone(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


@contextmanager
def measuring(axis_file: Path) -> Iterator[None]:
    """Locks a profile for one measurement at a time, because a second proposal would replace the first.

    The lock applies to all processes. If another process holds it, raises `InputError` at once. The lock is
    released when its process ends.
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
    """Waits for and holds a lock of the profile, across processes; it is released when its process ends."""
    try:
        folder = os.open(profile, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as problem:
        raise InputError(f"{profile}: not a profile's folder: {problem.strerror}") from None
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


MODELS: Final = Store(
    "model",
    "model.yaml",
    "pending.yaml",
    "history",
    "calibrate first",
    "hdbridge model log",
    TransmissionModel.load,
)
log, find, propose, commit = MODELS.log, MODELS.find, MODELS.propose, MODELS.commit
discard, activate, rollback = MODELS.discard, MODELS.activate, MODELS.rollback
