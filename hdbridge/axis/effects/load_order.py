"""Errors that repeat with each load turn: eccentricity of the load encoder, or pitch error of a spline."""

from dataclasses import replace
from typing import Annotated, Literal

from pydantic import Field

from hdbridge.axis.effects import coordinate as over
from hdbridge.axis.effects.coordinate import Coordinate
from hdbridge.axis.effects.described import Cause, Compensable, Experiment
from hdbridge.axis.effects.motion import Motion
from hdbridge.axis.effects.orders import OrderSeries, orders_from

Ratio = Annotated[float, Field(gt=0, le=1000, description="N of the model: motor turns per load turn")]


class LoadOrders(OrderSeries):
    """Sum of A_k cos(k theta_M / N + phi_k)."""

    name = "load_order"
    about = Cause(
        title="once or twice per load turn",
        subject="load orders",
        equation="sum over k of A_k cos(k theta_M / N + phi_k)",
        signature="k periods per turn of the load, the same in both directions and on every turn",
        consequence="from the pitch of the spline, the load is wrong; from the load encoder, only the "
        "measurement is",
        remedy="centre the load encoder; then compensate the rest (set origin: gear)",
        experiment="two load turns both ways, again with the load encoder re-clocked by 90 deg: its error "
        "turns with it; again without a mass off centre",
        aliases=("compliance", "ratio_error", "zero_drift"),
        source="geometry of an eccentric disc; pitch error of the splines",
        size="5-60 arcsec",
        apart={
            "compliance": Experiment(
                5,
                "take the mass off or turn it by 90 deg, sweep one load turn both ways: a wind-up "
                "changes with it",
            ),
            "ratio_error": Experiment(
                6, "sweep two whole load turns both ways: a ramp continues, a load order repeats"
            ),
        },
    )
    compensable = Compensable(
        False,
        "no, unless its origin is known to be the gear, because the run-out of a load encoder is an error of "
        "the measurement",
    )
    typical = {"orders": orders_from((1, 2), 10.0)}
    searched = range(1, 5)

    ratio: Ratio
    origin: Literal["unknown", "gear", "load_encoder"] = Field(
        "unknown", description="origin of the error; only that of the gear is compensated"
    )

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        return replace(over.load_angle(motion, ratio), bins=120)

    def turns_per_motor_turn(self) -> float:
        return 1.0 / self.ratio

    def is_compensable(self) -> bool:
        """Returns True if the gear is known to be the source, because then the load really moves."""
        return self.origin == "gear"
