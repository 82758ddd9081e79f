"""A fleet of two measured joints: supported and refused statements.

Four one-way moves of a second each, all within minutes: nothing can have changed, so no joint may be listed.
"""

import pytest
import real_records

from hdbridge.fleet.dataset import Dataset
from hdbridge.fleet.diagnosing import diagnosed, fitted, model_in
from hdbridge.fleet.sources import Source
from hdbridge.fleet.summary import summarise

FOLDER = real_records.FOLDER / "cobot"
pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(),
    reason="HDBRIDGE_REAL_RECORDS is not the folder of the measured records",
)
SOURCES = [
    Source(
        str(FOLDER / f"joint{joint}-{number}.csv"), joint=f"joint{joint}", ratio=100.0, hours=float(number)
    )
    for joint in (4, 5)
    for number in range(1, 5)
]


def test_without_a_model_the_moves_do_not_suffice_for_one():
    for own in (SOURCES[:4], SOURCES[4:]):
        reason = fitted(own, "model.yaml").reason
        assert reason.startswith("no model could be fitted")
        assert "slow sweeps" in reason


def test_findings_are_named_without_ranking_or_forecast(tmp_path):
    bare = model_in("schema: hdbridge.model/1\nratio: 100.0\neffects: []\n", "model.yaml")
    dataset = Dataset(tmp_path / "out")
    dataset.create()
    dataset.add([diagnosed(each, bare) for each in SOURCES])
    dataset.compact()
    rows = dataset.recordings()
    assert [row["reason"] for row in rows] == [None] * 8
    named = [each for row in rows for each in row["findings"] if each["cause"] != "unexplained"]
    assert named
    assert max(each["probability"] for each in named) <= 0.6
    # Below two motor turns the orders are not separable, so no identity is claimed.
    assert [row["orders"] for row in rows] == [[]] * 8
    found = summarise(rows, 10.0)
    assert (found.first, found.mistaken, found.odd) == ((), (), ())
