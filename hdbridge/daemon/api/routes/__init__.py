"""What may be asked: one file per subject; each makes a router over the `Bridge` that it is given."""
