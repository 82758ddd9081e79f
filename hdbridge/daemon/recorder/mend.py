"""Repair of unfinished files: rewrites them up to their last complete chunk, with an index."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Final

from mcap.records import Attachment, Channel, Footer, Header, Message, Metadata, Schema
from mcap.writer import Writer

from hdbridge.daemon.recorder.flightfile import PART
from hdbridge.daemon.recorder.reading import SUFFIX, GoneError, records_of
from hdbridge.errors import InputError, OutputError

MENDING: Final = ".mending"
CHUNK_BYTES: Final = 1 << 20


def mend_folder(folder: Path, say: Callable[[str], None] = lambda _: None) -> list[Path]:
    """Repairs every unfinished file of a folder that is not being written; returns the repaired files.

    Removes files without a complete chunk. Reports files that cannot be repaired, without changing them.
    """
    mended = []
    for leftover in sorted(folder.glob(f".*{MENDING}")):
        leftover.unlink(missing_ok=True)
    for part in sorted(folder.glob(f"*{SUFFIX}{PART}")):
        try:
            path = mend(part)
        except GoneError:
            continue
        except (InputError, OutputError) as problem:
            say(str(problem))
            continue
        if path is not None:
            mended.append(path)
    return mended


def mend(path: Path) -> Path | None:
    """Repairs one file; returns its new name, or None if it had no complete chunk and was removed.

    Does not change a finished file. Raises InputError if the file is being written, `GoneError` if it no
    longer exists, OutputError if there is no space.
    """
    target = path.with_name(path.name.removesuffix(PART))
    aside = target.with_name(f".{target.name}{MENDING}")
    try:
        with path.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise InputError(f"{path}: is being written; expected one whose daemon has ended") from None
            with aside.open("wb") as out:
                messages, finished = _copied(path, file, out)
                out.flush()
                os.fsync(out.fileno())
            if finished and target == path:
                aside.unlink()
            elif messages:
                aside.rename(target)
                if target != path:
                    path.unlink()
            else:
                aside.unlink()
                path.unlink()
                return None
            _sync_folder(path.parent)
    except FileNotFoundError:
        aside.unlink(missing_ok=True)
        raise GoneError(
            f"{path}: there is no such file; another process has finished or removed it"
        ) from None
    except OSError as problem:
        aside.unlink(missing_ok=True)
        raise OutputError(
            f"{path}: cannot be repaired: {problem.strerror}; free some space, then repair it again"
        ) from None
    return target


def _copied(path: Path, file: BinaryIO, out: BinaryIO) -> tuple[int, bool]:
    """Copies every complete record; returns the number of messages, and True if the file was finished."""
    writer = Writer(out, chunk_size=CHUNK_BYTES)
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    messages = 0
    begun = finished = False
    for record in records_of(file, path):
        match record:
            case Header():
                writer.start(record.profile, record.library)
                begun = True
            case Schema():
                if record.id not in schemas:
                    schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            case Channel():
                if record.id not in channels:
                    channels[record.id] = writer.register_channel(
                        record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                    )
            case Message():
                writer.add_message(
                    channels[record.channel_id],
                    record.log_time,
                    record.data,
                    record.publish_time,
                    record.sequence,
                )
                messages += 1
            case Metadata():
                writer.add_metadata(record.name, record.metadata)
            case Attachment():
                writer.add_attachment(
                    record.create_time, record.log_time, record.name, record.media_type, record.data
                )
            case Footer():
                finished = True
    if begun:
        writer.finish()  # type: ignore[no-untyped-call]
    return messages, finished


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
