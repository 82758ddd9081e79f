"""PDO layout on drives with free, fixed, few and small PDOs."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.eds import OWN, mapped, section, stating, without

from hdbridge.axis import AxisConfig
from hdbridge.drive.layout import Layouts, layouts
from hdbridge.errors import InputError
from hdbridge.files.edsfile import read_eds

STATUS, POSITION, TORQUE = 0x60410010, 0x60640020, 0x60770010
LOAD, DEMAND, CONTROL, TARGET = 0x60E40120, 0x60620020, 0x60400010, 0x607A0020


@pytest.fixture
def laid_out(tmp_path: Path, build_axis: Callable[..., AxisConfig]) -> Callable[..., Layouts]:
    def lay_out(eds: str, **changes: Any) -> Layouts:
        path = tmp_path / "drive.eds"
        path.write_text(eds)
        return layouts(build_axis(**changes), read_eds(path, 1).dictionary)

    return lay_out


def words(layout: Any) -> list[int]:
    return [entry.mapping for entry in layout.codec.entries]


def mappings(found: Layouts) -> dict[int, list[int]]:
    """The mapping of each PDO by its identifier."""
    return {each.can_id: words(each) for each in (*found.cyclic, *found.channels, *found.rpdos)}


def test_free_mappings_get_the_standard_layout(laid_out: Any) -> None:
    found = laid_out(OWN)
    assert mappings(found) == {
        0x181: [STATUS, POSITION, TORQUE],
        0x281: [LOAD, DEMAND],
        0x201: [CONTROL, TARGET],
    }
    assert found.absent == ()


def test_unavailable_objects_are_omitted_and_their_room_used(laid_out: Any) -> None:
    found = laid_out(without(OWN, 0x6077, 0x6062))
    assert mappings(found) == {0x181: [STATUS, POSITION], 0x281: [LOAD], 0x201: [CONTROL, TARGET]}
    assert [each.index for each in found.absent] == [0x6077, 0x6062]
    found = laid_out(stating(OWN, "6062", PDOMapping=0))
    assert [each.index for each in found.absent] == [0x6062]


def test_the_drives_own_types_decide_what_fits(laid_out: Any) -> None:
    found = laid_out(stating(OWN, "6077", DataType="0x0004"))
    assert mappings(found) == {
        0x181: [STATUS, POSITION],
        0x281: [0x60770020, LOAD],
        0x381: [DEMAND],
        0x201: [CONTROL, TARGET],
    }


def test_as_few_fixed_mappings_as_possible_are_used(laid_out: Any) -> None:
    eds = mapped(mapped(OWN, 0x1400, CONTROL), 0x1401, CONTROL, TARGET)
    assert [each.number for each in laid_out(eds).rpdos] == [2]


def test_a_pdo_not_sent_on_every_sync_serves_channels_only(laid_out: Any) -> None:
    eds = mapped(mapped(OWN, 0x1800, STATUS, POSITION, kind=5), 0x1801, 0x21000010, kind=5)
    channel = {"source": {"index": 0x2100, "type": "int16"}, "celsius_per_count": 0.1, "every_cycles": 25}
    found = laid_out(eds, temperature=channel)
    assert [each.number for each in found.cyclic] == [3, 4]
    assert [(each.number, each.every) for each in found.channels] == [(2, 5)]


def test_a_channel_may_share_the_encoders_pdo(laid_out: Any) -> None:
    channel = {"source": {"index": 0x2100, "type": "int16"}, "celsius_per_count": 0.1}
    found = laid_out(mapped(OWN, 0x1800, STATUS, POSITION, 0x21000010, kind=1), temperature=channel)
    assert (found.channels, words(found.cyclic[0])[-1]) == ((), 0x21000010)


def test_few_and_small_pdos(laid_out: Any) -> None:
    eds = without(OWN, *((0x1A00 + n, sub) for n in range(4) for sub in range(3, 9)))
    assert [words(each) for each in laid_out(eds).cyclic] == [[STATUS, POSITION], [TORQUE, LOAD], [DEMAND]]
    eds = without(OWN, 0x1803, 0x1A03, 0x1802, 0x1A02)
    assert len(laid_out(eds).cyclic) == 2
    small = without(eds, *((0x1A00 + n, sub) for n in range(2) for sub in range(3, 9)))
    found = laid_out(small)
    assert [words(each) for each in found.cyclic] == [[STATUS, POSITION], [TORQUE, LOAD]]
    assert [each.index for each in found.absent] == [0x6062]
    tiny = without(small, (0x1A01, 2))
    found = laid_out(tiny)
    assert [words(each) for each in found.cyclic] == [[STATUS, POSITION], [LOAD]]
    with pytest.raises(
        InputError, match=r"drive\.eds: the TPDOs of hdbridge-402\.eds cannot carry .* it has 1;"
    ):
        laid_out(without(tiny, 0x1801, 0x1A01))
    with pytest.raises(InputError, match="it has none"):
        laid_out(without(eds, 0x1800, 0x1801))


def test_a_pdo_beyond_the_fourth_gets_an_identifier_that_is_free(laid_out: Any) -> None:
    fifth = OWN.replace("[1800", "[1804").replace("[1A00", "[1A04")
    found = laid_out(mapped(fifth, 0x1802, LOAD, can_id=0x381))
    assert [(each.number, each.can_id) for each in found.cyclic] == [(2, 0x281), (3, 0x381), (4, 0x481)]
    found = laid_out(without(fifth, 0x1802, 0x1803))
    assert [(each.number, each.can_id) for each in found.cyclic] == [(2, 0x281), (5, 0x181)]


def test_a_pdo_that_is_invalid_for_good_does_not_exist(laid_out: Any) -> None:
    found = laid_out(mapped(OWN, 0x1800, STATUS, POSITION, LOAD, can_id=0x8000_0181))
    assert [each.number for each in found.cyclic] == [2, 3]


def test_an_unknown_fixed_mapping_is_not_used(laid_out: Any) -> None:
    eds = stating(mapped(OWN, 0x1800, STATUS, POSITION), section(0x1A00, 2), DefaultValue=None)
    assert [each.number for each in laid_out(eds).cyclic] == [2, 3]
    eds = mapped(eds, 0x1801, 0x60410001)
    assert [each.number for each in laid_out(eds).cyclic] == [3, 4]


def test_more_channels_than_pdos(laid_out: Any) -> None:
    torque = {"source": {"index": 0x2101, "type": "int32"}, "newton_metres_per_count": 0.001}
    heat = {"source": {"index": 0x2100, "type": "int16"}, "celsius_per_count": 0.1}
    eds = without(OWN, 0x1803)
    with pytest.raises(InputError, match=r"temperature: no TPDO is left for it: the drive has 1 beyond"):
        laid_out(eds, load_torque=torque, temperature=heat)
    found = laid_out(eds, load_torque=torque, temperature=heat | {"every_cycles": 1})
    assert [words(each) for each in found.channels] == [[0x21010020, 0x21000010]]


@pytest.mark.parametrize(
    ("source", "complaint"),
    [
        (
            {"index": 0x2155},
            r"load_encoder\.source\.index: hdbridge-402\.eds has no object 2155h:01; expected",
        ),
        ({"subindex": 2}, r"has no object 60E4h:02 \(of 60E4h it has 00, 01\)"),
        ({"index": 0x6063}, r"has no object 6063h:01 \(of 6063h it has 00\)"),
        ({"type": "int16"}, r"load_encoder\.source\.type: hdbridge-402\.eds says that 60E4h:01 is int32"),
        ({"type": "uint32"}, r"load_encoder\.source\.type: hdbridge-402\.eds says that 60E4h:01 is int32"),
        (
            {"index": 0x607D},
            r"load_encoder\.source\.index: hdbridge-402\.eds says that 607Dh:01 cannot be mapped",
        ),
    ],
)
def test_the_load_encoder_must_match_the_eds(laid_out: Any, source: dict[str, Any], complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        laid_out(OWN, load_encoder__source=source)


def test_the_eds_does_not_describe_other_nodes(laid_out: Any) -> None:
    found = laid_out(OWN, load_encoder__source={"index": 0x6004, "subindex": 0, "type": "uint32", "node": 2})
    assert mappings(found)[0x182] == [0x60040020]


@pytest.mark.parametrize("index", [0x6041, 0x6064, 0x6040, 0x607A])
def test_mandatory_objects_must_be_mappable_or_mapped(laid_out: Any, index: int) -> None:
    eds = stating(OWN, f"{index:04X}", PDOMapping=0)
    with pytest.raises(InputError, match=rf"says that {index:04X}h:00 .* cannot be mapped to a PDO"):
        laid_out(eds)
    laid_out(mapped(mapped(eds, 0x1800, STATUS, POSITION), 0x1400, CONTROL, TARGET))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    pieces=st.permutations([STATUS, POSITION, TORQUE, LOAD, DEMAND]),
    cuts=st.lists(st.integers(1, 4), max_size=3),
    split=st.booleans(),
    swapped=st.booleans(),
)
def test_any_order_and_split_of_fixed_mappings_carries_everything(laid_out, pieces, cuts, split, swapped):
    edges = sorted({0, *cuts, 5})
    parts = [pieces[a:b] for a, b in pairwise(edges)]
    parts = [part for each in parts for part in _in_eight_bytes(each)][:4]
    eds = OWN
    for place, part in enumerate(parts):
        eds = mapped(eds, 0x1800 + place, *part, kind=1)
    receiving = [TARGET, CONTROL] if swapped else [CONTROL, TARGET]
    for place, part in enumerate([[each] for each in receiving] if split else [receiving]):
        eds = mapped(eds, 0x1400 + place, *part)
    found = laid_out(eds)
    carried = [word for each in (*found.cyclic, *found.rpdos) for word in words(each)]
    assert {STATUS, POSITION, LOAD, CONTROL, TARGET} <= set(carried)
    assert len(carried) == len(set(carried))


def _in_eight_bytes(part: list[int]) -> list[list[int]]:
    found: list[list[int]] = [[]]
    for word in part:
        if sum(each & 0xFF for each in [*found[-1], word]) > 64:
            found.append([])
        found[-1].append(word)
    return found
