"""`hdbridge scan` as a person uses it."""

import json


def test_scan_lists_the_drive_and_recognises_it(hdbridge, tmp_path):
    done = hdbridge("scan", "article", "--simulate", "--json", "out.json")
    for text in ("drive (CiA 402)", "PP, HM, IP, CSP", "node_id: 1", "is the drive of"):
        assert text in done.stdout
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["schema"] == "hdbridge.scan/1"
    assert result["axis"]["matches"] is True
    (node,) = result["nodes"]
    assert (node["node_id"], node["profile"], node["usable"]) == (1, 402, True)
    assert node["identity"]["vendor_id"] == 0x4844


def test_scan_names_the_line_that_differs(hdbridge, profile):
    folder = profile("product_code: 0x402", "product_code: 0x403")
    done = hdbridge("scan", folder, "--simulate", status=4)
    assert (
        f"{folder}/axis.yaml:16:5: drive.identity.product_code: found 0x403; node 1 reports 0x402"
        in done.stdout
    )


def test_scan_of_an_empty_bus_says_what_to_check(hdbridge):
    done = hdbridge(
        "scan", "--interface", "virtual", "--channel", "nobody", "--listen", 0, "--timeout-ms", 1, status=4
    )
    assert "no node answers; check power, wiring" in done.stderr


def test_scan_of_a_bus_that_does_not_open(hdbridge):
    done = hdbridge("scan", "--interface", "socketcan", "--channel", "absent0", status=3)
    assert "socketcan:absent0" in done.stderr
