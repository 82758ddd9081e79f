"""Converts bus logs of any tool to recordings, for `fit` and `diagnose`.

Reads the formats of python-can. The PDO mapping is taken from the SDO traffic in the log, else from the axis
file. The log may come from any master. A sample consists of the data sent for one SYNC, at the time of that
SYNC; without SYNC, the data of one frame with both encoders. Nothing is interpolated.
"""

from __future__ import annotations

import gzip
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import can
import numpy as np

from hdbridge.axis import AxisConfig, Identity
from hdbridge.cia301 import NmtCommand, NmtState
from hdbridge.control.bench import record_of
from hdbridge.drive import objects
from hdbridge.drive.dictionary import dictionary_of
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.layout import OPTIONAL, PDOS_PER_KIND, Layout, Layouts, cyclic_mode, layouts, mapped
from hdbridge.drive.objects import Mode
from hdbridge.drive.pdo import PdoCodec, PdoLengthError
from hdbridge.drive.states import State
from hdbridge.errors import InputError
from hdbridge.files.expectation import one_line
from hdbridge.motion.procedures.moves import Sample
from hdbridge.records.record import Record, concatenate
from hdbridge.records.recording import GAP_CYCLES, PART_SAMPLES, Recording

READERS: Final[dict[str, Any]] = {
    ".log": can.CanutilsLogReader,
    ".asc": can.ASCReader,
    ".blf": can.BLFReader,
    ".trc": can.TRCReader,
    ".mf4": can.MF4Reader,
}
"""Readers by file name suffix, which .gz may follow."""
_BINARY: Final = {".blf", ".mf4"}
FOLLOWED_SHARE: Final = 0.5
"""Minimum fraction of the samples in motion at which the target changes. Above it, the target counts as the
command of each cycle."""
_SINCE_1970_S: Final = 1e9
"""Smallest time stamp that counts as absolute (seconds since 1970); smaller ones are relative."""
_RESETS: Final = (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION)


def import_log(
    path: Path, axis: AxisConfig, *, channel: str | None = None, all_states: bool = False
) -> Recording:
    """Returns the recording of one axis from a bus log; ``channel`` selects one of several buses.

    Samples with the drive not enabled are left out unless ``all_states``. A new part begins at a gap and when
    the drive boots. The notes state the origin of the mapping.

    Raises InputError if the log cannot be read, has no sample of the axis, or contradicts the gear's ratio.
    """
    buses: dict[str, _Bus] = {}
    heard: Counter[int] = Counter()
    cut_off: list[str] = []
    for message in messages(path, cut_off):
        name = str(message.channel)
        if channel is not None and name != channel:
            continue
        heard[message.arbitration_id] += 1
        if name not in buses:
            buses[name] = _Bus(axis, all_states=all_states)
        buses[name].take(message.arbitration_id, bytes(message.data), message.timestamp)
    for bus in buses.values():
        bus.end_window()
    found = {name: bus for name, bus in buses.items() if bus.samples}
    if not found:
        reasons = [bus.why_empty() for bus in buses.values() if bus.has_heard]
        raise InputError(one_line(f"{path}: {reasons[0] if reasons else _silence(axis, heard, channel)}"))
    if len(found) > 1:
        raise InputError(
            f"{path}: node {axis.drive.node_id} is on the channels {', '.join(found)}; choose one: --channel"
        )
    name, bus = next(iter(found.items()))
    recording = bus.recording(path, name)
    return replace(recording, notes={**recording.notes, "cut_off": cut_off[0]}) if cut_off else recording


def messages(path: Path, cut_off: list[str]) -> Iterator[can.Message]:
    """Yields the data frames with 11-bit identifiers; ``cut_off`` receives damage that ends the log early."""
    packed = path.suffix.lower() == ".gz"
    suffix = (path.with_suffix("") if packed else path).suffix.lower()
    if suffix not in READERS:
        raise InputError(
            f"{path}: the name of a bus log ends in one of {', '.join(READERS)}, or also in .gz (candump -l "
            "writes .log); rename it"
        )
    count = 0
    text: dict[str, Any] = {} if suffix in _BINARY else {"encoding": "utf-8", "errors": "replace"}
    opened: Any = gzip.open if packed else open
    try:
        with opened(path, "rt" if text else "rb", **text) as file, READERS[suffix](file) as reader:
            for message in reader:
                count += 1
                if not (message.is_extended_id or message.is_error_frame or message.is_remote_frame):
                    yield message
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except NotImplementedError:
        raise InputError(
            f"{path}: MF4 logs are read with asammdf, which is not installed: pip install 'hdbridge[mf4]'"
        ) from None
    except InputError:
        raise
    except Exception as problem:  # python-can's readers raise exceptions of many types
        why = str(problem) or type(problem).__name__
        if count:
            cut_off.append(one_line(f"damaged after {count} frames: {why}"))
            return
        raise InputError(
            one_line(
                f"{path}: cannot be read as a {suffix} log: {why}; expected what its format says "
                "(candump: as -l or -L writes it)"
            )
        ) from None


def _silence(axis: AxisConfig, heard: Counter[int], channel: str | None) -> str:
    """Returns the message for a log without a PDO of the axis."""
    where = f" on channel {channel}" if channel is not None else ""
    most = ", ".join(f"{can_id:03X}h" for can_id, _ in heard.most_common(8))
    return (
        f"no PDO of node {axis.drive.node_id} in {heard.total()} frames{where}"
        + (f" (most frequent: {most})" if most else "")
        + "; expected a log of the bus of this axis: compare drive.node_id in the axis file"
    )


class _Bus:
    """Collects the samples of one axis from one channel of the log."""

    def __init__(self, axis: AxisConfig, *, all_states: bool) -> None:
        self._axis, self._od, self._all_states = axis, dictionary_of(axis), all_states
        self._nodes = axis.nodes
        self._requests = {objects.COB_SDO_REQUEST + each: each for each in self._nodes}
        self._answers = {objects.COB_SDO_ANSWER + each: each for each in self._nodes}
        self._boots = {objects.COB_HEARTBEAT + each for each in self._nodes}
        self._asked: dict[int, tuple[int, int, int]] = {}
        self._held: dict[tuple[int, int, int], int] = {}
        """Object values from the SDO traffic, by node, index and sub-index."""
        self._image: ProcessImage | None = None
        self._needed: frozenset[int] = frozenset()
        """Identifiers of the PDOs that carry the encoders."""
        self._missing: list[str] = []
        """Encoders that no PDO carries."""
        self._is_free = False
        """True if the PDO of an encoder does not come with SYNC."""
        self._targets: dict[int, tuple[PdoCodec, int]] = {}
        self._fresh: set[int] = set()
        self._sync_s: float | None = None
        self._target: int | None = None
        self._targets_heard = 0
        self._parts: list[list[Sample]] = [[]]
        self._seated, self._reseated = False, False
        self._disabled = 0
        self._wrong: dict[int, int] = {}
        self.has_heard = False
        """True if the log has a PDO of the axis."""
        self.source = ""
        """Origin of the mapping, in words."""

    @property
    def samples(self) -> int:
        """Number of samples."""
        return sum(map(len, self._parts))

    def take(self, can_id: int, data: bytes, time_s: float) -> None:
        """Processes the next frame of the log."""
        if can_id in self._requests or can_id in self._answers:
            if len(data) == 8:
                self._take_sdo(can_id, data)
        elif can_id == self._held.get((self._axis.drive.node_id, 0x1005, 0), objects.COB_SYNC) & 0x7FF:
            self.end_window()
            self._sync_s = time_s
        elif can_id in self._boots or can_id == objects.COB_NMT:
            booted = can_id in self._boots and data[:1] == bytes([NmtState.BOOT_UP])
            reset = can_id == objects.COB_NMT and data[:1] in [bytes([each]) for each in _RESETS]
            if booted or (reset and data[1:2] in {b"\0", *(bytes([each]) for each in self._nodes)}):
                self._begin(unseated=True)
        else:
            self._take_pdo(can_id, data, time_s)

    # -- SDO ----------------------------------------------------------------------------------------------

    def _take_sdo(self, can_id: int, data: bytes) -> None:
        """Processes an SDO frame of an expedited transfer (up to 4 bytes). A write counts once confirmed."""
        command, index, sub = data[0], int.from_bytes(data[1:3], "little"), data[3]
        size = 4 - (command >> 2 & 3) if command & 1 else 4
        value = int.from_bytes(data[4 : 4 + size], "little")
        is_expedited = bool(command & 2)
        if node := self._requests.get(can_id):
            self._asked.pop(node, None)
            if command >> 5 == 1 and is_expedited:
                self._asked[node] = index, sub, value
            return
        node = self._answers[can_id]
        if command >> 5 == 2 and is_expedited:
            self._hold(node, index, sub, value)
        elif command >> 5 == 3 and self._asked.get(node, ())[:2] == (index, sub):
            self._hold(node, *self._asked[node])
        self._asked.pop(node, None)

    def _hold(self, node: int, index: int, sub: int, value: int) -> None:
        before = self._held.get((node, index, sub))
        self._held[node, index, sub] = value
        is_pdo = any(
            first <= index < first + PDOS_PER_KIND
            for first in (
                objects.RPDO_COMMUNICATION,
                objects.RPDO_MAPPING,
                objects.TPDO_COMMUNICATION,
                objects.TPDO_MAPPING,
            )
        )
        if is_pdo and before != value:
            self._image = None
        if index == objects.MODE.index and value == Mode.HM:
            self._begin(unseated=True)

    def _layouts(self) -> Layouts:
        """Returns the PDOs of each node as mapped in the log, else as in the axis file."""
        drive, load = self._nodes[0], self._nodes[-1]
        tpdo = objects.TPDO_COMMUNICATION, objects.TPDO_MAPPING, objects.COB_TPDO1
        sent = {node: list(self._logged(node, *tpdo)) for node in dict.fromkeys((drive, load))}
        received = list(
            self._logged(drive, objects.RPDO_COMMUNICATION, objects.RPDO_MAPPING, objects.COB_RPDO1)
        )
        assumed = [node for node, found in sent.items() if not found]
        if assumed or not received:
            axis_file = layouts(self._axis, self._od)
            received = received or list(axis_file.rpdos)
            for node in assumed:
                sent[node] = [
                    each for each in (*axis_file.cyclic, *axis_file.channels) if each.node_id == node
                ]
        self.source = "the axis file" if assumed else "the log's SDO traffic"
        tpdos = tuple(each for found in sent.values() for each in found)
        carried = {(entry.index, entry.sub) for each in tpdos for entry in each.codec.entries}
        absent = tuple(each for each in OPTIONAL if (each.index, each.sub) not in carried)
        return Layouts(tpdos, (), tuple(received), absent)

    def _logged(self, node: int, communication: int, mapping: int, first_id: int) -> Iterator[Layout]:
        held = self._held
        for place in range(PDOS_PER_KIND):
            count = held.get((node, mapping + place, 0), 0)
            words = [held.get((node, mapping + place, sub)) for sub in range(1, count + 1)]
            predefined = first_id + 0x100 * place + node if place < 4 else objects.PDO_INVALID
            can_id = held.get((node, communication + place, 1), predefined)
            entries = mapped(self._od, words)
            if entries and not can_id & objects.PDO_INVALID:
                every = held.get((node, communication + place, 2), 1)
                yield Layout(node, place + 1, can_id & 0x7FF, PdoCodec(entries), every)

    # -- PDO ----------------------------------------------------------------------------------------------

    def _mapped_image(self) -> ProcessImage:
        """Returns the process image for the current mapping."""
        if self._image is None:
            pdos = self._layouts()
            self._image = ProcessImage(self._axis, self._od, pdos)
            source, node = self._axis.load_encoder.source, self._axis.drive.node_id
            position = objects.POSITION_ACTUAL
            encoders = {
                (node, position.index, position.sub),
                (source.node or node, source.index, source.subindex),
            }
            places = {
                (each.node_id, entry.index, entry.sub): each
                for each in reversed(pdos.cyclic)
                for entry in each.codec.entries
            }
            carrying = [places.get(each) for each in encoders]
            self._needed = frozenset(each.can_id for each in carrying if each is not None)
            self._missing = [
                f"{index:04X}h:{sub:02X}" for key in encoders - places.keys() for _, index, sub in [key]
            ]
            self._is_free = any(each is not None and not 0 <= each.every <= 240 for each in carrying)
            target = cyclic_mode(self._axis).target
            self._targets = {
                each.can_id: (each.codec, each.codec.positions[target.index, target.sub])
                for each in pdos.rpdos
                if (target.index, target.sub) in each.codec.positions
            }
            self._begin()
        return self._image

    def _take_pdo(self, can_id: int, data: bytes, time_s: float) -> None:
        image = self._mapped_image()
        try:
            if can_id in self._targets:
                codec, place = self._targets[can_id]
                self._target = codec.unpack(data)[place]
                return
            if not image.accept(can_id, data):
                return
        except PdoLengthError:
            self._wrong[can_id] = len(data)
            self.has_heard = True
            return
        self.has_heard = True
        if self._sync_s is not None and not self._is_free:
            self._fresh.add(can_id)
        elif self._needed == {can_id}:
            self._sample(image, time_s)

    def end_window(self) -> None:
        """Ends a SYNC period; it becomes a sample if both encoders were received."""
        image = self._image
        if image is None or self._sync_s is None or self._is_free:
            return
        if self._needed <= self._fresh and not self._missing:
            self._sample(image, self._sync_s)
        self._fresh.clear()

    def _sample(self, image: ProcessImage, time_s: float) -> None:
        if self._missing:
            return
        image.step_channels()
        self._seated = True
        if self._all_states or image.statusword is None or image.power.state is State.OPERATION_ENABLED:
            torque_nm = self._axis.motor_encoder.direction * self._axis.drive.rated_torque_nm / 1000.0
            has_demand = image.has_demand or self._targets_heard > 1
            self._parts[-1].append(
                Sample(
                    time_s,
                    math.nan,
                    image.motor_deg(image.demand_counts) if has_demand else math.nan,
                    image.motor_deg(image.motor_counts),
                    image.load_deg(image.load_counts),
                    image.torque_permille * torque_nm,
                    image.readings,
                )
            )
        else:
            self._disabled += 1
        if self._target is not None:
            self._targets_heard += 1
            image.follow_target(self._target)

    def _begin(self, *, unseated: bool = False) -> None:
        """Begins a new part; the path of the axis between two parts is unknown."""
        self._reseated |= unseated and self._seated
        self._target, self._targets_heard = None, 0
        self._fresh.clear()
        if self._parts[-1]:
            self._parts.append([])

    # -- the result ---------------------------------------------------------------------------------------

    def why_empty(self) -> str:
        """Returns the message for a channel with PDOs of the axis but without a sample."""
        image = self._mapped_image()
        pdos = "; ".join(map(str, image.tpdos))
        boot = (
            ": the log has no SDO traffic that maps them, so this is the mapping of the axis file; log "
            "from the drive's boot-up on"
            if self.source == "the axis file"
            else ""
        )
        if self._missing:
            missing = " and ".join(self._missing)
            return f"no PDO carries {missing} (there are {pdos}); expected both encoders in PDOs"
        if wrong := {each: self._wrong[each] for each in self._needed if each in self._wrong}:
            can_id, length = next(iter(wrong.items()))
            expected = f"{image.length_of(can_id)} by the mapping {pdos}"
            return f"{can_id:03X}h has {length} bytes; expected {expected}{boot}"
        if self._disabled:
            return f"the drive was never enabled in {self._disabled} samples; --all-states takes them"
        needed = " and ".join(f"{each:03X}h" for each in sorted(self._needed))
        if self._sync_s is None or self._is_free:
            return (
                f"the encoders come in different PDOs ({needed}) that no SYNC ties together; expected "
                "them in one PDO, or with SYNC"
            )
        return f"no SYNC period has both encoders ({needed}){boot}"

    def recording(self, path: Path, channel: str) -> Recording:
        """Returns all parts as one recording."""
        pieces = [piece for part in self._parts for piece in _unbroken(part)]
        long = [each for each in pieces if len(each) >= PART_SAMPLES]
        long = [_from_first_target(each) for each in long]
        if not long:
            raise InputError(
                f"{path}: {self.samples} samples, fewer than {PART_SAMPLES} in a row; expected a longer log"
            )
        record = concatenate([record_of(each, self._axis) for each in long])
        target = record.columns["motor_target_deg"]
        if np.isnan(target).any() or not _is_followed(record):
            columns = {name: each for name, each in record.columns.items() if name != "motor_target_deg"}
            record = replace(record, columns=columns)
        begin_s = float(record.time_s[0])
        record = replace(record, columns={**record.columns, "time_s": record.time_s - begin_s})
        try:
            record.check_ratio(self._axis.gear.ratio, str(self._axis.path))
        except InputError as problem:
            assumed = self.source == "the axis file"
            more = "; the mapping is that of the axis file, the log may use another" if assumed else ""
            raise InputError(one_line(f"{path}: {problem}{more}")) from None
        pdos = "; ".join(map(str, self._mapped_image().tpdos))
        notes: dict[str, Any] = {
            "source": path.name,
            "channel": channel,
            "mapping": f"by {self.source}: {pdos}",
            "parts": len(long),
            "parts_too_short": len(pieces) - len(long),
            "zeros_may_differ": self._reseated,
        }
        return Recording(
            record,
            axis=self._axis.name,
            ratio=self._axis.gear.ratio,
            drive=self._identity(),
            date=datetime.fromtimestamp(begin_s, UTC).isoformat(timespec="seconds")
            if begin_s > _SINCE_1970_S
            else None,
            notes={name: value for name, value in notes.items() if value not in (0, False)},
        )

    def _identity(self) -> Identity | None:
        """Returns the identity that the drive reported in the log."""
        numbers = [self._held.get((self._axis.drive.node_id, 0x1018, sub)) for sub in range(1, 5)]
        if numbers[0] is None or numbers[1] is None:
            return None
        return Identity(vendor_id=numbers[0], product_code=numbers[1], revision=numbers[2], serial=numbers[3])


def _unbroken(samples: list[Sample]) -> list[list[Sample]]:
    """Splits samples at gaps and at time stamps that run backwards."""
    steps = np.diff([each.time_s for each in samples])
    if not len(steps):
        return [samples] if samples else []
    cuts = np.flatnonzero((steps <= 0.0) | (steps > (GAP_CYCLES + 1) * np.median(steps))) + 1
    edges = [0, *cuts.tolist(), len(samples)]
    return [samples[first:end] for first, end in pairwise(edges)]


def _from_first_target(samples: list[Sample]) -> list[Sample]:
    """Drops the samples before the first target, if any."""
    first = next((row for row, each in enumerate(samples) if not math.isnan(each.motor_target_deg)), 0)
    return samples[first:]


def _is_followed(record: Record) -> bool:
    """Returns True if the target is commanded in each cycle, False if it is the end of a planned move."""
    target, motor = np.diff(record.columns["motor_target_deg"]), np.diff(record.motor_position_deg)
    fast = np.abs(motor) > 0.1 * np.max(np.abs(motor), initial=0.0)
    return bool(np.mean(target[fast] != 0.0) > FOLLOWED_SHARE) if np.any(fast) else True
