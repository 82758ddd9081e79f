"""Live page: a browser's view of the daemon, with buttons that require the lease.

It consists of static files; all data comes over the API. The charts use uPlot, which is already part of the
reports, and `POLICY` forbids the browser to load anything from elsewhere.
"""

from functools import cache
from importlib.resources import files
from typing import Final

PAGE: Final = "index.html"
"""File served at the root of the site."""
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content-Security-Policy of the page. uPlot needs inline styles to place its canvases."""
_TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}
_FROM_REPORTS: Final = {"uplot.js": "uPlot.iife.min.js", "uplot.css": "uPlot.min.css"}


@cache
def page_files() -> dict[str, tuple[bytes, str]]:
    """Returns content and content type of each file of the page, by name."""
    found = {each.name: each.read_bytes() for each in files(__name__).joinpath("assets").iterdir()}
    reports = files("hdbridge.report").joinpath("assets")
    found |= {name: reports.joinpath(source).read_bytes() for name, source in _FROM_REPORTS.items()}
    return {name: (content, _TYPES[name[name.rindex(".") :]]) for name, content in sorted(found.items())}
