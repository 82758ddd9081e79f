"""Keys under ``recorder`` of a machine file: folder, size and age of flight recordings."""

from pydantic import Field

from hdbridge.strictness import Strict


class RecorderSettings(Strict):
    """Settings of the ring on disk and of the recordings kept aside."""

    folder: str | None = Field(
        None,
        min_length=1,
        description="folder of the recordings; by default recordings/daemon next to this file, or in the "
        "state folder of the service",
    )
    size_mb: float = Field(2000.0, ge=1, le=1e7, description="size of the ring")
    age_days: float = Field(30.0, gt=0, le=36_500, description="age at which a file of the ring is removed")
    file_mb: float = Field(64.0, ge=0.1, le=4000, description="size at which the next file begins")
    file_s: float = Field(300.0, ge=5, le=86_400, description="time after which the next file begins")
    before_s: float = Field(60.0, ge=0, le=86_400, description="time before each fault that is kept")
    after_s: float = Field(30.0, ge=0, le=86_400, description="time after each fault that is kept")
    kept_mb: float = Field(
        1000.0,
        ge=1,
        le=1e7,
        description="size of the recordings kept for faults",
    )
    free_mb: float = Field(100.0, ge=0, le=1e7, description="free disk space below which nothing is recorded")
