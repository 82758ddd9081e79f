"""The data set in other programs, each skipped if not installed."""

import pytest

from hdbridge.fleet.dataset import Dataset


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """A data set of two recordings in two parts, one with a finding."""
    dataset = Dataset(tmp_path_factory.mktemp("readers") / "out")
    finding = {"rank": 1, "cause": "backlash", "probability": 0.9, "peak_arcsec": 4.0, "aliases": ["creep"]}
    rows = [
        {"key": "0a", "path": "a.csv", "joint": "A", "hours": 10.0, "remarks": [], "findings": [finding]},
        {"key": "f1", "path": "b.csv", "joint": "B", "hours": None, "reason": "broken", "findings": []},
    ]
    blank = {"date": None, "samples_sha256": None}
    dataset.create()
    dataset.add([{**blank, **row} for row in rows])
    dataset.compact()
    return dataset.folder


def test_pandas_reads_a_folder_as_one_table(out):
    pandas = pytest.importorskip("pandas")
    findings, recordings = (pandas.read_parquet(out / each) for each in ("findings", "recordings"))
    assert findings.merge(recordings, on=["key", "path"])["hours"].tolist() == [10.0]


def test_polars_reads_a_folder_as_one_table(out):
    polars = pytest.importorskip("polars")
    findings, recordings = (
        polars.read_parquet(out / each / "*.parquet") for each in ("findings", "recordings")
    )
    assert findings.join(recordings, on=["key", "path"])["hours"].to_list() == [10.0]


def test_duckdb_reads_a_folder_as_one_table(out):
    duckdb = pytest.importorskip("duckdb")
    both = f"'{out}/findings/*.parquet' join '{out}/recordings/*.parquet' using (key, path)"
    assert duckdb.sql(f"select cause, hours from {both}").fetchall() == [("backlash", 10.0)]
