"""What a terminal or a file cannot show in its encoding is written by something that it can."""

from __future__ import annotations

import codecs
from typing import Final

HANDLER: Final = "hdbridge.plain"
"""Name of the error handler of a text stream."""
_PLAIN: Final = str.maketrans(
    {"σ": "s", "±": "~", "→": ">", "°": " ", "²": "2", "µ": "u", "–": "-", "…": "~"}
)
"""One for one, so that a table stays straight."""


def _replaced(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end].translate(_PLAIN)
    return text.encode("ascii", errors="replace").decode("ascii"), error.end


codecs.register_error(HANDLER, _replaced)
