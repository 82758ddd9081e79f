"""Simulates an axis with one line of code, for a first try, a test, or a script without hardware.

with simulated(axis) as drive:          # a real one: open_bus(axis.bus) as bus, Drive(bus, axis) as drive
    drive.boot()
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.drive import Drive


@contextmanager
def simulated(
    axis: AxisConfig | Path | str,
    truth: Path | str | None = None,
    seed: int = 0,
    **changed: Mapping[str, Any],
) -> Iterator[Drive]:
    """Yields the drive of an axis, simulated in this process and faster than real time; not booted yet.

    ``axis`` is an axis file's content, its folder or path, or the name of a bundled profile, such as
    "article". ``truth`` describes the axis (docs/ci.md); the default is the ``twin.yaml`` next to the axis
    file, or else the ``truth.yaml``. ``changed`` overrides keys in sections of the truth, such as
    ``gear={"backlash_arcsec": 10}``. The same truth and seed give the same frames, bit for bit. Raises
    `InputError` for a missing or invalid axis or truth.
    """
    # Loaded here, because a master of a real drive needs no simulation.
    from hdbridge.axis import AxisConfig  # noqa: PLC0415
    from hdbridge.drive import Drive  # noqa: PLC0415
    from hdbridge.files.profile import Profile  # noqa: PLC0415
    from hdbridge.sim.lockstep import simulated_bench  # noqa: PLC0415
    from hdbridge.sim.truth import Truth  # noqa: PLC0415

    if not isinstance(axis, AxisConfig):
        axis = AxisConfig.load(Profile.find(str(axis)).axis)
    known = Path(truth) if truth is not None else Profile.find(str(axis.path)).simulated
    source = axis.load_encoder.source.address
    with (
        simulated_bench(
            Truth.load(known).changed(**changed), axis.eds_path, axis.drive.node_id, seed, load_object=source
        ) as (
            bus,
            clock,
            _,
        ),
        Drive(bus, axis, clock) as drive,
    ):
        yield drive
