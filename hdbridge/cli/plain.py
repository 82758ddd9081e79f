"""Replacement of characters that the output encoding cannot represent."""

import codecs
from typing import Final

HANDLER: Final = "hdbridge.plain"
"""Name of the error handler of a text stream."""
_PLAIN: Final = str.maketrans(
    {"σ": "s", "±": "~", "→": ">", "°": " ", "²": "2", "µ": "u", "–": "-", "…": "~"}
)
"""One character for one, so that a table stays aligned."""


def _replaced(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end].translate(_PLAIN)
    return text.encode("ascii", errors="replace").decode("ascii"), error.end


codecs.register_error(HANDLER, _replaced)
