"""From records to parameters with uncertainties."""
