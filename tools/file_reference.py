"""Writes the generated parts of the docs: keys of files and plans from the pydantic models that read them,
and faults from the fault tables.

python tools/file_reference.py           rewrite the tables
python tools/file_reference.py --check   report if they are up to date (exit status 1 if not)
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from enum import Enum
from functools import cache
from itertools import groupby
from typing import Any, get_args

import generated
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from hdbridge.axis import AxisConfig
from hdbridge.axis.model.file import ModelFile
from hdbridge.axis.model.store import LogFile
from hdbridge.daemon.machinefile import MachineFile
from hdbridge.device.behaviour import Behaviour
from hdbridge.drive.supervision import TABLE, Fault, Reaction
from hdbridge.files.expectation import Field, field_at, key_of, type_words
from hdbridge.fleet.dataset import COLUMNS as FLEET_COLUMNS
from hdbridge.fleet.dataset import NESTED
from hdbridge.fleet.sources import MANIFEST
from hdbridge.motion.procedures.plan import (
    Plan,
    ReversalsEntry,
    SinesEntry,
    StandstillEntry,
    SteppingEntry,
    SweepEntry,
)
from hdbridge.records.record import OPTIONAL, REQUIRED
from hdbridge.records.recording import RecordingFile
from hdbridge.testing.faulttable import sentences

PAGES = tuple(
    generated.DOCS / f"{name}.md" for name in ("files", "calibration", "reliability", "fleet", "ci")
)
_BLOCK = re.compile(r"(<!-- generated: (?P<name>[a-z-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


REACTION_WORDS = {
    Reaction.GO: "count",
    Reaction.FREEZE: "freeze",
    Reaction.QUICK_STOP: "quick stop",
    Reaction.LATCH: "latch",
}
ENTRIES: tuple[type[BaseModel], ...] = (
    StandstillEntry,
    SweepEntry,
    SinesEntry,
    ReversalsEntry,
    SteppingEntry,
)


def key_list(model: type[BaseModel]) -> str:
    """Returns every key of a file with its expected value and its meaning, nested as in the file."""
    return "".join(
        f"{'    ' * depth}{_item(key, what, about)}"
        for depth, key, what, about in _rows(model)
        if key != "**`schema`**"
    )


def column_list() -> str:
    """Returns the columns of a record; required ones are bold."""
    required = (_item(f"**`{name}`**", "", about) for name, about in REQUIRED.items())
    optional = (_item(f"`{name}`", "", about) for name, about in OPTIONAL.items())
    return "".join([*required, *optional])


def procedure_list() -> str:
    """Returns the procedures of a plan, with the keys of each."""
    lines = []
    for entry in ENTRIES:
        _, *keys = _rows(entry)
        lines.append(f"- `{get_args(entry.model_fields['procedure'].annotation)[0]}`\n")
        lines += (f"    {_item(key, what, about)}" for _, key, what, about in keys)
    return "".join(lines)


def _item(name: str, value: str, about: str) -> str:
    return f"- {name}{value and f' ({value})'}: {about}\n"


SEEN_BY: Mapping[Fault, str] = {
    Fault.LOST_TPDO: "not all TPDOs within the window: lost, remote, 29-bit, cable pulled",
    Fault.OVERRUN: "more than half a period late; whole periods are skipped",
    Fault.HANG: "no cycle for heartbeat_ms or four cycles with power on; before the next SYNC",
    Fault.DUPLICATE_TPDO: "drained before SYNC, or twice in the window",
    Fault.WRONG_LENGTH: "the PDO's length",
    Fault.DISCARDED_FRAME: "remote, 29-bit, FD or error frame",
    Fault.FLOOD: "more than 256 frames before SYNC",
    Fault.EMERGENCY: "EMCY; the statusword decides. The newest 64 are kept",
    Fault.MASTER_LOST: "EMCY 8130h or 8250h while enabled; before the next SYNC",
    Fault.DRIVE_FAULT: "statusword, also if the state ended before the next SYNC",
    Fault.DROPPED_OUT: "the same",
    Fault.BOOT_UP: "boot-up message of a node of the cycle",
    Fault.NMT_CHANGE: "heartbeat of a node of the cycle",
    Fault.HEARTBEAT_LOST: "heartbeat older than twice heartbeat_ms",
    Fault.OWN_ID_ELSEWHERE: "RPDO, heartbeat of the master, NMT or SDO request from elsewhere",
    Fault.FOREIGN_SYNC: "SYNC from elsewhere",
    Fault.ENCODER_JUMP: "more than 1.5 x velocity limit x time + 180 arcsec at the load, while enabled",
    Fault.FOLLOWING_ERROR: "6062h minus 6064h above following_error_deg, while enabled",
    Fault.BAD_TARGET: "NaN, infinite, not an integer or outside the limits, before it is sent",
    Fault.BUS_DOWN: "any failing call, or the error frame: down, deleted, bus-off",
    Fault.TRANSMIT_FULL: "ENOBUFS; the frame is dropped, never sent again",
    Fault.CHANNEL_HELD: "its PDO, and the range in the axis file; the last reading is held",
    Fault.CHANNEL_LOST: "no reading for hold_ms; its part of the correction fades out",
}


def fault_list() -> str:
    """Returns the list of faults with the reactions to each."""
    lines = []
    for row in TABLE:
        later = f"; {REACTION_WORDS[row.then]}" if row.then is not row.first else ""
        lines.append(f"- **{row.fault.value}** ({REACTION_WORDS[row.first]}{later}): {SEEN_BY[row.fault]}\n")
    return "".join(lines)


def fleet_list(name: str) -> str:
    """Returns the columns of a data set of a fleet."""
    rows = []
    for column, (kind, about) in FLEET_COLUMNS[name].items():
        parts = NESTED.get(kind)
        words = f"list of {{{', '.join(parts)}}}" if parts else kind.replace("texts", "list of text")
        rows.append((column, words, about))
    return _grouped(rows)


def manifest_list() -> str:
    """Returns the columns of a manifest."""
    return _grouped((name, "", about) for name, about in MANIFEST.items())


def _grouped(rows: Iterable[tuple[str, str, str]]) -> str:
    """Returns rows as a list; adjacent rows with the same kind and meaning share a line."""
    groups = groupby(rows, key=lambda row: row[1:])
    return "".join(_item(", ".join(f"`{name}`" for name, *_ in same), *of) for of, same in groups)


def fault_names() -> str:
    """Returns the list of faults that can be injected into a simulated drive."""
    rows = [f"- `{name}({arguments})`: {what}" for name, arguments, what in sentences()]
    return "\n" + "\n".join(rows) + "\n\n"


BLOCKS: Mapping[str, Any] = {
    "axis": lambda: key_list(AxisConfig),
    "machine": lambda: key_list(MachineFile),
    "model": lambda: key_list(ModelFile),
    "columns": column_list,
    "recording": lambda: key_list(RecordingFile),
    "firmware": lambda: key_list(Behaviour),
    "history": lambda: key_list(LogFile),
    "faults": fault_list,
    "plan": lambda: key_list(Plan),
    "procedures": procedure_list,
    "fleet-recordings": lambda: fleet_list("recordings"),
    "fleet-findings": lambda: fleet_list("findings"),
    "manifest": manifest_list,
    "fault-names": fault_names,
}


def updated(page: str) -> str:
    """Returns the page with up-to-date generated blocks."""
    return _BLOCK.sub(lambda match: match[1] + BLOCKS[match["name"]]() + match[3], page)


_SHORTER = (
    (r"\ban? (mapping)(, not empty)?", ""),
    (r"\ban? (integer|number|list)\b", r"\1"),
    (r"\bfrom (\S+ to)", r"\1"),
    (r"\bnumber (above|from|-?\d)", r"\1"),
    (r"\b(of at least|at least)\b", "from"),
    (r", at most\b", " to"),
    (r"\bat most\b", "to"),
    (r"\b(text|list), not empty", r"\1"),
    (r"integer 0 to 4294967295", "32-bit integer"),
    (r"^(true or false|text)$", ""),
    (r"above (?=\d)", ">"),
    (r"(?<![-\w.])(\d[\d.]*) to (?=\d)", r"\1–"),
    (r" or '", ", '"),
    (r"'([^']*)'", r"`\1`"),
)
"""Replacements that shorten the wording of error messages for the tables, as patterns and texts."""


def _rows(
    model: type[BaseModel], prefix: str = "", shown: dict[type[BaseModel], str] | None = None
) -> Iterator[tuple[int, str, str, str]]:
    """Yields depth, key (bold if required), expected value with default, and meaning of each key.

    A mapping that is already ``shown`` becomes a reference to its first place.
    """
    shown = ({} if model is AxisConfig else dict(_of_the_axis_file())) if shown is None else shown
    for name, info in model.model_fields.items():
        key = key_of(name, info)
        place = field_at(model, (key,))
        assert place is not None
        inner, many = _inner(place)
        what = type_words(place)
        for pattern, shorter in _SHORTER:
            what = re.sub(pattern, shorter, what)
        same = f"as {shown[inner]}" if inner in shown else ""
        value = ", ".join(each for each in (what, same, _default(key, info)) if each)
        shown_key = f"**`{key}`**" if info.is_required() else f"`{key}`"
        yield prefix.count("."), shown_key, value, place.description
        if inner is not None and inner not in shown:
            shown[inner] = f"`{prefix}{key}`"
            yield from _rows(inner, f"{prefix}{key}{'[]' if many else ''}.", shown)


@cache
def _of_the_axis_file() -> dict[type[BaseModel], str]:
    """Returns the mappings within an axis file, with their keys."""
    shown: dict[type[BaseModel], str] = {}
    list(_rows(AxisConfig, shown=shown))
    return {model: f"{key} of an axis file" for model, key in shown.items()}


def _inner(place: Field) -> tuple[type[BaseModel] | None, bool]:
    """Returns the model of a nested mapping or of the items of a list, and True for a list."""
    for member in place.types():
        if isinstance(member, type) and issubclass(member, BaseModel):
            return member, False
        for item in getattr(member, "__args__", ()):
            if isinstance(item, type) and issubclass(item, BaseModel):
                return item, True
    return None, False


def _default(key: str, info: FieldInfo) -> str:
    if info.is_required():
        return ""
    value = info.get_default(call_default_factory=True, validated_data={})
    if value is None or value is PydanticUndefined or value in ((), {}, "") or isinstance(value, BaseModel):
        return ""
    if isinstance(value, Enum):
        value = value.value
    if key == "index":
        return f"=`{value:#x}`"
    if isinstance(value, bool):
        return f"=`{value}`".lower()
    if isinstance(value, tuple):
        return f"=`{[*value]}`".replace(".0", "")
    return f"=`{value:g}`" if isinstance(value, float) else f"=`{value}`"


if __name__ == "__main__":
    sys.exit(generated.main({path: updated(path.read_text(encoding="utf-8")) for path in PAGES}))
