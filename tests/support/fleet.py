"""Small recordings of a joint, without a simulated drive."""

import numpy as np

from hdbridge.axis.effects import Motion
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

MODEL = """schema: hdbridge.model/1
ratio: 50.0
effects:
  - effect: synchronous
    parameters:
      orders:
        - {order: 1, amplitude_arcsec: 6.0, phase_deg: 30.0}
        - {order: 2, amplitude_arcsec: 12.0, phase_deg: -70.0}
        - {order: 4, amplitude_arcsec: 5.0, phase_deg: 110.0}
  - effect: hysteresis
    parameters: {offset_arcsec: 30.0, width_deg: 25.0, exponent: 1.7}
"""


def record(seed, extra_arcsec=0.0, samples=700, zero_deg=0.0):
    """Returns two sweeps each way over five motor turns; ``extra_arcsec`` is the amplitude of order 3."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 30.0, samples)
    motor = 900.0 * (1.0 - np.cos(2.0 * np.pi * time / 15.0))
    error = TransmissionModel.from_text(MODEL).predict(Motion(motor_deg=motor, time_s=time))
    error = error + extra_arcsec * np.cos(3.0 * np.radians(motor)) + rng.normal(0.0, 0.3, samples)
    return Record(
        {
            "time_s": time,
            "motor_position_deg": motor + zero_deg,
            "load_position_deg": motor / 50.0 + error / 3600.0,
        }
    )
