"""`tools/dictionaries.py` makes the rows of docs/bring-up.md from what `hdbridge check` says."""

import subprocess
import sys
from pathlib import Path

from tests.support.eds import OWN, fixed, stating, without

TOOL = Path(__file__).parents[2] / "tools" / "dictionaries.py"


def test_a_drive_of_each_kind_and_a_file_that_is_no_dictionary(tmp_path):
    only_csp = stating(without(OWN, 0x1016, 0x60C1, 0x605D), "6502", DefaultValue="0x80")
    only_ip = stating(
        without(fixed(OWN, "605A", 6), 0x60E4, (0x1400, 5), 0x1016), "6502", DefaultValue="0x40"
    )
    folder = tmp_path / "owner" / "repository" / "eds"
    folder.mkdir(parents=True)
    (folder / "a.eds").write_text(only_csp)
    (folder / "b.DCF").write_text(only_ip.replace("ProductName=", "ProductName=B "))
    (folder / "none.eds").write_bytes(b"\x00\x01")
    done = subprocess.run([sys.executable, TOOL, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = {row.split("`")[1]: row for row in done.stdout.splitlines() if "owner/repository, eds" in row}
    assert (
        "| yes | no: ip is not among its modes (6502h is 00000080h) | 60E4h:01 | event timer | 605Dh |"
        in rows["a.eds"]
    )
    assert "| a node of its own | **nothing** | 605Ah (read-only) |" in rows["b.DCF"]
    assert "| no: csp is not among its modes (6502h is 00000040h) | yes |" in rows["b.DCF"]
    assert "cannot be read as an EDS" in rows["none.eds"]
    assert "| 605Dh | how a halt brakes | 1 |" in done.stdout
    assert "| of 2 |" in done.stdout


def test_a_folder_without_dictionaries_is_refused(tmp_path):
    done = subprocess.run([sys.executable, TOOL, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "has no EDS or DCF file" in done.stderr
