"""Model that contains the compliance of the gear."""

from hdbridge.axis.model import TransmissionModel


def with_spring(model: TransmissionModel, compliance: float) -> TransmissionModel:
    """Returns the model with a linear compliance, arcsec/Nm, as if the calibration had found it."""
    zones = ", ".join(f"c{zone}_arcsec_per_nm: {compliance:.6g}" for zone in (1, 2, 3))
    return TransmissionModel.from_text(
        model.dump().replace(
            "effects:\n",
            "effects:\n  - effect: compliance\n"
            f"    parameters: {{{zones}, torque1_nm: 1000.0, torque2_nm: 2000.0, torque: load_torque_nm}}\n",
        )
    )
