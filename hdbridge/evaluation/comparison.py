"""The stepping test under each compensation scheme, one after the other on one axis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from hdbridge.control.bench import Bench, Run, compensation_for
from hdbridge.drive.drive import Drive
from hdbridge.evaluation.stepping import Scheme, SchemeResult, quantisation_floor_arcsec
from hdbridge.model import TransmissionModel
from hdbridge.procedures.stepping import Stepping, SteppingOutcome


@dataclass(frozen=True, slots=True)
class Comparison:
    """What the stepping test gave under each scheme."""

    results: dict[Scheme, SchemeResult]
    runs: dict[Scheme, Run[SteppingOutcome]]
    quantisation_floor_arcsec: float

    def as_dict(self) -> dict[str, Any]:
        """The contract of ``hdbridge step --json``."""
        return {
            "schema": "hdbridge.stepping/1",
            **{scheme.value: result.as_dict() for scheme, result in self.results.items()},
            "quantisation_floor_arcsec": self.quantisation_floor_arcsec,
        }


def compare_schemes(
    drive: Drive,
    model: TransmissionModel,
    schemes: Sequence[Scheme],
    stepping: Stepping,
    *,
    progress: Callable[[Scheme, float], None] = lambda *_: None,
    interrupted: Callable[[], bool] = lambda: False,
    finished: Callable[[Scheme, Run[SteppingOutcome]], None] = lambda *_: None,
) -> Comparison:
    """Run the stepping test under each scheme on a booted drive; it is enabled for each and disabled after.

    ``progress`` receives the share of the present scheme that is done; ``finished`` each run as it ends, so
    that nothing measured is lost when a later one fails.
    """
    # All of them first: what cannot be compensated is refused before anything moves.
    compensations = {scheme: compensation_for(drive.axis, scheme.of(model)) for scheme in schemes}
    runs: dict[Scheme, Run[SteppingOutcome]] = {}
    for scheme, compensation in compensations.items():
        bench = Bench(drive, compensation, interrupted=interrupted)
        runs[scheme] = bench.run(stepping, partial(progress, scheme))
        finished(scheme, runs[scheme])
    floor = quantisation_floor_arcsec(drive.axis.motor_encoder.counts_per_turn, drive.axis.gear.ratio)
    return Comparison({scheme: SchemeResult.of(run.outcome) for scheme, run in runs.items()}, runs, floor)
