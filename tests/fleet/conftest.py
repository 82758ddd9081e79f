"""Small recordings of a few joints, and a cluster shared by the tests."""

from pathlib import Path

import pytest
from support.fleet import MODEL, record


@pytest.fixture(scope="session")
def fleet(tmp_path_factory) -> Path:
    """Three joints, three recordings each (one with a different encoder), a copy, bad files, a manifest."""
    folder = tmp_path_factory.mktemp("fleet")
    (folder / "model.yaml").write_text(MODEL)
    rows = ["path,joint,hours,batch"]
    for joint in range(3):
        for number in range(3):
            name = f"J{joint}-{number}.csv.gz"
            zero = 77.0 * (name == "J2-2.csv.gz")
            each = record(10 * joint + number, extra_arcsec=3.0 * number * (joint == 0), zero_deg=zero)
            each.write_csv(folder / name)
            rows.append(f"{name},J{joint},{1000 * number + 10},{'A' if joint else 'B'}")
    (folder / "again.csv.gz").write_bytes((folder / "J1-1.csv.gz").read_bytes())
    (folder / "broken.csv").write_text("time_s,motor_position_deg,load_position_deg\n0,0,x\n")
    rows += ["again.csv.gz,J1,1010,A", "broken.csv,J2,5000,A", "missing.csv,J2,6000,A"]
    (folder / "manifest.csv").write_text("\n".join(rows) + "\n")
    return folder


@pytest.fixture(scope="session")
def scheduler():
    """The address of a cluster with two workers."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        memory_limit="1GB",
        dashboard_address="127.0.0.1:0",
        silence_logs=50,
    ) as cluster:
        yield cluster.scheduler_address
