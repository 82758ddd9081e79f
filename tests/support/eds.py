"""Variants of the project's own EDS, for drives with other object dictionaries."""

import re
import shutil
from pathlib import Path

from hdbridge.axis import AxisConfig
from hdbridge.files.profile import bundled_folder, bundled_profile

OWN = (bundled_folder("eds") / "hdbridge-402.eds").read_text()


def section(index: int, sub: int | None = None) -> str:
    """Returns the name of the EDS section of an object."""
    return f"{index:04X}" if sub is None else f"{index:04X}sub{sub:X}"


def without(text: str, *objects: int | tuple[int, int]) -> str:
    """Returns an EDS without these objects, or without these members (index, sub-index) of objects."""
    for each in objects:
        names = re.escape(section(*each)) if isinstance(each, tuple) else rf"{each:04X}(?:sub\w+)?"
        text, count = re.subn(rf"^\[{names}\]\n(?:(?!\[).*\n)*", "", text, flags=re.MULTILINE)
        assert count, each
    return text


def stating(text: str, name: str, **keys: object) -> str:
    """Returns an EDS with these keys set in a section; None removes a key."""
    head, found, tail = re.split(
        rf"^(\[{re.escape(name)}\]\n(?:[^\[\n].*\n)*)", text, maxsplit=1, flags=re.MULTILINE
    )
    for key, value in keys.items():
        found = re.sub(rf"^{key}=.*\n", "", found, flags=re.MULTILINE)
        found += f"{key}={value}\n" if value is not None else ""
    return head + found + tail


def fixed(text: str, name: str, value: object) -> str:
    """Returns an EDS in which the object of a section is read-only and has this value."""
    return stating(text, name, AccessType="ro", DefaultValue=value)


def mapped(
    text: str, communication: int, *words: int, can_id: int | None = None, kind: int | None = None
) -> str:
    """Returns an EDS with a PDO whose mapping is read-only, and also its identifier and type if given."""
    mapping = communication + 0x200
    text = fixed(text, section(mapping, 0), len(words))
    for sub in range(1, 9):
        word = words[sub - 1] if sub <= len(words) else 0
        text = fixed(text, section(mapping, sub), f"0x{word:08X}")
    if can_id is not None:
        text = fixed(text, section(communication, 1), f"0x{can_id:X}")
    return text if kind is None else fixed(text, section(communication, 2), kind)


def profile_with(folder: Path, eds: str | bytes, *edits: tuple[str, str]) -> AxisConfig:
    """Copies the article's profile to a folder, with a different EDS and an edited axis file."""
    shutil.copytree(bundled_profile("article"), folder, dirs_exist_ok=True)
    (folder / "drive.eds").write_bytes(eds if isinstance(eds, bytes) else eds.encode())
    text = (folder / "axis.yaml").read_text()
    for old, new in (("eds: hdbridge-402.eds", "eds: drive.eds"), *edits):
        assert old in text, old
        text = text.replace(old, new)
    (folder / "axis.yaml").write_text(text)
    return AxisConfig.load(folder)
