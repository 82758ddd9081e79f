"""`hdbridge doctor` as a person uses it."""

import json
import logging
import signal
from dataclasses import replace

from hdbridge.cli.session import Session


def test_doctor_names_the_line_to_change(hdbridge, profile, tmp_path):
    folder = profile(
        "    counts_per_turn: 2880000\n    direction: 1",
        "    counts_per_turn: 2880000\n    direction: -1",
        "truth.yaml",
    )
    done = hdbridge("doctor", folder, "--simulate", "--json", "out.json", status=4)
    assert f"-> {folder}/axis.yaml:33:3: load_encoder.direction: found 1, expected -1" in done.stdout
    assert "1 of 18 checks failed, first 'counts, directions, ratio'" in done.stderr
    assert json.loads((tmp_path / "out.json").read_text())["passed"] is False


def test_doctor_of_a_broken_file_says_where(hdbridge, profile):
    folder = profile("cycle_ms: 4", "cycle_ms: four")
    done = hdbridge("doctor", folder, "--simulate", status=2)
    assert f"{folder}/axis.yaml:" in done.stdout
    assert "drive.cycle_ms" in done.stdout
    assert "not possible  the bus" in done.stdout


def test_doctor_without_motion(hdbridge):
    done = hdbridge("doctor", "article", "--simulate", "--no-motion")
    assert "left out by --no-motion" in done.stdout
    assert "as far as it can be checked without motion" in done.stdout


def test_a_real_axis_moves_only_with_consent(hdbridge, monkeypatch):
    """The bus is simulated, but the command cannot detect that."""
    real = Session.connected
    monkeypatch.setattr(Session, "connected", lambda session: real(replace(session, simulate=True)))
    done = hdbridge("doctor", "article", status=4)
    assert "Keep the path clear" in done.stderr
    assert "not possible  power on at rest" in done.stdout
    assert "FAIL" not in done.stdout
    assert "motion was not confirmed" in done.stderr
    hdbridge("doctor", "article", "--yes")


class InterruptAtPowerOff(logging.Handler):
    """Sends SIGINT when the drive is switched off for the first time, and counts how often it is enabled."""

    enabled = 0
    sent = False

    def emit(self, record: logging.LogRecord) -> None:
        facts = record.args if isinstance(record.args, dict) else {}
        self.enabled += record.msg == "enable"
        off = facts.get("object") == "1016h:01" and facts.get("data") == "00 00 00 00"
        if self.enabled and not self.sent and record.msg == "sdo write" and off:
            self.sent = True
            signal.raise_signal(signal.SIGINT)


def test_an_interrupt_while_power_goes_off_is_followed_by_no_other_motion(hdbridge):
    handler, log = InterruptAtPowerOff(), logging.getLogger("hdbridge.drive")
    log.addHandler(handler)
    try:
        hdbridge("-vv", "doctor", "article", "--simulate", "--yes", status=130)
    finally:
        log.removeHandler(handler)
    assert handler.sent
    assert handler.enabled == 1
