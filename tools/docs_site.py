"""Hooks for the site of `make docs`, called by MkDocs (mkdocs.yml), which add pages to those in docs/.

The API reference is generated from the docstrings of the public names of `import hdbridge`. CONTRIBUTING.md
and CHANGELOG.md are in the project's root folder, where readers look for them; the site includes them.
"""

from pathlib import Path
from typing import Any

import hdbridge
import hdbridge.testing

ROOT = Path(__file__).resolve().parents[1]
FROM_THE_TOP = {"contributing.md": "CONTRIBUTING.md", "changes.md": "CHANGELOG.md"}
REFERENCE = """# API reference

Made from the docstrings of what `import hdbridge` and `import hdbridge.testing` give. How these work
together, with examples: [library](api.md).
"""


def reference() -> str:
    """Returns the page of the API reference: every public name, the errors last."""
    public = {name: getattr(hdbridge, name) for name in getattr(hdbridge, "__all__", ())}
    errors = {name for name, each in public.items() if isinstance(each, type) and issubclass(each, Exception)}
    groups: tuple[tuple[str, list[str]], ...] = (
        ("Classes and functions", [name for name in public if name not in errors]),
        ("Errors", sorted(errors)),
    )
    groups += (("For tests of other programs", list(hdbridge.testing.__all__)),)
    public |= {name: getattr(hdbridge.testing, name) for name in hdbridge.testing.__all__}
    parts = [REFERENCE]
    for title, names in groups:
        parts.append(f"## {title}\n")
        parts += [f"::: {public[name].__module__}.{public[name].__qualname__}\n" for name in names]
    return "\n".join(parts)


def generated() -> dict[str, str]:
    """Returns the additional pages as Markdown, by their path in the site."""
    pages = {
        page: (ROOT / source).read_text(encoding="utf-8").replace("](docs/", "](")
        for page, source in FROM_THE_TOP.items()
    }
    return pages | {"reference.md": reference()}


def on_files(files: Any, config: Any) -> Any:
    """Adds the additional pages to the site."""
    from mkdocs.structure.files import File  # noqa: PLC0415  the tests of this file need no MkDocs

    for path, text in generated().items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Redirects links to files in the project's root folder to their pages in the site."""
    for page, source in FROM_THE_TOP.items():
        markdown = markdown.replace(f"](../{source})", f"]({page})")
    return markdown


def on_post_template(output_content: str, **_: Any) -> str:
    """Applies `on_post_page` to pages outside docs/ (404.html)."""
    return on_post_page(output_content)


def on_post_page(output: str, **_: Any) -> str:
    """Redirects the theme's only external script (which enables search in local files) to a local copy."""
    return output.replace("https://unpkg.com/iframe-worker/shim", "assets/iframe-worker.js")
