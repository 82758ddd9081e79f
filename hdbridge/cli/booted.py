"""A drive ready for measurement: connected, booted, and stopped in an orderly way at Ctrl-C."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from hdbridge.cli.interrupt import deferred_interrupt
from hdbridge.cli.options import connected, notes
from hdbridge.files.profile import Profile

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.drive.drive import Drive


@contextmanager
def booted(
    axis: AxisConfig,
    profile: Profile,
    *,
    simulate: bool,
    truth: Path | None,
    seed: int,
    force: bool,
) -> Iterator[tuple[Drive, Callable[[], bool]]]:
    """Yields the booted drive, and a function that reports a request to end.

    With ``force``, frames are sent even if another master is heard.
    """
    from hdbridge.drive.drive import Drive

    with (
        deferred_interrupt() as interrupted,
        connected(axis, profile, simulate=simulate, truth=truth, seed=seed, force=force) as (bus, clock),
        Drive(bus, axis, clock, force=force) as drive,
    ):
        report = drive.boot()
        notes.print(f"booted node {axis.drive.node_id} over {drive.link.name}")
        for note in report.notes:
            notes.print(note, markup=False, soft_wrap=True)
        yield drive, interrupted
