"""A simulated axis in one line: for a first try, for a test, for a script that shall run on a desk.

with simulated(axis) as drive:          # a real one: open_bus(axis.bus) as bus, Drive(bus, axis) as drive
drive.boot()
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.drive import Drive


@contextmanager
def simulated(axis: AxisConfig, truth: Path | str | None = None, seed: int = 0) -> Iterator[Drive]:
    """The drive of an axis, simulated in this process and faster than real time; not booted yet.

    ``truth`` says what the axis is like (docs/truth-file.md): without it the ``twin.yaml`` that lies next to
    the axis file, or else the ``truth.yaml``. The same truth and seed give the same frames, bit for bit.
    InputError where there is no truth, or it is wrong.
    """
    # Loaded here: who masters a real drive needs no simulated one.
    from hdbridge.drive import Drive  # noqa: PLC0415
    from hdbridge.files.profile import Profile  # noqa: PLC0415
    from hdbridge.sim.lockstep import simulated_bench  # noqa: PLC0415

    known = Path(truth) if truth is not None else Profile.find(str(axis.path)).simulated
    source = axis.load_encoder.source.address
    with (
        simulated_bench(known, axis.eds_path, axis.drive.node_id, seed, load_object=source) as (
            bus,
            clock,
            _,
        ),
        Drive(bus, axis, clock) as drive,
    ):
        yield drive
