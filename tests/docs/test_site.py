"""The configuration of `make docs`: every page is in its menu, every public name in its reference."""

from pathlib import Path

import docs_site
import yaml

import hdbridge.testing

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))


def leaves(menu):
    for each in menu:
        if isinstance(each, str):
            yield each
        else:
            for below in each.values():
                yield from leaves([below] if isinstance(below, str) else below)


def test_every_page_is_in_the_menu():
    listed = [*leaves(SETTINGS["nav"])]
    assert sorted(listed) == sorted(
        {*(each.name for each in (ROOT / "docs").glob("*.md")), *docs_site.generated()}
    )


def test_the_site_is_strict_and_fetches_nothing():
    assert SETTINGS["strict"] is True
    assert SETTINGS["theme"]["font"] is False
    page = '<script src="https://unpkg.com/iframe-worker/shim"></script>'
    taken_in = docs_site.on_post_page(page)
    assert "https:" not in taken_in
    assert (ROOT / "docs" / "assets" / "iframe-worker.js").exists()


def test_the_reference_has_every_public_name():
    page = docs_site.reference()
    for name in (*hdbridge.__all__, *hdbridge.testing.__all__):
        assert f".{name}\n" in page


def test_links_to_the_top_of_the_project_lead_to_pages_of_the_site():
    assert docs_site.on_page_markdown("[a](../CONTRIBUTING.md)") == "[a](contributing.md)"
    assert "](docs/" not in docs_site.generated()["contributing.md"]
