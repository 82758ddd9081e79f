"""`hdbridge motion` on the simulated drive."""

import json
import re
from dataclasses import replace

import pytest
from support.raised import raised_profile

from hdbridge.axis.model import TransmissionModel
from hdbridge.axis.model.response import LeadFilter, Response
from hdbridge.report.motion import PATH_COLUMNS

OF_ANOTHER_CYCLE = Response(
    cycle_ms=3.0, following_lag_ms=5.0, known_to_hz=10.0,
    frequency_hz=(10.0,), gain=(1.0,), phase_deg=(0.0,), uncertainty=(0.1,),
    filter=LeadFilter(lead_cycles=0, per_cycle=1, full_speed_deg_s=1.0, weights=(1.0,)),
)  # fmt: skip


OF_THIS_CYCLE = OF_ANOTHER_CYCLE.model_copy(update={"cycle_ms": 4.0})


@pytest.fixture
def fast(tmp_path):
    return raised_profile(tmp_path / "fast")


def test_measures_and_proposes_the_response_and_the_committed_model_uses_it(hdbridge, fast, tmp_path):
    model = TransmissionModel.load(fast / "model.yaml")
    replace(model, response=OF_ANOTHER_CYCLE).save(fast / "model.yaml")
    advice = re.search("hdbridge (motion AXIS --propose)", hdbridge("check", "fast", status=2).stderr)
    command = advice[1].replace("AXIS", "fast").split()
    done = hdbridge(*command, "--simulate", "--json", "out.json", "--html", "out.html")
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
        assert each["wind_up"]["delayed_arcsec"] < 0.6 * each["filtered"]["delayed_arcsec"], each
        assert abs(each["wind_up"]["rest_arcsec"]) < abs(each["static"]["rest_arcsec"]) + 0.5
    # Load inertia 0.225 kg m2 and gear stiffness 16,000 Nm/rad of the article.
    assert result["wind_up"]["inertia_over_stiffness_s2"] == pytest.approx(0.225 / 16000.0, rel=0.1)
    page = (tmp_path / "out.html").read_text()
    assert all(word in page and word in done.stdout for word in (*PATH_COLUMNS, "wind-up compensated"))
    assert "Gain" in (tmp_path / "out.html").read_text()
    done = hdbridge("model", "commit", "fast")
    done = hdbridge("motion", "fast", "--simulate", "--no-measure", "--json", "again.json")
    again = json.loads((tmp_path / "again.json").read_text())
    for one, other in zip(result["speeds"], again["speeds"], strict=True):
        assert other["filtered_arcsec"] == pytest.approx(one["filtered_arcsec"], rel=0.1, abs=0.2)
    assert again["remarks"] == []
    assert "corrected up to 90 Hz" in hdbridge("check", "fast").stdout
    # At rest the accuracy is the same as without the response.
    done = hdbridge("step", "fast", "--simulate", "--count", 12, "--scheme", "both", "--json", "step.json")
    assert json.loads((tmp_path / "step.json").read_text())["both"]["pooled"]["three_sigma_arcsec"] < 4.5

    # Another servo is noticed.
    done = hdbridge("doctor", "fast", "--simulate", "--servo")
    path = fast / "truth.yaml"
    text = path.read_text(encoding="utf-8")
    for tuned in (("gain_per_s: 200", "gain_per_s: 130"),):
        assert tuned[0] in text
        path.write_text(text.replace(*tuned), encoding="utf-8")
        done = hdbridge("doctor", "fast", "--simulate", "--servo", "--json", "doctor.json", status=4)
        checks = json.loads((tmp_path / "doctor.json").read_text())["checks"]
        assert [each["name"] for each in checks if each["outcome"] != "pass"] == ["servo"]
        assert "measure it again" in done.stdout, tuned


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"response": OF_ANOTHER_CYCLE}, "measured with a cycle of 3 ms"),
        ({"response": OF_THIS_CYCLE, "provenance": {"axis": "another"}}, "'another'"),
    ],
)
def test_doctor_reports_a_stale_response_before_anything_moves(hdbridge, fast, tmp_path, changes, complaint):
    replace(TransmissionModel.load(fast / "model.yaml"), **changes).save(fast / "model.yaml")
    hdbridge("doctor", "fast", "--simulate", "--servo", "--no-motion", "--json", "doctor.json", status=2)
    checks = json.loads((tmp_path / "doctor.json").read_text())["checks"]
    (stale,) = [each for each in checks if each["outcome"] == "fail"]
    assert stale["name"] == "response"
    assert complaint in stale["measured"]
    assert "'the stored response'" in checks[-1]["measured"]


def test_a_model_without_orders_and_a_proposal_without_a_measurement_are_refused(hdbridge, tmp_path):
    (tmp_path / "none.yaml").write_text("schema: hdbridge.model/1\nratio: 50\neffects: []\n")
    done = hdbridge("motion", "article", "--simulate", "--model", "none.yaml", status=2)
    assert "no motor order" in done.stderr
    done = hdbridge("motion", "article", "--simulate", "--no-measure", "--propose", status=2)
    assert "--no-measure" in done.stderr
