"""Files of an adaptation: its state, which survives a restart, and its history.

``AXIS.json`` is replaced as a whole, ``AXIS.log.jsonl`` is only appended to. The state belongs to one
committed model; the adaptation of another model starts without it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from hdbridge.daemon.adaptation.adaptation import Memory
from hdbridge.daemon.adaptation.proposal import Entry
from hdbridge.errors import OutputError
from hdbridge.files.atomic import make_folder, write_atomically
from hdbridge.model import TransmissionModel
from hdbridge.strictness import Strict

SCHEMA = "hdbridge.adaptation/1"


class StateFile(Strict):
    """Content of ``AXIS.json``."""

    schema_: Literal["hdbridge.adaptation/1"] = Field(alias="schema")
    model: str
    """Fingerprint of the committed model and the adapted parameters."""
    saved: datetime
    estimate: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    applied: tuple[float, ...]
    windows: int = Field(ge=0)


class Keeping:
    """Files of one axis. Raises OutputError if they cannot be written."""

    def __init__(self, folder: Path, axis: str, now: Callable[[], datetime]) -> None:
        """Creates the folder if it does not exist."""
        make_folder(folder)
        self._state = folder / f"{axis}.json"
        self._log = folder / f"{axis}.log.jsonl"
        self.now = now
        """Returns the time of day."""

    def load(self, fingerprint: str) -> Memory | None:
        """Returns the stored state of this model; None if there is none or it belongs to another model.

        If the file cannot be read, this is noted in the history and the result is None.
        """
        try:
            file = StateFile.model_validate_json(self._state.read_bytes())
        except FileNotFoundError:
            return None
        except (OSError, ValidationError) as problem:
            self.log({"event": "began anew", "reason": f"{self._state.name} cannot be read: {problem}"})
            return None
        if file.model != fingerprint:
            self.log({"event": "began anew", "reason": "another model was committed"})
            return None
        self.log({"event": "restored", "windows": file.windows, "saved": file.saved.isoformat()})
        return Memory(file.estimate, file.covariance, file.applied, file.windows)

    def save(self, fingerprint: str, memory: Memory) -> None:
        """Stores the state."""
        file = StateFile(schema=SCHEMA, model=fingerprint, saved=self.now(), **asdict(memory))
        write_atomically(self._state, file.model_dump_json(by_alias=True))

    def log(self, entry: Entry) -> None:
        """Appends a line with the time of day to the history."""
        line = json.dumps({"time": self.now().isoformat(), **entry}, allow_nan=False)
        try:
            with self._log.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as problem:
            raise OutputError(f"{self._log}: cannot be written: {problem.strerror}") from None


def fingerprint_of(model: TransmissionModel, parameters: tuple[str, ...] | None) -> str:
    """Returns the fingerprint of a model's numbers, without provenance, and the adapted parameters."""
    text = replace(model, provenance={}).dump() + json.dumps(parameters)
    return hashlib.sha256(text.encode()).hexdigest()
