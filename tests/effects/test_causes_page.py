"""docs/causes.md matches the catalogue."""

import catalogue_docs

from hdbridge.axis.effects import CATALOGUE


def test_the_page_of_causes_is_up_to_date():
    assert catalogue_docs.PAGE.read_text(encoding="utf-8") == catalogue_docs.page(), (
        "run python tools/catalogue_docs.py"
    )


def test_every_cause_has_its_section_with_every_parameter():
    overview = catalogue_docs.page().split("\n## ")[0]
    sections = {each.split("\n", 1)[0]: each for each in catalogue_docs.page().split("\n## ")[1:]}
    assert list(sections) == list(CATALOGUE)
    for name, kind in CATALOGUE.items():
        for parameter in kind.model_fields:
            assert f"`{parameter}`" in sections[name]
        for words in ("Remedy", "Experiment", "Source"):
            assert f"**{words}**" in sections[name]
        assert ("**Not compensated**" in sections[name]) is not kind.compensable.possible
        assert kind.about.signature in overview
        assert kind.about.consequence in sections[name]
