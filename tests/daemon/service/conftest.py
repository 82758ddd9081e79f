"""A service on a stepped loop with one simulated axis."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from support.service import Service, stepped_service


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    with stepped_service(tmp_path) as made:
        yield made
