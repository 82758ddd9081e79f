"""From records to parameters with uncertainties.

`fit` takes a measurement (`hdbridge.estimation.samples.Measured`) and returns a `FitResult`: the model, 95 %
intervals that allow for noise that is not white, held-out figures, residual tests, and in words what the data
cannot say.
"""

from hdbridge.estimation.intervals import Interval
from hdbridge.identify.fit import fit
from hdbridge.identify.options import FitOptions
from hdbridge.identify.orders import Family, Line, Order
from hdbridge.identify.result import FitResult

__all__ = [
    "Family",
    "FitOptions",
    "FitResult",
    "Interval",
    "Line",
    "Order",
    "fit",
]
