"""Load-encoder watch of one axis: turns samples into verdicts. Uses no thread, file or clock.

A verdict is raised when its evidence has persisted, and withdrawn when the evidence has been absent for
longer, so one bad second or move raises nothing. There are no verdicts about the gear while the load encoder
is not believed.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, NamedTuple

import numpy as np

from hdbridge.axis import AxisConfig
from hdbridge.axis.channels import BY_KEY
from hdbridge.daemon.adaptation.measuring import Measuring, Observation
from hdbridge.daemon.adaptation.regressors import Regressors
from hdbridge.daemon.memory import SampleArray, SampleFlag
from hdbridge.daemon.watch.encoder_health import EncoderHealth, residual_of
from hdbridge.daemon.watch.judging import Allowed, Evidence, Judge
from hdbridge.daemon.watch.residual import DRIVEN, any_of
from hdbridge.effects import FloatArray
from hdbridge.model import TransmissionModel

OBSERVATIONS: Final = 600
"""Maximum number of observations (standstills and stretches of slow motion) evaluated together."""
UNIFORM: Final = 12.0**0.5


class Verdict(Enum):
    """Verdict of the watch on an axis."""

    HOLDS = "the model holds"
    RECALIBRATE = "recalibrate"
    """Parts of the model have changed as by wear, temperature or ageing; a calibration corrects this."""
    SOMETHING_CHANGED = "something changed"
    """No such change explains the measurements; a diagnosis is needed."""
    ENCODER = "the load encoder is not believed"


class Raised(NamedTuple):
    """A new verdict."""

    time_s: float
    """Loop time: cycle number times the period."""
    axis: str
    verdict: Verdict
    text: str
    """Evidence in words with figures."""

    @property
    def words(self) -> str:
        """Verdict and evidence in words."""
        return f"{self.verdict.value}: {self.text}" if self.text else self.verdict.value


@dataclass(frozen=True, slots=True)
class WatchSettings:
    """Duration for which evidence is gathered and must persist."""

    window_s: float = 900.0
    """Maximum age of an observation."""
    raise_s: float = 60.0
    """Time for which evidence must persist before a verdict is raised."""
    withdraw_s: float = 300.0
    """Time without evidence after which a verdict is withdrawn."""
    slow_deg_s: float = 0.5
    """Highest load speed at which motion is evaluated; of faster moves only standstills count."""
    allowed: Allowed = Allowed()


class _Steady:
    """Debounced verdict, which changes only when another one has persisted."""

    def __init__(self, settings: WatchSettings) -> None:
        self._settings = settings
        self.verdict = Verdict.HOLDS
        self._other = Verdict.HOLDS
        self._lasted_s = 0.0

    def take(self, verdict: Verdict, passed_s: float) -> bool:
        """Takes the present verdict and the time since the last; returns True when it is adopted."""
        if verdict is self.verdict:
            self._other, self._lasted_s = verdict, 0.0
            return False
        if verdict is not self._other:
            self._other, self._lasted_s = verdict, 0.0
        self._lasted_s += passed_s
        needed = self._settings.withdraw_s if verdict is Verdict.HOLDS else self._settings.raise_s
        if self._lasted_s < needed:
            return False
        self.verdict, self._lasted_s = verdict, 0.0
        return True


class Watch:
    """Watch of one axis."""

    def __init__(
        self,
        axis: AxisConfig,
        model: TransmissionModel,
        place: int = 0,
        settings: WatchSettings | None = None,
    ) -> None:
        """``place`` is the axis's index in a sample; ``model`` predicts its error."""
        self._axis = axis
        self._place = place
        self._settings = settings or WatchSettings()
        self._period_s = axis.drive.cycle_s
        self.health = EncoderHealth(axis, model, place)
        self.evidence: Evidence | None = None
        """Last evidence; None until enough observations exist."""
        self._steady = _Steady(self._settings)
        self._believed = True
        self._zero: FloatArray | None = None
        self._start(model)

    @property
    def axis(self) -> str:
        """Name of the axis."""
        return self._axis.name

    @property
    def model(self) -> TransmissionModel:
        """Model that is watched."""
        return self._model

    @property
    def verdict(self) -> Verdict:
        """Present verdict."""
        return self._steady.verdict if self._believed else Verdict.ENCODER

    def use(self, model: TransmissionModel) -> None:
        """Uses another model from now on; discards observations made with the old one."""
        self.health.use(model)
        self._steady = _Steady(self._settings)
        self._start(model)

    def lost(self) -> None:
        """Restarts the path after lost cycles."""
        self._measuring.restart()

    def take(self, samples: SampleArray) -> list[Raised]:
        """Judges the next samples, oldest first; returns new verdicts."""
        if not len(samples):
            return []
        judgement = self.health.take(samples)
        self._now_s = float(samples["cycle"][-1]) * self._period_s
        raised: list[Raised] = []
        if judgement.believed != self._believed:
            self._believed = judgement.believed
            self._seen.clear()
            self._zero = None
            verdict = Verdict.ENCODER if not judgement.believed else self._steady.verdict
            raised.append(self._raised(verdict, judgement.why))
        self._observe(samples)
        if self._now_s - self._judged_s >= self._settings.allowed.every_s or self._now_s < self._judged_s:
            raised += self._judge()
        return raised

    def _start(self, model: TransmissionModel) -> None:
        self._model = model
        regressors = Regressors(model)
        channels = tuple(BY_KEY[key] for key in self._axis.channels)
        self._measuring = Measuring(regressors, self._settings.slow_deg_s, channels)
        counts_arcsec = self._axis.motor_encoder.resolution_arcsec / self._axis.gear.ratio
        noise = max(residual_of(model), counts_arcsec / UNIFORM)
        self._judge_of = Judge(regressors, noise, self._settings.allowed)
        self._seen: deque[Observation] = deque(maxlen=OBSERVATIONS)
        self._fresh = 0
        self._zero = None
        self._last_cycle: int | None = None
        self._judged_s = -self._settings.allowed.every_s
        self._now_s = 0.0
        self.evidence = None

    def _observe(self, samples: SampleArray) -> None:
        axis: Any = samples["axes"][:, self._place]
        cycle = samples["cycle"]
        before = self._last_cycle if self._last_cycle is not None else int(cycle[0]) - 1
        self._last_cycle = int(cycle[-1])
        driven = any_of(axis["state"], DRIVEN)
        if not np.all(driven) or np.any(np.diff(cycle, prepend=before) != 1):
            self._measuring.restart()
            if not np.all(driven):
                return
        usable = (axis["flags"] & (SampleFlag.FRESH | SampleFlag.CHANGING)) == SampleFlag.FRESH
        usable &= self._believed
        found = self._measuring.take(cycle * self._period_s, axis, usable)
        self._seen.extend(found)
        self._fresh += len(found)

    def _judge(self) -> list[Raised]:
        passed_s = min(self._now_s - self._judged_s, 2.0 * self._settings.allowed.every_s)
        self._judged_s = self._now_s
        while self._seen and not 0.0 <= self._now_s - self._seen[0].time_s <= self._settings.window_s:
            self._seen.popleft()
        # An axis at rest gives no new evidence, and an uncalibrated one has no model to test.
        if not self._fresh or not self._believed or not self._model.effects:
            return []
        self._fresh = 0
        evidence = self._judge_of.judge(self._seen, self._zero)
        if evidence is None:
            return []
        self.evidence = evidence
        if self._zero is None and not evidence.unexplained:
            self._zero = evidence.zero
        if self._steady.take(self._now(evidence), passed_s):
            return [self._raised(self._steady.verdict, evidence.words())]
        return []

    def _now(self, evidence: Evidence) -> Verdict:
        """Returns the verdict of the evidence; near a limit the present one."""
        if evidence.holds:
            return Verdict.HOLDS if evidence.clearly_holds else self._steady.verdict
        return Verdict.RECALIBRATE if evidence.explained else Verdict.SOMETHING_CHANGED

    def _raised(self, verdict: Verdict, text: str) -> Raised:
        return Raised(self._now_s, self._axis.name, verdict, text)
