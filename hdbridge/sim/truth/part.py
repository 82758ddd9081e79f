"""What all parts of a truth file have in common."""

from __future__ import annotations

from hdbridge.strictness import Strict


class Part(Strict):
    """A mapping of the file: frozen, no unknown keys, finite numbers."""
