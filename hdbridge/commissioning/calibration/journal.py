"""Growing recording folder with one file per task of a plan; always a valid recording.

After each task its samples are written, then ``recording.yaml`` is replaced atomically. However the
measurement ends (Ctrl-C, a fault, a kill, a power cut), the folder contains all completed tasks, and the
samples of an interrupted task if there was time to write them. `Journal.open` resumes it.
"""

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field

from hdbridge.axis import AxisConfig, Identity
from hdbridge.control.bench import axis_view
from hdbridge.control.faultcounts import FaultCount, fault_notes
from hdbridge.errors import InputError
from hdbridge.files.atomic import make_folder
from hdbridge.files.yamlfile import read_yaml
from hdbridge.motion.procedures.plan import Plan
from hdbridge.records.record import Record
from hdbridge.records.recording import (
    ABOUT_NAME,
    RecordedFile,
    Recording,
    RecordingFile,
    Segment,
    versions_here,
)

PAUSE_S = 1.0
"""Gap between two tasks on the recording's time axis, during which the drive is disabled."""


class TaskEntry(BaseModel):
    """One run of a task of the plan, as listed in the recording's notes."""

    model_config = ConfigDict(defer_build=True, frozen=True, extra="forbid")

    task: str = Field(description="its name in the plan")
    file: str = Field(description="file with its samples")
    session: int = Field(ge=1, description="the encoders kept their zeros within a session")
    complete: bool = Field(description="false: it was interrupted")
    start_s: float = Field(description="time of its first sample")
    end_s: float = Field(description="time of its last sample")
    lost: tuple[str, ...] = Field(
        (),
        description="channels of the axis file that failed during the test; the samples do not contain them",
    )
    survived: tuple[FaultCount, ...] = Field(
        (), description="faults that the run tolerated, and the one that ended it"
    )


class _Notes(BaseModel):
    model_config = ConfigDict(defer_build=True, frozen=True, extra="allow")

    plan: dict[str, Any]
    tasks: tuple[TaskEntry, ...] = ()


class Journal:
    """Recording folder of a calibration, to which `add` adds tasks."""

    def __init__(self, folder: Path, about: RecordingFile, plan: Plan) -> None:
        self.folder = folder
        self.plan = plan
        self._about = about
        self._tasks = list(_Notes.model_validate(about.notes).tasks)
        self._session = max((each.session for each in self._tasks), default=0)

    @classmethod
    def create(
        cls,
        folder: Path,
        axis: AxisConfig,
        plan: Plan,
        date: datetime,
        identity: Identity,
        notes: Mapping[str, Any] = MappingProxyType({}),
    ) -> Self:
        """Creates folder and journal, written with its first task; notes the parts of the plan that are
        shortened.

        InputError if the folder contains a recording, or if the axis has no encoder at its load.
        """
        axis.require_load_encoder()
        if (folder / ABOUT_NAME).exists():
            raise InputError(
                f"{folder}: already contains a recording; expected a new folder, or --resume to continue it"
            )
        shortened = plan.tasks(axis_view(axis)).notes
        make_folder(folder)
        about = RecordingFile.made(
            axis=axis.name,
            ratio=axis.gear.ratio,
            drive=identity,
            date=date.isoformat(timespec="seconds"),
            versions=versions_here(),
            notes={
                "plan": plan.as_dict(),
                **notes,
                **({"shortened": list(shortened)} if shortened else {}),
            },
            files=(),
            segments=(),
        )
        return cls(folder, about, plan)

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Opens a journal to resume it; InputError if the folder is not the recording of a calibration."""
        if not (folder / ABOUT_NAME).exists():
            raise InputError(f"{folder}: no {ABOUT_NAME} in this folder; expected a calibration's recording")
        document = read_yaml(folder / ABOUT_NAME)
        about = document.validate(RecordingFile)
        if "plan" not in about.notes:
            raise document.error(
                ("notes",), "has no plan; expected the recording of a calibration ('hdbridge calibrate')"
            )
        plan = document.validate(Plan, ("notes", "plan"))
        Recording.load(folder)  # detects changed files before anything moves
        return cls(folder, about, plan)

    def check_is_of(self, axis: AxisConfig, identity: Identity | None = None) -> None:
        """Raises InputError for a recording of another axis, gear or drive."""
        check_is_of(
            self._about,
            axis,
            self.folder / ABOUT_NAME,
            "resume it on the axis that was recorded, or start a new one",
            identity,
        )

    @property
    def done(self) -> frozenset[str]:
        """Names of the completed tasks."""
        return frozenset(each.task for each in self._tasks if each.complete)

    def begin_session(self) -> None:
        """Starts a session, because the encoders may have lost their zeros since the last task."""
        self._session += 1

    def add(
        self,
        task: str,
        record: Record,
        legs: Sequence[Segment],
        *,
        complete: bool,
        lost: tuple[str, ...] = (),
        survived: tuple[FaultCount, ...] = (),
    ) -> None:
        """Writes a task's samples and legs; does nothing without samples."""
        if not len(record):
            return
        end_s = max((each.end_s for each in self._tasks), default=-PAUSE_S)
        # The time of each bench run starts at zero.
        shift_s = end_s + PAUSE_S - float(record.time_s[0])
        if shift_s:
            record = Record({**record.columns, "time_s": record.time_s + shift_s})
        again = sum(each.task == task for each in self._tasks)
        name = f"{task}{f'-{again + 1}' if again else ''}.csv.gz"
        record.write_csv(self.folder / name)
        entry = TaskEntry(
            task=task,
            file=name,
            session=self._session,
            complete=complete,
            start_s=float(record.time_s[0]),
            end_s=float(record.time_s[-1]),
            lost=lost,
            survived=survived,
        )
        self._tasks.append(entry)
        segments = (
            Segment(kind=each.kind, start_s=each.start_s + shift_s, end_s=each.end_s + shift_s)
            for each in legs
        )
        before = self._about
        tasks = [each.model_dump(mode="json", exclude_defaults=True) for each in self._tasks]
        changes = {
            "notes": {**before.notes, "tasks": tasks},
            "files": (*before.files, RecordedFile.of(self.folder / name, len(record))),
            "segments": (*before.segments, *segments),
        }
        self._about = before.model_copy(update=changes)
        self._about.write(self.folder)

    def recording(self) -> Recording:
        """Loads everything measured so far."""
        return Recording.load(self.folder)


def check_is_of(
    about: RecordingFile | Recording,
    axis: AxisConfig,
    path: Path,
    remedy: str,
    identity: Identity | None = None,
) -> None:
    """Raises InputError with a remedy for a recording of another axis, gear or drive."""
    pairs = [("axis", about.axis, axis.name), ("gear ratio", about.ratio, axis.gear.ratio)]
    for name in ("vendor_id", "product_code", "serial") if identity is not None else ():
        pairs.append((f"drive {name}", getattr(about.drive, name, None), getattr(identity, name)))
    for what, theirs, ours in pairs:
        if theirs is not None and ours is not None and theirs != ours:
            raise InputError(
                f"{path}: this recording is of {what} {theirs}, but the {what} here is {ours} ({axis.path}); "
                f"{remedy}"
            )


def fault_notes_in(folders: Iterable[Path]) -> tuple[str, ...]:
    """Returns one line for each recorded file whose run tolerated faults."""
    found = []
    for folder in folders:
        if (folder / ABOUT_NAME).exists():
            tasks = tasks_of(read_yaml(folder / ABOUT_NAME).validate(RecordingFile))
            found += [(f"{folder.name}/{each.file}", each.survived) for each in tasks]
    return tuple(fault_notes(found))


def tasks_of(recording: Recording | RecordingFile) -> tuple[TaskEntry, ...]:
    """Returns the tasks of a calibration's recording; empty for any other recording."""
    return _Notes.model_validate({"plan": {}, **recording.notes}).tasks if "plan" in recording.notes else ()
