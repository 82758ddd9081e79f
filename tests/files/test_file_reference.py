"""The file reference in the docs matches the code."""

import re

import file_reference
import pytest

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.files.profile import bundled_profile


@pytest.fixture(scope="module")
def tool():
    return file_reference


@pytest.mark.parametrize("path", file_reference.PAGES, ids=lambda path: path.name)
def test_the_page_is_up_to_date(tool, path):
    page = path.read_text(encoding="utf-8")
    assert tool.updated(page) == page, "run python tools/file_reference.py"


def test_every_table_is_on_the_page(tool):
    pages = "".join(path.read_text(encoding="utf-8") for path in tool.PAGES)
    assert set(re.findall(r"<!-- generated: ([a-z-]+) -->", pages)) == set(tool.BLOCKS)


def test_every_key_has_a_meaning(tool):
    rows = [
        row
        for name in ("axis", "machine", "model", "recording", "history", "plan", "procedures")
        for row in tool.BLOCKS[name]().splitlines()[2:]
    ]
    assert [row for row in rows if row.endswith("|  |")] == []


def examples(tool):
    return re.findall(r"```yaml\n(.*?)```", tool.PAGES[0].read_text(encoding="utf-8"), re.DOTALL)


def test_the_channels_on_the_page_are_right(tool):
    (example,) = [each for each in examples(tool) if "load_torque:" in each]
    path = bundled_profile("article") / "axis.yaml"
    axis = AxisConfig.from_text(path.read_text() + example, path)
    assert set(axis.channels) == {"load_torque", "temperature"}


def test_the_model_on_the_page_is_right(tool):
    (example,) = [each for each in examples(tool) if "schema: hdbridge.model/1" in each]
    model = TransmissionModel.from_text(example)
    assert [each.name for each in model.effects] == ["synchronous", "hysteresis"]
    model.check_bound_to(AxisConfig.load(bundled_profile("article")))
