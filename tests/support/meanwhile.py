"""Hook that changes a file, as another process would, just before this process opens it."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

_hooks: list[Callable[[str, Path], None]] = []


def _audit(event: str, arguments: tuple[object, ...]) -> None:
    if _hooks and event in ("open", "os.scandir") and isinstance(arguments[0], str):
        for each in tuple(_hooks):
            each(event, Path(arguments[0]))


@cache
def _installed() -> None:
    """Installs the hook once. It cannot be removed, and with no entries in `_hooks` it does nothing."""
    sys.addaudithook(_audit)


@contextmanager
def before_each(hook: Callable[[str, Path], None]) -> Iterator[None]:
    """Calls ``hook`` before any file is opened, and before any folder is listed."""
    _installed()
    _hooks.append(hook)
    try:
        yield
    finally:
        _hooks.remove(hook)
