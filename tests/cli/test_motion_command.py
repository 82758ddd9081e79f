"""`hdbridge motion` on the simulated drive."""

import json

import pytest
from support.raised import raised_profile


@pytest.fixture
def fast(tmp_path):
    return raised_profile(tmp_path / "fast")


def test_it_measures_the_response_proposes_it_and_the_committed_model_uses_it(hdbridge, fast, tmp_path):
    done = hdbridge("motion", "fast", "--simulate", "--propose", "--json", "out.json", "--html", "out.html")
    assert done.returncode == 0, done.stderr
    assert "pending" in done.stdout
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["schema"] == "hdbridge.motion/1"
    assert result["response"]["known_to_hz"] > 70.0
    for each in result["speeds"]:
        assert each["removed_percent"] > 80.0
        assert each["removed_percent"] > each["removed_static_percent"] - 3.0
    assert result["speeds"][-1]["removed_static_percent"] < 50.0
    assert [each["order"] for each in result["speeds"][0]["orders"]] == [1, 2, 3, 4, 6, 8]
    for each in result["paths"]:
        none, static, filtered = (each[name]["path_arcsec"] for name in ("none", "static", "filtered"))
        assert filtered < 0.8 * static < 0.8 * none, each
        assert abs(each["filtered"]["rest_arcsec"]) < abs(each["static"]["rest_arcsec"]) + 0.5
    assert "Path error" in (tmp_path / "out.html").read_text()
    assert "Gain" in (tmp_path / "out.html").read_text()
    done = hdbridge("model", "commit", "fast")
    assert done.returncode == 0, done.stderr
    done = hdbridge("motion", "fast", "--simulate", "--no-measure", "--json", "again.json")
    assert done.returncode == 0, done.stderr
    again = json.loads((tmp_path / "again.json").read_text())
    for one, other in zip(result["speeds"], again["speeds"], strict=True):
        assert other["filtered_arcsec"] == pytest.approx(one["filtered_arcsec"], rel=0.1, abs=0.2)
    assert again["remarks"] == []
    assert "corrected up to 90 Hz" in hdbridge("check", "fast").stdout
    # At rest the axis points as well as without the response.
    done = hdbridge("step", "fast", "--simulate", "--count", 12, "--scheme", "both", "--json", "step.json")
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "step.json").read_text())["both"]["pooled"]["three_sigma_arcsec"] < 4.5

    # Another servo is noticed.
    path = fast / "truth.yaml"
    text = path.read_text(encoding="utf-8")
    for tuned in ("command_filter_ms: 1.0", "command_filter_ms: 4.0"), ("gain_per_s: 200", "gain_per_s: 110"):
        assert tuned[0] in text
        path.write_text(text.replace(*tuned), encoding="utf-8")
        done = hdbridge("motion", "fast", "--simulate", "--no-measure")
        assert done.returncode == 0, done.stderr
        assert "measure the response again" in done.stdout, tuned


def test_a_model_without_orders_and_a_proposal_without_a_measurement_are_refused(hdbridge, tmp_path):
    (tmp_path / "none.yaml").write_text("schema: hdbridge.model/1\nratio: 50\neffects: []\n")
    done = hdbridge("motion", "article", "--simulate", "--model", "none.yaml")
    assert done.returncode == 2
    assert "no motor order" in done.stderr
    done = hdbridge("motion", "article", "--simulate", "--no-measure", "--propose")
    assert done.returncode == 2
    assert "--no-measure" in done.stderr
