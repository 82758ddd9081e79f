"""Base class of all parts of a truth file."""

from hdbridge.strictness import Strict


class Part(Strict):
    """Mapping of the file: frozen, no unknown keys, finite numbers."""
