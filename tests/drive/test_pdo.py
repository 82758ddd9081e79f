"""The PDO codec: round trip and rejected values."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.drive.objects import IntegerType
from hdbridge.drive.pdo import PdoCodec, PdoEntry, PdoLengthError
from hdbridge.errors import InputError


@st.composite
def layouts(draw: st.DrawFn) -> tuple[PdoCodec, list[int]]:
    types: list[IntegerType] = []
    for kind in draw(st.lists(st.sampled_from(IntegerType), min_size=1, max_size=8)):
        if sum(each.bits for each in types) + kind.bits <= 64:
            types.append(kind)
    codec = PdoCodec(PdoEntry(0x2000 + place, place, kind) for place, kind in enumerate(types))
    return codec, [draw(st.integers(kind.minimum, kind.maximum)) for kind in types]


@given(layouts())
def test_values_lie_little_endian_one_after_the_other(layout: tuple[PdoCodec, list[int]]) -> None:
    codec, values = layout
    expected = b"".join(
        value.to_bytes(entry.type.bits // 8, "little", signed=entry.type.signed)
        for entry, value in zip(codec.entries, values, strict=True)
    )
    assert codec.pack(values) == expected
    assert len(expected) == codec.length
    assert codec.unpack(expected) == tuple(values)


@given(layouts(), st.binary(max_size=64))
def test_data_of_another_length_is_rejected(layout: tuple[PdoCodec, list[int]], data: bytes) -> None:
    codec, _ = layout
    if len(data) == codec.length:
        codec.unpack(data)
    else:
        with pytest.raises(PdoLengthError, match=f"has {codec.length} bytes"):
            codec.unpack(data)


@pytest.mark.parametrize("kind", IntegerType)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1.0, None, "1"])
def test_non_integers_are_not_packed(kind: IntegerType, bad: object) -> None:
    with pytest.raises(InputError, match="nothing was sent"):
        PdoCodec([PdoEntry(0x607A, 0, kind)]).pack([bad])  # type: ignore[list-item]


@pytest.mark.parametrize("kind", IntegerType)
def test_types_have_their_exact_range(kind: IntegerType) -> None:
    codec = PdoCodec([PdoEntry(0x607A, 0, kind)])
    for value in (kind.minimum, kind.maximum):
        assert codec.unpack(codec.pack([value])) == (value,)
    for value in (kind.minimum - 1, kind.maximum + 1):
        with pytest.raises(InputError, match=r"607Ah:00"):
            codec.pack([value])


def test_a_pdo_has_at_most_eight_bytes_and_no_object_twice() -> None:
    entry = PdoEntry(0x6064, 0, IntegerType.INT32)
    with pytest.raises(InputError, match="1 to 8 bytes"):
        PdoCodec([PdoEntry(0x6064, sub, IntegerType.INT32) for sub in range(3)])
    with pytest.raises(InputError, match="nothing needs 0"):
        PdoCodec([])
    with pytest.raises(InputError, match="maps an object once"):
        PdoCodec([entry, entry])
    with pytest.raises(InputError, match="as many values"):
        PdoCodec([entry]).pack([1, 2])
