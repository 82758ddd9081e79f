"""The synchronous client is the asyncio one without its keywords."""

import pytest
import synchronous_client


@pytest.mark.parametrize(("source", "made"), synchronous_client.MADE.items())
def test_the_synchronous_client_is_up_to_date(source: str, made: str) -> None:
    text = (synchronous_client.CLIENT / made).read_text(encoding="utf-8")
    assert text == synchronous_client.synchronous(source), "run python tools/synchronous_client.py"
