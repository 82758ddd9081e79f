"""docs/causes.md is what the catalogue says."""

import catalogue_docs

from hdbridge.effects import CATALOGUE


def test_the_page_of_causes_is_up_to_date():
    assert catalogue_docs.PAGE.read_text(encoding="utf-8") == catalogue_docs.page(), (
        "run python tools/catalogue_docs.py"
    )


def test_every_cause_has_its_section_with_every_parameter():
    sections = {each.split("\n", 1)[0]: each for each in catalogue_docs.page().split("\n## ")[1:]}
    assert list(sections) == list(CATALOGUE)
    for name, kind in CATALOGUE.items():
        for parameter in kind.model_fields:
            assert f"`{parameter}`" in sections[name]
        for words in ("Signature", "What it does to the axis", "What to do about it", "Separate it", "Needs"):
            assert f"**{words}**" in sections[name]
