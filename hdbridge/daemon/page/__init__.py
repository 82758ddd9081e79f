"""Live page: a browser's view of the daemon, with buttons that require the lease.

It consists of static files; all data comes over the API. The charts use uPlot, which is already part of the
reports, and `POLICY` forbids the browser to load anything from elsewhere.
"""

from typing import Any, Final

from starlette.responses import Response
from starlette.staticfiles import StaticFiles

PAGE: Final = "index.html"
"""File served at the root of the site."""
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content-Security-Policy of the page. uPlot needs inline styles to place its canvases."""


class PageFiles(StaticFiles):
    """Files of the page and of the reports."""

    def __init__(self) -> None:
        super().__init__(packages=[(__name__, "assets"), ("hdbridge.report", "assets")])

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["Content-Security-Policy"] = POLICY
        return response
