"""How a model differs from a measurement, the physical cause by its name, and what extending the
model gains.

`diagnose` takes a record and a model and returns a `Diagnosis`: findings, what the data could and could
not have shown, the extended model, and arrays for pictures. Pure: no files, no clock.
"""

from hdbridge.diagnose.diagnose import diagnose
from hdbridge.diagnose.result import Diagnosis, Figures, Finding, Identifiability, Parameter, Traces

__all__ = ["Diagnosis", "Figures", "Finding", "Identifiability", "Parameter", "Traces", "diagnose"]
