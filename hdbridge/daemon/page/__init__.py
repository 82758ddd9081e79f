"""The live page: what a browser shows of the daemon, and the buttons behind the lease.

Static files only; everything that moves comes over the API. Nothing is fetched from elsewhere: the charts are
uPlot's, which the reports carry already, and `POLICY` forbids the browser to load anything from outside.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Final

PAGE: Final = "index.html"
"""The file at the root of the site."""
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content-Security-Policy of the page. Inline styles are uPlot's: it places its canvases by them."""
_TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}
_FROM_REPORTS: Final = {"uplot.js": "uPlot.iife.min.js", "uplot.css": "uPlot.min.css"}


@cache
def page_files() -> dict[str, tuple[bytes, str]]:
    """Content and content type of each file of the page, by its name."""
    found = {each.name: each.read_bytes() for each in files(__name__).joinpath("assets").iterdir()}
    reports = files("hdbridge.report").joinpath("assets")
    found |= {name: reports.joinpath(source).read_bytes() for name, source in _FROM_REPORTS.items()}
    return {name: (content, _TYPES[name[name.rindex(".") :]]) for name, content in sorted(found.items())}


def page_file(name: str) -> tuple[bytes, str] | None:
    """Content and content type of one file; None where there is none of that name."""
    return page_files().get(name)
