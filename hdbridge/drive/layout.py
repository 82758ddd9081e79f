"""Contents of each PDO, derived from what the axis needs and what its drive offers. Pure.

A drive with configurable mappings uses

    TPDO1 180h+id  statusword, position, torque        8 bytes
    TPDO2 280h+id  load encoder, position demand       8 bytes (4 if the load encoder has its own node id)
    TPDO3 380h+id  load torque, temperature            if the axis has them; length of its objects
    TPDO4 480h+id  temperature                         if it is sent less often than the load torque
    RPDO1 200h+id  controlword, target                 6 bytes

A read-only mapping is used unchanged if it contains a needed object; the remaining objects go into the other
PDOs. Position demand and torque are left out if the drive cannot send them. A load encoder with its own node
id sends its TPDO1.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Final, NamedTuple

from canopen.objectdictionary import ObjectDictionary, ODVariable

from hdbridge.axis import AxisConfig, Source
from hdbridge.axis.channels import ChannelSource
from hdbridge.drive import objects
from hdbridge.drive.dictionary import dictionary_of, find, held, integer_type
from hdbridge.drive.objects import PDO_INVALID, Address, CyclicMode, IntegerType
from hdbridge.drive.pdo import MAX_BYTES, PdoCodec, PdoEntry
from hdbridge.errors import InputError

PDOS_PER_KIND: Final = 512
_PREDEFINED: Final = 4
"""Number of PDOs of each kind with a predefined identifier (CiA 301)."""
_STEP: Final = 0x100
_MOST_ENTRIES: Final = 64
_LAST_SYNCHRONOUS: Final = 240
_EXTENDED: Final = 0x2000_0000
OPTIONAL: Final = (objects.TORQUE_ACTUAL, objects.POSITION_DEMAND)
"""Objects that the control cycle uses if the drive can send them, most important first."""


class Layout(NamedTuple):
    """One PDO of an axis: its node, its number (1..), its identifier and its mapping."""

    node_id: int
    number: int
    can_id: int
    codec: PdoCodec
    every: int = 1
    """Number of SYNCs per transmission."""
    is_fixed: bool = False
    """True if the drive's mapping is read-only."""

    def __str__(self) -> str:
        """For example ``181h: 6041h:00 uint16, 6064h:00 int32``."""
        return f"{self.can_id:03X}h: {', '.join(map(str, self.codec.entries))}"


class Layouts(NamedTuple):
    """All PDOs of an axis."""

    cyclic: tuple[Layout, ...]
    """TPDOs that each cycle waits for."""
    channels: tuple[Layout, ...]
    """TPDOs that carry only optional channels."""
    rpdos: tuple[Layout, ...]
    """PDOs that the master sends."""
    absent: tuple[Address, ...]
    """Objects of `OPTIONAL` that are in no TPDO."""


class _Offer(NamedTuple):
    """PDO of the drive, before objects are assigned to it."""

    number: int
    capacity: int
    """Number of objects that the PDO can map."""
    fixed: tuple[PdoEntry, ...] | None
    """Entries of a read-only mapping; None if the mapping can be written."""
    can_id: int | None
    """Identifier of the PDO, if fixed by the drive."""
    every: int | None
    """Transmission type, if fixed by the drive."""


def cyclic_mode(axis: AxisConfig) -> CyclicMode:
    """Returns the mode of operation of the control cycle."""
    return objects.CYCLIC[axis.drive.mode]


def layouts(axis: AxisConfig, od: ObjectDictionary | None = None) -> Layouts:
    """Returns the PDOs of an axis; ``od`` defaults to the dictionary of its EDS.

    Raises `InputError` with the line of the axis file if the drive cannot send or receive a needed object.
    """
    od = dictionary_of(axis) if od is None else od
    offers = list(_offers(od, objects.TPDO_COMMUNICATION, objects.TPDO_MAPPING))
    receivers = list(_offers(od, objects.RPDO_COMMUNICATION, objects.RPDO_MAPPING))
    _check_needed(axis, od, offers, receivers)
    node_id, source = axis.drive.node_id, axis.load_encoder.source
    load = PdoEntry(source.index, source.subindex, IntegerType.named(source.type))
    senders = [each for each in offers if each.every is None or 1 <= each.every <= _LAST_SYNCHRONOUS]
    needed = [_entry(od, objects.STATUSWORD), _entry(od, objects.POSITION_ACTUAL)]
    needed += [load] if source.node is None else []
    optional = [_entry(od, each) for each in OPTIONAL if _can_be_sent(od, each, senders)]
    for kept in (optional, optional[:-1], []):
        torque = [each for each in kept if each.index == objects.TORQUE_ACTUAL.index]
        demand = [each for each in kept if each not in torque]
        chosen = _assign([*needed[:2], *torque, *needed[2:], *demand], senders, 1)
        if chosen is not None:
            break
    else:
        raise InputError(
            f"{axis.where('drive.eds')}: the TPDOs of {axis.drive.eds} cannot carry "
            f"{', '.join(map(str, needed))} with every SYNC: {_described(offers)}; "
            "expected a drive whose TPDOs can"
        )
    taken = {each.can_id for each in offers if each.can_id is not None}
    cyclic = list(_laid_out(node_id, objects.COB_TPDO1, chosen, taken, 1))
    carried = {(entry.index, entry.sub) for each in cyclic for entry in each.codec.entries}
    used = {offer.number for offer, _ in chosen}
    channels = _channel_layouts(axis, [each for each in senders if each.number not in used], carried, taken)
    if source.node is not None:
        cyclic.append(Layout(source.node, 1, objects.COB_TPDO1 + source.node, PdoCodec([load])))
    absent = tuple(each for each in OPTIONAL if (each.index, each.sub) not in carried)
    return Layouts(tuple(cyclic), tuple(channels), _receiving(axis, od, receivers), absent)


def _channel_layouts(
    axis: AxisConfig, offers: Sequence[_Offer], carried: set[tuple[int, int]], taken: set[int]
) -> list[Layout]:
    """Groups the channels by rate and assigns one or more TPDOs to each group."""
    together: dict[int, dict[str, PdoEntry]] = {}
    for key, channel in axis.channels.items():
        source = channel.source
        if (source.index, source.subindex) not in carried:
            entry = PdoEntry(source.index, source.subindex, IntegerType.named(source.type))
            together.setdefault(channel.every_cycles, {})[key] = entry
    found: list[Layout] = []
    left = list(offers)
    for every, entries in together.items():
        chosen = _assign(list(entries.values()), left, every)
        if chosen is None:
            key = next(reversed(entries))
            raise InputError(
                f"{axis.where(key)}: no TPDO is left for it: the drive has {len(offers)} beyond those of the "
                "encoders; give it the every_cycles of another channel, or leave it out"
            )
        found += _laid_out(axis.drive.node_id, objects.COB_TPDO1, chosen, taken, every)
        left = [each for each in left if each.number not in {offer.number for offer, _ in chosen}]
    return found


def _receiving(axis: AxisConfig, od: ObjectDictionary, offers: Sequence[_Offer]) -> tuple[Layout, ...]:
    needs = [_entry(od, objects.CONTROLWORD), _entry(od, cyclic_mode(axis).target)]
    chosen = _assign(needs, offers, None)
    if chosen is None:
        raise InputError(
            f"{axis.where('drive.eds')}: the RPDOs of {axis.drive.eds} cannot carry "
            f"{', '.join(map(str, needs))}: {_described(offers)}; expected a drive whose RPDOs can"
        )
    taken = {each.can_id for each in offers if each.can_id is not None}
    return tuple(_laid_out(axis.drive.node_id, objects.COB_RPDO1, chosen, taken, 1))


# -- capabilities of the drive ----------------------------------------------------------------------------


def _offers(od: ObjectDictionary, communication: int, mapping: int) -> Iterator[_Offer]:
    """Yields the PDOs of a kind, given the indices of its first communication and mapping parameters."""
    for place in (index - communication for index in od):
        if not 0 <= place < PDOS_PER_KIND:
            continue
        cob_id, count = find(od, communication + place, 1), find(od, mapping + place, 0)
        if cob_id is None or count is None:
            continue
        words: list[ODVariable] = []
        while len(words) < _MOST_ENTRIES and (word := find(od, mapping + place, len(words) + 1)) is not None:
            words.append(word)
        fixed: tuple[PdoEntry, ...] | None = None
        if not all(each.writable for each in (count, *words)):
            fixed = mapped(od, [held(each) for each in words[: held(count) or 0]])
        can_id = None
        if not cob_id.writable:
            can_id = held(cob_id)
            if can_id is not None and can_id & (PDO_INVALID | _EXTENDED):
                continue
            can_id = can_id & 0x7FF if can_id else None
        kind = find(od, communication + place, 2)
        every = held(kind) if kind is not None and not kind.writable else None
        yield _Offer(place + 1, len(words), fixed, can_id, every)


def mapped(od: ObjectDictionary, words: Iterable[int | None]) -> tuple[PdoEntry, ...]:
    """Decodes a mapping; empty if a word is unknown or the length is not a whole number of bytes."""
    entries = []
    for word in words:
        if word is None:
            return ()
        index, sub, bits = word >> 16, word >> 8 & 0xFF, word & 0xFF
        standard = objects.STANDARD.get((index, sub))
        variable = find(od, index, sub)
        kind = integer_type(variable) if variable is not None else standard.type if standard else None
        if kind is None or kind.bits != bits:
            kind = next((each for each in IntegerType if each.bits == bits and not each.signed), None)
        if kind is None:
            return ()
        entries.append(PdoEntry(index, sub, kind))
    return tuple(entries) if 0 < sum(each.type.bits for each in entries) <= 8 * MAX_BYTES else ()


def _entry(od: ObjectDictionary, address: Address) -> PdoEntry:
    """Returns the PDO entry of an object, with the type given by the EDS."""
    variable = find(od, address.index, address.sub)
    kind = integer_type(variable) if variable is not None else None
    return PdoEntry(address.index, address.sub, kind or address.type)


def _can_be_sent(od: ObjectDictionary, address: Address, offers: Iterable[_Offer]) -> bool:
    variable = find(od, address.index, address.sub)
    if variable is None or integer_type(variable) is None:
        return False
    return variable.pdo_mappable or _is_carried(address.index, address.sub, offers)


def _is_carried(index: int, sub: int, offers: Iterable[_Offer]) -> bool:
    return any((entry.index, entry.sub) == (index, sub) for each in offers for entry in each.fixed or ())


def _described(offers: Sequence[_Offer]) -> str:
    """Describes the available PDOs, for a message."""
    fixed = sum(each.fixed is not None for each in offers)
    if not offers:
        return "it has none"
    return f"it has {len(offers)}" + (f", {fixed} of them with a fixed mapping" if fixed else "")


# -- assignment -------------------------------------------------------------------------------------------

_Choice = list[tuple[_Offer, tuple[PdoEntry, ...]]]


def _assign(needs: list[PdoEntry], offers: Sequence[_Offer], slowest: int | None) -> _Choice | None:
    """Assigns objects to PDOs; returns the chosen PDOs with their entries, or None if not all fit.

    Read-only mappings are used first, because a free mapping can take the remaining objects. With
    ``slowest``, only PDOs sent at least every ``slowest`` SYNCs are used.
    """
    usable = [each for each in offers if each.every is None or slowest is None or each.every <= slowest]
    chosen: _Choice = []
    left = list(needs)
    while left:
        best = max(usable, key=lambda each: len(_covered(left, each)), default=None)
        if best is None or not _covered(left, best):
            break
        assert best.fixed is not None
        chosen.append((best, best.fixed))
        left = [each for each in left if each not in best.fixed]
    free = iter([each for each in usable if each.fixed is None])
    opened: list[tuple[_Offer, list[PdoEntry]]] = []
    for need in left:
        room = next((each for each in opened if _fits(need, *each)), None)
        if room is None:
            offer = next((each for each in free if each.capacity), None)
            if offer is None:
                return None
            room = (offer, [])
            opened.append(room)
        room[1].append(need)
    return sorted(
        [*chosen, *((offer, tuple(entries)) for offer, entries in opened)], key=lambda each: each[0].number
    )


def _covered(needs: Iterable[PdoEntry], offer: _Offer) -> list[PdoEntry]:
    return [each for each in needs if each in (offer.fixed or ())]


def _fits(need: PdoEntry, offer: _Offer, entries: Sequence[PdoEntry]) -> bool:
    bits = need.type.bits + sum(each.type.bits for each in entries)
    return bits <= 8 * MAX_BYTES and len(entries) < offer.capacity


def _laid_out(node_id: int, first: int, chosen: _Choice, taken: set[int], every: int) -> Iterator[Layout]:
    """Yields the layouts of the chosen PDOs, each with its CAN identifier.

    ``first`` is the function code of the first PDO of this kind. The identifiers used are added to ``taken``.
    """
    predefined = [first + _STEP * place + node_id for place in range(_PREDEFINED)]
    reserved = {predefined[offer.number - 1] for offer, _ in chosen if offer.number <= _PREDEFINED}
    for offer, entries in chosen:
        can_id = offer.can_id
        if can_id is None and offer.number <= _PREDEFINED:
            can_id = predefined[offer.number - 1]
        if can_id is None:
            can_id = next((each for each in predefined if each not in taken | reserved), None)
        if can_id is None:
            raise InputError(
                f"PDO {offer.number} of node {node_id}: all identifiers of the node's PDOs are taken by PDOs "
                "that cannot be changed; expected a drive with a free one"
            )
        taken.add(can_id)
        own = every if offer.every is None else offer.every
        yield Layout(node_id, offer.number, can_id, PdoCodec(entries), own, offer.fixed is not None)


# -- checks against the EDS -------------------------------------------------------------------------------


def _check_needed(
    axis: AxisConfig, od: ObjectDictionary, senders: Sequence[_Offer], receivers: Sequence[_Offer]
) -> None:
    """Raises `InputError` if the EDS lacks a needed object or contradicts a source in the axis file."""
    target = cyclic_mode(axis).target
    needed = (*objects.REQUIRED, target)
    lacking = [str(each) for each in needed if find(od, each.index, each.sub) is None]
    where, eds = axis.where("drive.eds"), axis.drive.eds
    if lacking:
        named = ", ".join(lacking[:4]) + (f" and {len(lacking) - 4} more" if len(lacking) > 4 else "")
        raise InputError(
            f"{where}: {eds} lacks {named}, which hdbridge requires; expected the EDS file of this "
            "drive, with all of its objects"
        )
    for address, offers in (
        (objects.STATUSWORD, senders),
        (objects.POSITION_ACTUAL, senders),
        (objects.CONTROLWORD, receivers),
        (target, receivers),
    ):
        variable = find(od, address.index, address.sub)
        assert variable is not None
        if not (variable.pdo_mappable or _is_carried(address.index, address.sub, offers)):
            raise InputError(
                f"{where}: {eds} says that {address} cannot be mapped to a PDO; expected a drive that can"
            )
    if complaint := next(_source_complaints(axis, od, senders), None):
        raise InputError(complaint)


def _source_complaints(axis: AxisConfig, od: ObjectDictionary, offers: Sequence[_Offer]) -> Iterator[str]:
    """Yields an error for each source that is missing, has a different type or cannot be mapped."""
    sources: dict[str, Source | ChannelSource] = {}
    if axis.load_encoder.source.node is None:
        sources["load_encoder"] = axis.load_encoder.source
    sources.update({key: each.source for key, each in axis.channels.items()})
    eds = axis.drive.eds
    for key, source in sources.items():
        name = f"{source.index:04X}h:{source.subindex:02X}"
        at, hint = f"{key}.source.index", "" if key == "load_encoder" else f", or leave '{key}' out"
        variable = find(od, source.index, source.subindex)
        kind = integer_type(variable) if variable is not None else None
        if variable is None:
            wrong = (
                f"{eds} has no object {name}{_instead(od, source.index)}; expected the drive's object for it"
            )
        elif not (variable.pdo_mappable or _is_carried(source.index, source.subindex, offers)):
            wrong = f"{eds} says that {name} cannot be mapped to a PDO; expected one that can"
        elif kind is not IntegerType.named(source.type):
            at = f"{key}.source.type"
            found = kind.value if kind is not None else "another type"
            wrong = f"{eds} says that {name} is {found}; expected that here"
        else:
            continue
        yield f"{axis.where(at)}: {wrong}{hint}"


def _instead(od: ObjectDictionary, index: int) -> str:
    """Lists the sub-indices of an index in the EDS, for a message."""
    entry = od.get(index)
    if entry is None:
        return ""
    members = getattr(entry, "subindices", {0: entry})
    return f" (of {index:04X}h it has {', '.join(f'{sub:02X}' for sub in sorted(members))})"
