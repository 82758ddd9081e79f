"""Automatic diagnosis of the last minutes of an axis after the watch has raised a verdict.

Export and diagnosis run as the ordinary commands, in processes with the lowest scheduling priority. Their
results are stored next to the recordings:

    FOLDER/diagnoses/DATE-AXIS/record/          the record (hdbridge record export)
    FOLDER/diagnoses/DATE-AXIS/model.yaml       the model that was in use
    FOLDER/diagnoses/DATE-AXIS/diagnosis.json   result of hdbridge diagnose; diagnosis.html shows it
    FOLDER/diagnoses/DATE-AXIS/why.txt          reason for the diagnosis
    FOLDER/diagnoses/DATE-AXIS/log.txt          output of the commands
"""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from hdbridge.errors import HdbridgeError
from hdbridge.files.atomic import new_folder, write_atomically

DIAGNOSES: Final = "diagnoses"
RECORD: Final = "record"
RESULT: Final = "diagnosis.json"
TIMEOUT_S: Final = 1800.0
"""Time-out of a diagnosis."""
INTERVAL_S: Final = 3600.0
"""Minimum time between two diagnoses of one axis."""
_NS: Final = 10**9


class AutoDiagnosis:
    """Runs one diagnosis at a time, in a thread that waits for its process."""

    def __init__(self, folder: Path, wall_ns: Callable[[], int] = time.time_ns) -> None:
        """``folder`` is that of the flight recorder."""
        self._folder = folder
        self._wall_ns = wall_ns
        self._last_ns: dict[str, int] = {}
        self._ended = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="diagnosis")

    def start(
        self, axis: str, model_text: str, minutes: float, reason: str, report: Callable[[str], None]
    ) -> Future[None] | None:
        """Diagnoses the last minutes, and calls ``report`` with the result in another thread.

        Returns None if this axis was diagnosed within `INTERVAL_S`, or after `close`.
        """
        now_ns, last_ns = self._wall_ns(), self._last_ns.get(axis)
        if self._ended.is_set() or (last_ns is not None and now_ns - last_ns < INTERVAL_S * _NS):
            return None
        self._last_ns[axis] = now_ns

        def run() -> None:
            try:
                report(self._diagnosed(axis, model_text, minutes, reason, now_ns))
            except (HdbridgeError, OSError, subprocess.SubprocessError) as problem:
                if not self._ended.is_set():
                    report(f"the diagnosis was not made: {problem}")

        return self._worker.submit(run)

    def close(self) -> None:
        """Ends a running diagnosis."""
        self._ended.set()
        process = self._process
        if process is not None:
            with suppress(ProcessLookupError):
                process.kill()
        self._worker.shutdown(cancel_futures=True)

    def _diagnosed(self, axis: str, model_text: str, minutes: float, reason: str, now_ns: int) -> str:
        date = datetime.fromtimestamp(now_ns / _NS, UTC)
        folder = new_folder(self._folder / DIAGNOSES / f"{date:%Y%m%dT%H%M%SZ}-{axis}")
        begin = datetime.fromtimestamp(now_ns / _NS - 60.0 * minutes, UTC)
        model = folder / "model.yaml"
        write_atomically(model, model_text)
        write_atomically(folder / "why.txt", reason + "\n")
        self._command(
            folder,
            "record", "export", self._folder, "--axis", axis, "--from", begin.isoformat(),
            "--out", folder / RECORD,
        )  # fmt: skip
        self._command(
            folder,
            "diagnose", folder / RECORD, "--model", model,
            "--json", folder / RESULT, "--html", folder / "diagnosis.html",
        )  # fmt: skip
        found = json.loads((folder / RESULT).read_text(encoding="utf-8"))
        return f"{summary(found)}; {folder}"

    def _command(self, folder: Path, *arguments: object) -> None:
        """Runs one hdbridge command to completion, at the lowest priority."""
        line = [sys.executable, "-m", "hdbridge", *map(str, arguments)]
        with (folder / "log.txt").open("ab") as log:
            process = subprocess.Popen(
                line, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
            self._process = process
            try:
                with suppress(OSError):
                    os.setpriority(os.PRIO_PROCESS, process.pid, 19)
                with suppress(OSError):
                    os.sched_setscheduler(process.pid, os.SCHED_IDLE, os.sched_param(0))
                if self._ended.is_set():
                    process.kill()
                status = process.wait(TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                raise
            finally:
                self._process = None
        if status:
            lines = (folder / "log.txt").read_text(encoding="utf-8", errors="replace").strip().splitlines()
            raise HdbridgeError(
                lines[-1] if lines else f"'hdbridge {arguments[0]}' exited with status {status}"
            )


def summary(found: dict[str, Any]) -> str:
    """Summarises a diagnosis in one line."""
    findings: Sequence[dict[str, Any]] = found["findings"]
    baseline, floor = found["baseline"]["rms_arcsec"], found["noise_floor_arcsec"]
    named = ", ".join(
        f"{each['cause']} ({100.0 * each['probability']:.0f} %, {each['peak_arcsec']:.1f} arcsec)"
        for each in findings[:3]
    )
    return (
        f"diagnosis: {named or 'no known cause'}; the error deviates from the model by {baseline:.2f} "
        f"arcsec rms, the noise is {floor:.2f}"
    )
