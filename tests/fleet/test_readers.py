"""The data set in the programs that it is written for; each is skipped where it is not installed."""

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
    table = pandas.read_parquet(out / "recordings")
    assert sorted(table["joint"]) == ["A", "B"]
    found = pandas.read_parquet(out / "findings").merge(table, on=["key", "path"])
    assert found["hours"].tolist() == [10.0]


def test_polars_reads_a_folder_as_one_table(out):
    polars = pytest.importorskip("polars")
    table = polars.read_parquet(out / "recordings" / "*.parquet")
    assert sorted(table["joint"].to_list()) == ["A", "B"]
    found = polars.read_parquet(out / "findings" / "*.parquet").join(table, on=["key", "path"])
    assert found["hours"].to_list() == [10.0]


def test_duckdb_reads_a_folder_as_one_table(out):
    duckdb = pytest.importorskip("duckdb")
    found = duckdb.sql(
        f"select cause, hours from '{out}/findings/*.parquet' "
        f"join '{out}/recordings/*.parquet' using (key, path)"
    ).fetchall()
    assert found == [("backlash", 10.0)]
