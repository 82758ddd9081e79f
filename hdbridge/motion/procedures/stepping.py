"""Stepping test: deviation of the load from its target at rest after each step."""

from collections.abc import Sequence
from dataclasses import dataclass

from hdbridge.errors import InputError
from hdbridge.motion.procedures.moves import AxisView, MoveTo, Sample, Settle, Steps
from hdbridge.motion.procedures.parameters import Checked, Count
from hdbridge.motion.procedures.standstill import Precondition
from hdbridge.units import ARCSEC_PER_DEG


@dataclass(frozen=True, slots=True)
class Standing:
    """Result of one step, measured at rest."""

    target_deg: float
    """Load target, degrees."""
    error_arcsec: float
    """Load encoder reading minus target, mean over the settled window, arcsec."""
    settle_s: float
    """Time from the end of the move to the standstill of the load."""

    @property
    def load_deg(self) -> float:
        """Load position according to the load encoder, degrees."""
        return self.target_deg + self.error_arcsec / ARCSEC_PER_DEG


@dataclass(frozen=True, slots=True)
class SteppingOutcome:
    """Results of all steps in both directions."""

    cw: tuple[Standing, ...]
    """Steps of the first pass, towards positive angles if ``step_deg`` is positive."""
    ccw: tuple[Standing, ...]
    """Steps of the second pass, in the opposite direction."""


@dataclass(frozen=True, slots=True)
class Stepping(Checked):
    """Runs ``count`` steps of ``step_deg`` (motor degrees) in one direction, then back.

    The test starts with a pre-conditioning move (back by ``precondition_deg`` and forward again), so that the
    gear's elastic state is that after forward motion.
    """

    count: Count = 240
    step_deg: float = 43.56
    start_deg: float = 0.0
    """Load angle at the start."""
    precondition_deg: float = 2.0
    """Travel of the pre-conditioning move, load degrees; more than the width of any hysteresis."""
    settle: Settle = Settle()

    def __post_init__(self) -> None:
        """Raises `InputError` for an invalid parameter, such as steps of size zero."""
        Checked.__post_init__(self)
        if self.step_deg == 0.0:
            raise InputError("step_deg: found 0; expected the size of a step, negative for steps down first")

    def moves(self, axis: AxisView) -> Steps[SteppingOutcome]:
        """Yields a jerk-limited move and a settle for each step."""
        yield from Precondition(self.start_deg, self.precondition_deg).moves(axis)
        passes: list[tuple[Standing, ...]] = []
        for order in (range(1, self.count + 1), range(self.count - 1, -1, -1)):
            stands: list[Standing] = []
            for index in order:
                target = self.start_deg + index * self.step_deg / axis.ratio
                stands.append((yield from step(target, self.settle)))
            passes.append(tuple(stands))
        return SteppingOutcome(cw=passes[0], ccw=passes[1])


def step(
    target_deg: float, settle: Settle, velocity_deg_s: float | None = None, kind: str = "step"
) -> Steps[Standing]:
    """Yields a jerk-limited move and a settle; returns the result at the target."""
    yield MoveTo(target_deg, velocity_deg_s, kind)
    samples = yield settle
    return standing(target_deg, samples, settle)


def standing(target_deg: float, samples: Sequence[Sample], settle: Settle) -> Standing:
    """Returns the result at a target, from the mean over the settled window."""
    window = settle.window(samples)
    mean = sum(each.load_position_deg - target_deg for each in window) / len(window)
    return Standing(target_deg, mean * ARCSEC_PER_DEG, samples[-1].time_s - samples[0].time_s)
