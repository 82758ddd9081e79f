"""Target of an enabled axis in each cycle: set-point, load loop, compensation, motor counts.

load target -> + load loop -> inverse of the model -> motor counts -> checked against the last counts

`Follower.begin` starts all of these at the actual position. `Follower.follow` is called once per cycle.
"""

import math
from typing import Final

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Moment
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.bench import axis_view, compensation_for
from hdbridge.control.channelstate import ChannelState
from hdbridge.control.loadloop import LoadLoop
from hdbridge.control.switchover import Correction
from hdbridge.daemon.machinefile import LoadLoopSettings
from hdbridge.daemon.setting import CompensationSetting
from hdbridge.drive.feedback import Feedback
from hdbridge.drive.image import ProcessImage
from hdbridge.enums import Scheme
from hdbridge.errors import InputError
from hdbridge.motion import SetPoint
from hdbridge.units import ARCSEC_PER_DEG

ROUNDING_COUNTS: Final = 2
"""Margin of the step check, because both ends of a step are rounded to counts."""
_AT_REST: Final = Moment()


class Follower:
    """Computes the target of one axis, cycle by cycle; uncompensated until `use`."""

    def __init__(self, config: AxisConfig, load_loop: LoadLoopSettings | None, image: ProcessImage) -> None:
        view = axis_view(config)
        self.set_point = SetPoint(view.limits, config.drive.cycle_s)
        self.correction = Correction(compensation_for(config, TransmissionModel(view.ratio)))
        self.compensating = False
        """True if the correction is faded in or fading in."""
        self.target_deg = 0.0
        """Load target of the last cycle, without the load loop's correction."""
        self.loop_arcsec = 0.0
        """Correction by the load loop."""
        self.sensed = ChannelState(config)
        self._axis, self._image, self._ratio = config, image, view.ratio
        self._needs = bool(self.correction.needs)
        self._load_loop = _load_loop(config, load_loop) if load_loop is not None else None
        self._load_loop_on = True
        self._issued = 0
        self._max_step_counts = max_step_counts(config, load_loop)

    # ---------------------------------------------------------------- compensation

    def engage(self, on: bool) -> None:
        """Fades the correction in or out."""
        self.compensating = on
        if on:
            self.correction.engage()
        else:
            self.correction.disengage()

    def use(self, setting: CompensationSetting, *, moving: bool) -> None:
        """Applies a compensation setting, with a ramp if the axis is enabled (``moving``), else at once.

        Raises InputError and changes nothing if the setting does not fit the axis.
        """
        new = setting.compensation(self._axis)
        if new.model != self.correction.model:
            if moving:
                self.correction.change(new)
            else:
                self.correction = Correction(new)
            self.changed()
        self.engage(setting.scheme is not Scheme.NONE)
        if setting.load_loop and not self._load_loop_on and self._load_loop is not None:
            # Start from the correction that is in the target now, so that the target does not jump.
            self._load_loop.reset(self.loop_arcsec)
        self._load_loop_on = setting.load_loop
        if self._load_loop is not None:
            self._load_loop.use_models(setting.adapted or setting.model, self.correction.model)

    # ---------------------------------------------------------------- cycle by cycle

    def begin(self, feedback: Feedback) -> None:
        """Starts set-point, compensation and load loop at the actual position, at rest.

        Raises InputError if the position is outside the limits.
        """
        image = self._image
        image.check_target(feedback.motor_counts)
        motor_deg = image.motor_deg(feedback.motor_counts)
        self.target_deg = motor_deg / self._ratio
        self.set_point.reset(self.target_deg)
        self._issued = image.target_counts
        self.sensed.begin(feedback, motor_deg, self.correction)
        self.engage(self.compensating)
        self._needs = bool(self.correction.needs)
        if self._load_loop is not None:
            self._load_loop.reset()
        self.loop_arcsec = 0.0

    def follow(self, feedback: Feedback) -> int:
        """Advances the set-point by one cycle and returns the compensated target in motor counts.

        Raises InputError if the target cannot be sent.
        """
        target_deg = self.target_deg = self.set_point.step()
        if self._load_loop is not None:
            target_deg = self._with_load_loop(self._load_loop, target_deg, feedback)
        correction = self.correction
        moment = self.sensed.moment(feedback, target_deg, correction) if self._needs else _AT_REST
        follow = correction.command if feedback.fresh else correction.hold
        counts = self._image.target_counts_for(follow(target_deg, moment))
        if not -self._max_step_counts <= counts - self._issued <= self._max_step_counts:
            raise InputError(
                f"target of {counts} motor counts after {self._issued}: the limits of velocity and "
                f"slew allow {self._max_step_counts} in a cycle; the target was not sent"
            )
        self._issued = counts
        return counts

    def changed(self) -> None:
        """Starts or stops tracking the motion history after a change of compensation."""
        needs = bool(self.correction.needs)
        if needs and not self._needs:
            self.sensed.restart()
        self._needs = needs

    @property
    def loop_doubt(self) -> str:
        """Reason why the load loop does not act; empty while it may act."""
        return self._load_loop.doubt if self._load_loop is not None else ""

    def _with_load_loop(self, load_loop: LoadLoop, target_deg: float, feedback: Feedback) -> float:
        """Returns the load target with the load loop's correction, within the limits."""
        image, correction = self._image, self.correction
        load: float | None = None
        if self._load_loop_on and feedback.fresh:
            load = ARCSEC_PER_DEG * image.load_deg(feedback.load_counts)
        by_motor = ARCSEC_PER_DEG * image.motor_deg(feedback.motor_counts) / self._ratio
        by_motor += correction.predicted_arcsec
        moving = not self.set_point.at_rest or correction.changing
        self.loop_arcsec = load_loop.step(ARCSEC_PER_DEG * target_deg, load, by_motor, moving)
        corrected_deg = target_deg + self.loop_arcsec / ARCSEC_PER_DEG
        limits = self._axis.limits
        # If the target is outside the limits, the load loop must not move it further out.
        lower, upper = min(limits.position_min_deg, target_deg), max(limits.position_max_deg, target_deg)
        return min(max(corrected_deg, lower), upper)


def max_step_counts(config: AxisConfig, load_loop: LoadLoopSettings | None) -> int:
    """Returns the largest step of the target in one cycle within the velocity and slew limits; counts."""
    slew_arcsec_s = config.compensation.slew_arcsec_s
    if load_loop is not None:
        slew_arcsec_s += load_loop.slew_arcsec_s
    load_deg = (config.limits.velocity_deg_s + slew_arcsec_s / ARCSEC_PER_DEG) * config.drive.cycle_s
    counts = abs(config.motor_encoder.counts(load_deg * config.gear.ratio))
    return math.ceil(1.000_01 * counts) + ROUNDING_COUNTS


def _load_loop(config: AxisConfig, settings: LoadLoopSettings) -> LoadLoop:
    motor_count_deg = abs(config.motor_encoder.degrees(1)) / config.gear.ratio
    return LoadLoop(
        settings.gain_1_s,
        settings.maximum_arcsec,
        settings.slew_arcsec_s,
        config.drive.cycle_s,
        counts_arcsec=ARCSEC_PER_DEG * (motor_count_deg + abs(config.load_encoder.degrees(1))),
    )
