"""Fixtures of the bring-up tests: the article's axis with one fault, and the findings of the checks."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import can
import pytest

from hdbridge.axis import AxisConfig
from hdbridge.clock import Clock
from hdbridge.commissioning.bringup.checks import Row, Verdict, run_checks
from hdbridge.commissioning.bringup.doctor import CHECKS
from hdbridge.commissioning.bringup.slow import BringUpContext
from hdbridge.device.node import DriveNode
from hdbridge.files.profile import bundled_profile
from hdbridge.sim.lockstep import lockstep_bench, nameplate_of
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth

ARTICLE = bundled_profile("article")


def edited(text: str, changes: dict[str, str]) -> str:
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


@dataclass
class Case:
    """One run of the doctor's checks, with the inputs that a test may change."""

    folder: Path
    axis: dict[str, str] = field(default_factory=dict)
    truth: dict[str, str] = field(default_factory=dict)
    eds: dict[str, str] = field(default_factory=dict)
    """Edits of the EDS that the axis file names; the drive has the original."""
    drive_has_eds: bool = False
    """True if the drive has the edited EDS as well."""
    honest: bool = False
    """True if the drive's own objects describe the real plant rather than the axis file."""
    node_id: int = 1
    spoil: Callable[[DriveNode], None] = lambda node: None
    rows: dict[str, Row[BringUpContext]] = field(default_factory=dict)
    node: DriveNode | None = None

    def prepare(self) -> AxisConfig:
        text = edited((ARTICLE / "axis.yaml").read_text(), self.axis)
        if self.eds:
            original = (ARTICLE.parents[1] / "eds" / "hdbridge-402.eds").read_text()
            (self.folder / "changed.eds").write_text(edited(original, self.eds))
            text = edited(text, {"eds: hdbridge-402.eds": "eds: changed.eds"})
        path = self.folder / "axis.yaml"
        path.write_text(text)
        return AxisConfig.load(path)

    @contextmanager
    def connect(self, axis: AxisConfig) -> Iterator[tuple[can.BusABC, Clock]]:
        plain = (ARTICLE / "truth.yaml").read_text()
        truth = Truth.from_text(edited(plain, self.truth))
        nameplate = nameplate_of(truth if self.honest else Truth.from_text(plain))
        eds = axis.eds_path if self.drive_has_eds else ARTICLE.parents[1] / "eds" / "hdbridge-402.eds"
        machine = Machine(truth, 0, may_compile=True)
        with lockstep_bench(machine, eds, self.node_id, nameplate=nameplate, behaviour=truth.firmware) as (
            bus,
            clock,
            node,
        ):
            self.node = node
            self.spoil(node)
            yield bus, clock

    def run(self, until: str = "off", **options: Any) -> dict[str, Verdict]:
        """Returns the verdicts by check name, up to the check ``until``."""
        last = [check.name for check in CHECKS].index(until)
        permitted = options.pop("permitted", lambda: None)
        with BringUpContext(self.prepare, self.connect, **options) as context:
            rows = run_checks(context, CHECKS[: last + 1], permitted=permitted)
        self.rows = {row.check.name: row for row in rows}
        return {name: row.verdict for name, row in self.rows.items()}


@pytest.fixture
def case(tmp_path: Path) -> Callable[..., Case]:
    """Makes a case in a folder of its own."""

    def make(**parts: Any) -> Case:
        return Case(tmp_path, **parts)

    return make
