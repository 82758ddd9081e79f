"""Files of an adaptation: its state, which survives a restart, and its history.

``AXIS.json`` is replaced as a whole, ``AXIS.log.jsonl`` is only appended to. The state belongs to one
committed model; the adaptation of another model starts from scratch.
"""

import hashlib
import json
import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.following.adaptation import Entry, Learned
from hdbridge.errors import OutputError
from hdbridge.files.atomic import make_folder, write_atomically

SCHEMA = "hdbridge.adaptation/1"
_log = logging.getLogger(__name__)


class _State(Learned):
    """Content of ``AXIS.json``."""

    schema_: Literal["hdbridge.adaptation/1"] = Field(alias="schema")
    model: str
    """Fingerprint of the committed model and the adapted parameters."""
    saved: datetime


class AdaptationFiles:
    """Files of one axis and its committed model."""

    def __init__(
        self,
        folder: Path,
        axis: str,
        model: TransmissionModel,
        parameters: tuple[str, ...] | None,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        """Creates the folder if it does not exist; raises OutputError if this fails."""
        make_folder(folder)
        text = replace(model, provenance={}).dump() + json.dumps(parameters)
        self._fingerprint = hashlib.sha256(text.encode()).hexdigest()
        self._axis = axis
        self._state = folder / f"{axis}.json"
        self._history = folder / f"{axis}.log.jsonl"
        self.now = now
        """Returns the time of day."""
        self.problem = ""
        """Last error of `write`; empty after success."""

    def load(self) -> Learned | None:
        """Returns the stored state of this model; None if none is stored.

        If the file cannot be read, this is noted in the history and the result is None. Raises OutputError if
        the history cannot be written.
        """
        try:
            file = _State.model_validate_json(self._state.read_bytes())
        except FileNotFoundError:
            return None
        except (OSError, ValidationError) as problem:
            self._append({"event": "began anew", "reason": f"{self._state.name} cannot be read: {problem}"})
            return None
        if file.model != self._fingerprint:
            self._append({"event": "began anew", "reason": "another model was committed"})
            return None
        self._append({"event": "restored", "windows": file.windows, "saved": file.saved.isoformat()})
        return file

    def write(self, entries: Sequence[Entry], learned: Learned) -> None:
        """Logs lines and appends them to the history, and stores the state; an error is logged once."""
        try:
            for entry in entries:
                facts = {name: value for name, value in entry.items() if name != "event"}
                _log.info(f"adaptation: {entry['event']}", {"axis": self._axis, **facts})
                self._append(entry)
            file = _State(schema=SCHEMA, model=self._fingerprint, saved=self.now(), **dict(learned))
            write_atomically(self._state, file.model_dump_json(by_alias=True))
            self.problem = ""
        except OutputError as problem:
            if not self.problem:
                _log.warning("adaptation not kept", {"axis": self._axis, "why": str(problem)})
            self.problem = str(problem)

    def _append(self, entry: Entry) -> None:
        line = json.dumps({"time": self.now().isoformat(), **entry}, allow_nan=False)
        try:
            with self._history.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as problem:
            raise OutputError(f"{self._history}: cannot be written: {problem.strerror}") from None
