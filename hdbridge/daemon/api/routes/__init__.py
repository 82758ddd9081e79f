"""Routes of the API, one file per subject; each creates a router over a `Bridge`."""
