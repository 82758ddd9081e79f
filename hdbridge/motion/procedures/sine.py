"""Slow sines of several amplitudes, some smaller than the width of the hysteresis, which trace its loops."""

from dataclasses import dataclass

from hdbridge.motion.procedures.moves import AxisView, Dwell, MoveTo, Sine, Steps
from hdbridge.motion.procedures.parameters import Checked, Positive


@dataclass(frozen=True, slots=True)
class Sines(Checked):
    """Runs sines of ``amplitudes_deg`` (motor degrees) about ``centre_deg`` (load degrees), in sequence."""

    centre_deg: float = 0.0
    amplitudes_deg: tuple[Positive, ...] = (180.0, 45.0, 5.0)
    frequency_hz: Positive = 0.05
    periods: Positive = 2.0

    def moves(self, axis: AxisView) -> Steps[None]:
        """Yields the sines, each starting at its upper extreme."""
        for amplitude_deg in self.amplitudes_deg:
            amplitude = amplitude_deg / axis.ratio
            yield MoveTo(self.centre_deg + amplitude)
            yield Dwell(0.2, kind="move")
            yield Sine(self.centre_deg, amplitude, self.frequency_hz, self.periods)
