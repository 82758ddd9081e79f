"""`hdbridge step`, `demo` and `check` on the simulated drive."""

import gzip
import json

import numpy as np
import pytest


def test_step_prints_a_table_and_writes_the_contract(hdbridge, tmp_path):
    done = hdbridge("step", "article", "--simulate", "--count", 12, "--json", "out.json", "--record", "kept")
    for word in ("none", "synchronous", "hysteresis", "both", "quantisation floor"):
        assert word in done.stdout
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["schema"] == "hdbridge.stepping/1"
    assert result["quantisation_floor_arcsec"] == pytest.approx(2.806, abs=0.001)
    for scheme in ("none", "synchronous", "hysteresis", "both"):
        for part in ("cw", "ccw", "pooled"):
            assert set(result[scheme][part]) == {"three_sigma_arcsec", "mean_arcsec"}
        errors = result[scheme]["steps"]["cw"]["error_arcsec"]
        assert len(errors) == 12
        assert np.mean(errors) == pytest.approx(result[scheme]["cw"]["mean_arcsec"])
    assert result["none"]["cw"]["mean_arcsec"] > 30
    assert result["none"]["ccw"]["mean_arcsec"] < -30
    assert result["both"]["pooled"]["three_sigma_arcsec"] < 4.5
    with gzip.open(tmp_path / "kept" / "stepping-both.csv.gz", "rt") as file:
        assert file.readline().strip().split(",")[0] == "time_s"


def test_demo_writes_every_file_it_names(hdbridge, tmp_path):
    hdbridge("demo", "--count", 4)
    page = (tmp_path / "demo-output" / "stepping.html").read_text()
    assert "<html" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert json.loads((tmp_path / "demo-output" / "stepping.json").read_text())["both"]


def test_check_explains_the_files(hdbridge):
    done = hdbridge("check", "article")
    for fact in ("ratio", "50", "3.24 arcsec", "synchronous, hysteresis", "all right"):
        assert fact in done.stdout


def test_a_profile_without_a_model_gets_advice(hdbridge):
    done = hdbridge("step", "demo", "--simulate", status=2)
    assert "calibrate first: hdbridge calibrate demo, and commit" in done.stderr
    assert "; or step without one: --scheme none" in done.stderr
