"""Stored parameters (1010h, 1011h): a master's configuration survives a reset and, with a file, power-off."""

import json
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from hdbridge.device.dictionary import Abort, Dictionary, Entry, SdoAbortError
from hdbridge.errors import HdbridgeError
from hdbridge.files.atomic import write_atomically

SAVE: Final = 0x65766173
LOAD: Final = 0x64616F6C
_NEVER_STORED: Final = frozenset({0x1003, 0x1010, 0x1011, 0x6040, 0x607A, 0x60B0, 0x60C1})
"""Indices of commands, targets and logs, which are not parameters."""


class StoredParameters:
    """Stored values of a dictionary, which a reset restores."""

    def __init__(
        self, dictionary: Dictionary, may_store: Callable[[], bool], file: Path | None = None
    ) -> None:
        """``may_store`` returns True while the device may pause to store."""
        self._dictionary, self._file = dictionary, file
        self._stored: dict[tuple[int, int], int] = self._read()
        for index, signature, act in ((0x1010, SAVE, self._save), (0x1011, LOAD, lambda: self._keep({}))):
            entry = dictionary[index, 1]
            if not entry.is_known:
                continue
            entry.bind(lambda: 1)

            def check(value: int, signature: int = signature, act: Callable[[], None] = act) -> None:
                if value != signature:
                    raise SdoAbortError(Abort.NOT_STORED)
                if not may_store():
                    raise SdoAbortError(Abort.STATE)
                act()

            entry.guard = check

    def restore(self, first: int = 0x0000, last: int = 0xFFFF) -> None:
        """Restores the stored values, else the defaults, of the indices from ``first`` to ``last``."""
        self._dictionary.restore(first, last)
        for (index, sub), value in self._stored.items():
            if first <= index <= last and (index, sub) in self._dictionary:
                self._dictionary[index, sub].value = value

    def _parameters(self) -> Iterator[Entry]:
        for entry in self._dictionary:
            if entry.writable and entry.codec and entry.bound is None and entry.index not in _NEVER_STORED:
                yield entry

    def _save(self) -> None:
        self._keep(
            {(each.index, each.sub): each.value for each in self._parameters() if each.value != each.default}
        )

    def _keep(self, values: dict[tuple[int, int], int]) -> None:
        if self._file is not None:
            rows = {f"{index:04X}:{sub:02X}": value for (index, sub), value in values.items()}
            try:
                write_atomically(self._file, json.dumps(rows, indent=1) + "\n")
            except (HdbridgeError, OSError):
                raise SdoAbortError(Abort.NOT_STORED) from None
        self._stored = values

    def _read(self) -> dict[tuple[int, int], int]:
        """Returns the values in the file that are valid and belong to existing parameters."""
        if self._file is None:
            return {}
        found: dict[tuple[int, int], int] = {}
        with suppress(OSError, ValueError, AttributeError):
            known = {f"{each.index:04X}:{each.sub:02X}": each for each in self._parameters()}
            for key, value in json.loads(self._file.read_text(encoding="utf-8")).items():
                entry = known.get(key)
                if entry is not None and entry.accepts(value):
                    found[entry.index, entry.sub] = value
        return found
