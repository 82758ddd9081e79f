"""Stepping test under each compensation scheme, in sequence on one axis."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.evaluation.stepping import Stepped, quantisation_floor_arcsec
from hdbridge.control.bench import Bench, Run, compensation_for
from hdbridge.control.faultcounts import fault_notes
from hdbridge.drive.drive import Drive
from hdbridge.enums import Scheme
from hdbridge.motion.procedures.stepping import Stepping, SteppingOutcome
from hdbridge.records.record import Record


@dataclass(frozen=True, slots=True)
class Comparison:
    """Results of the stepping test under each scheme."""

    results: dict[Scheme, Stepped]
    runs: dict[Scheme, Run[SteppingOutcome]]
    quantisation_floor_arcsec: float

    @classmethod
    def of(cls, axis: AxisConfig, runs: dict[Scheme, Run[SteppingOutcome]]) -> Self:
        """Evaluates the completed runs."""
        floor = quantisation_floor_arcsec(axis.motor_encoder.counts_per_turn, axis.gear.ratio)
        results = {scheme: Stepped.of(scheme.value, run.outcome) for scheme, run in runs.items()}
        return cls(results, runs, floor)

    @property
    def fault_notes(self) -> tuple[str, ...]:
        """One line for each scheme whose test continued despite tolerated faults."""
        return tuple(
            fault_notes((f"'{scheme.value}'", run.fault_counts) for scheme, run in self.runs.items())
        )

    def as_dict(self) -> dict[str, Any]:
        """Returns the document of ``hdbridge step --json``."""
        return {
            "schema": "hdbridge.stepping/1",
            **{scheme.value: self._figures(scheme) for scheme in self.results},
            "survived": list(self.fault_notes),
            "quantisation_floor_arcsec": self.quantisation_floor_arcsec,
        }

    def _figures(self, scheme: Scheme) -> dict[str, Any]:
        result = self.results[scheme]
        steps = {
            way: {"target_deg": list(targets), "error_arcsec": list(errors)}
            for way, targets, errors in zip(
                ("cw", "ccw"), result.targets_deg, result.errors_arcsec, strict=True
            )
        }
        return {**result.scatter, "steps": steps}


def compare_schemes(
    drive: Drive,
    model: TransmissionModel,
    schemes: Sequence[Scheme],
    stepping: Stepping,
    *,
    progress: Callable[[Scheme, float], None] = lambda *_: None,
    interrupted: Callable[[], bool] = lambda: False,
    stopped: Callable[[Scheme, Record], None] = lambda *_: None,
) -> Iterator[tuple[Scheme, Run[SteppingOutcome]]]:
    """Yields the stepping test under each scheme on a booted drive, which is disabled after each test.

    ``progress`` receives the completed fraction of the current scheme, and ``stopped`` the measurements of an
    interrupted run, so that no measurement is lost.
    """
    drive.axis.require_load_encoder()
    # All compensations first, so that an impossible one is refused before anything moves.
    compensations = {scheme: compensation_for(drive.axis, scheme.of(model)) for scheme in schemes}
    for scheme, compensation in compensations.items():
        bench = Bench(drive, compensation, interrupted=interrupted)
        try:
            run = bench.run(stepping, partial(progress, scheme))
        except BaseException:
            if len(record := bench.record()):
                stopped(scheme, record)
            raise
        yield scheme, run
