"""Messages and clients of the daemon.

This package imports nothing of the daemon. `messages` needs only pydantic. The clients need the extra
``hdbridge[daemon]`` and are imported on first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.client.aio import AsyncClient
    from hdbridge.client.sync import Client

__all__ = ["AsyncClient", "Client"]
_MODULES: Final = {"AsyncClient": "aio", "Client": "sync"}
_EXTRA: Final = frozenset({"httpx", "websockets"})


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'hdbridge.client' has no attribute '{name}'")
    try:
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    except ModuleNotFoundError as problem:
        package = str(problem.name).partition(".")[0]
        if package not in _EXTRA:
            raise
        raise InputError(
            f"{name} needs the package {package}, which is not installed; "
            "install the extra: pip install 'hdbridge[daemon]'"
        ) from None
