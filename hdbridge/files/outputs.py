"""Checks the locations of results, so that no output overwrites anything of value.

A result may replace only a result of the same kind. It must not replace an input of the command, another
output, or a file that belongs to a profile or a recording. Pipes and character devices are written directly
(`write_atomically`). Sockets, disks and folders are refused. All checks precede any motion.
"""

import os
import re
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Final

from hdbridge.errors import InputError, OutputError, command
from hdbridge.files.atomic import check_writable, descriptor_of, is_stream

_HEAD_BYTES: Final = 4096


class Kind(Enum):
    """Kind of an output; the value is a pattern that matches the beginning of such a file."""

    JSON = r'\s*\{\s*"schema": "hdbridge\.'
    PAGE = r"(?s).*<!doctype html>"
    MODEL = r"(?sm).*^schema: hdbridge\.model/"
    LOG = r'\{"date": "'
    FOLDER = "a folder"

    @property
    def words(self) -> str:
        """Name of the kind, for messages."""
        return {
            Kind.JSON: "a result of hdbridge",
            Kind.PAGE: "a page",
            Kind.MODEL: "a model file",
            Kind.LOG: "a log of hdbridge",
        }[self]


@dataclass(frozen=True, slots=True)
class Output:
    """Location that a command will write."""

    option: str
    """Option that states the location, for messages: ``--json``."""
    path: Path
    kind: Kind


_PROFILE: Final = frozenset(
    {"axis.yaml", "model.yaml", "pending.yaml", "truth.yaml", "twin.yaml", "pending-twin.yaml"}
)
_HISTORIES: Final = frozenset({"history", "twin-history"})
_RECORDING: Final = frozenset(
    {"recording.yaml", "model.yaml", "active.yaml", "calibration.json", "improvement.json"}
)
_SAMPLES: Final = (".csv", ".csv.gz")


def check_outputs(outputs: Sequence[Output], inputs: Iterable[Path] = ()) -> None:
    """Raises `InputError` unless each output can be written without overwriting anything of value.

    ``inputs`` contains the files and folders that the command reads.
    """
    read = [each for each in inputs if _status(each) is not None]
    redirected = _redirected()
    for number, output in enumerate(outputs):
        if output.kind is Kind.FOLDER:
            _check_folder(output, read)
        else:
            _check_file(output, read, redirected)
        for other in outputs[:number]:
            if not _endless(output.path) and _same(output.path, other.path):
                raise InputError(
                    f"{output.path}: {other.option} and {output.option} both write to this path; expected "
                    f"different paths"
                )


def _check_file(
    output: Output, inputs: Sequence[Path], redirected: Sequence[tuple[str, os.stat_result]]
) -> None:
    path = output.path
    check_writable(path)
    if descriptor_of(path) is not None or _endless(path):
        return
    for each in inputs:
        if _same(path, each):
            raise InputError(
                f"{path}: {output.option} would overwrite {each}, which this command reads; expected another "
                "file"
            )
    found = _status(path)
    if found is None:
        pass
    elif stat.S_ISREG(found.st_mode):
        for name, status in redirected:
            if os.path.samestat(found, status):
                raise InputError(
                    f"{path}: {name} already goes there; expected another file, or {output.option} - for the "
                    "standard output"
                )
    else:
        return  # pipes replace nothing
    _check_belongs_to_no_folder(output)
    if found is not None and found.st_size and not re.match(output.kind.value, _head(path)):
        raise InputError(
            f"{path}: {output.option} would write into this file, which is not {output.kind.words}; expected "
            "a new file, or one that may be replaced: remove it first"
        )


def _check_belongs_to_no_folder(output: Output) -> None:
    """Refuses to overwrite a file of a profile or a recording.

    A model may be written as the pending model, or as the active model of a profile that has no model.
    """
    path = _resolved(output.path)
    folder, name = path.parent, path.name.casefold()
    profile = folder.parent if folder.name.casefold() in _HISTORIES else folder
    if (profile / "axis.yaml").exists() and (profile != folder or name in _PROFILE):
        if output.kind is Kind.MODEL and profile == folder:
            if name == "pending.yaml" or (name == "model.yaml" and not path.exists()):
                return
            raise InputError(
                f"{output.path}: {output.option} would overwrite a file of a profile; write the model to "
                f"{folder / 'pending.yaml'}, then use it: {command('model', 'commit', folder)}"
            )
        raise InputError(
            f"{output.path}: {output.option} would overwrite a file of the profile {profile}; "
            "expected another file"
        )
    if (folder / "recording.yaml").exists() and (
        name in _RECORDING or (path.exists() and name.endswith(_SAMPLES))
    ):
        raise InputError(
            f"{output.path}: {output.option} would overwrite a file of the recording {folder}; "
            "expected another file"
        )


def _check_folder(output: Output, inputs: Sequence[Path]) -> None:
    """Checks that a folder for measurements is new or empty, because measured data are never replaced."""
    folder = output.path
    with suppress(OSError):
        if folder.is_dir():
            first = min((each.name for each in folder.iterdir()), default=None)
            if first is not None:
                begun = "; or --resume to continue its measurement" * (folder / "recording.yaml").exists()
                raise InputError(
                    f"{folder}: {output.option} would write into a folder that is not empty (it has "
                    f"{first}); expected a new or an empty one{begun}"
                )
    place = _resolved(folder)
    for each in (place, *place.parents):
        if each.name.casefold() == "history" and (each.parent / "axis.yaml").exists():
            raise InputError(
                f"{folder}: {output.option} would write into the history of the profile {each.parent}; "
                "expected another folder"
            )
    for each in inputs:
        if _same(folder, each):
            raise InputError(f"{folder}: {output.option} is an input of this command; expected a new folder")
    existing = place
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise InputError(f"{folder}: cannot create this folder: {existing} is not a folder")
    check_writable(existing / "a file", named=folder)


def _redirected() -> list[tuple[str, os.stat_result]]:
    """Returns the regular files to which the standard streams are redirected, with the streams' names."""
    found = []
    for descriptor, name in enumerate(("standard input", "standard output", "standard error")):
        with suppress(OSError):
            status = os.fstat(descriptor)
            if stat.S_ISREG(status.st_mode):
                found.append((name, status))
    return found


def _same(one: Path, other: Path) -> bool:
    """Returns True if two paths denote the same file, even through links or with different spelling.

    For files that do not exist yet, case is ignored, because some file systems ignore it.
    """
    mine, its = descriptor_of(one), descriptor_of(other)
    if mine is not None or its is not None:
        return mine == its
    found, its_found = _status(one), _status(other)
    if found and its_found:
        return os.path.samestat(found, its_found)
    if found or its_found:
        return False
    one, other = _resolved(one), _resolved(other)
    return one.name.casefold() == other.name.casefold() and (
        one.parent == other.parent or (one.parent.exists() and _same(one.parent, other.parent))
    )


def _endless(path: Path) -> bool:
    """Returns True for a character device, to which several outputs may be written."""
    found = _status(path)
    return found is not None and stat.S_ISCHR(found.st_mode) and descriptor_of(path) is None


def _status(path: Path) -> os.stat_result | None:
    """Returns the status of the file at a path, which is resolved first (``missing/../file`` is ``file``)."""
    try:
        return _resolved(path).stat()
    except OSError:
        return None


def _resolved(path: Path) -> Path:
    try:
        return path if is_stream(path) else path.resolve()
    except (OSError, RuntimeError):  # a loop of links
        raise InputError(f"{path}: cannot be written: its symbolic links form a loop") from None


def _head(path: Path) -> str:
    try:
        with _resolved(path).open("rb") as file:
            return file.read(_HEAD_BYTES).decode(errors="replace")
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror}") from None


_failures: ContextVar[list[OutputError] | None] = ContextVar("failures", default=None)


@contextmanager
def failures_deferred() -> Iterator[list[OutputError]]:
    """Defers failures to write results until after the block; yields the list of errors.

    The figures of a measurement can thus be printed first, so that a full disk does not lose them.
    """
    failed: list[OutputError] = []
    token = _failures.set(failed)
    try:
        yield failed
    finally:
        _failures.reset(token)


@contextmanager
def writing() -> Iterator[None]:
    """Defers an `OutputError` in the block that writes a result, if an outer block defers failures."""
    try:
        yield
    except OutputError as error:
        defer(error)


def defer(error: OutputError) -> None:
    """Stores the error if an outer block defers failures (`failures_deferred`), else raises it."""
    failed = _failures.get()
    if failed is None:
        raise error
    failed.append(error)
