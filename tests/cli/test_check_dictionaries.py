"""`hdbridge check` and `step` with the dictionaries of other drives."""

# ruff: noqa: E501  (tables)

import json
import re

import pytest
from support.eds import OWN, fixed, mapped, profile_with, stating, without

SOURCE = "source: {index: 0x60E4, subindex: 1, type: int32, via: tpdo}"


@pytest.mark.parametrize(
    ("eds", "lines"),
    [
        (without(OWN, 0x605D), [r"left to the drive  605Dh:00, which drive\.eds lacks: how a halt brakes \(.*axis\.yaml:\d+:3: drive\.halt_option\)"]),
        (without(OWN, 0x6062), [r"left to the drive  6062h:00, which drive\.eds lacks: the last target sent is used instead$"]),
        (without(OWN, 0x6066), [r"left to the drive  6066h:00, .*: time after which a following error counts"]),
        (without(OWN, 0x6077), [r"left to the drive  6077h:00, .*: torque is neither recorded nor checked"]),
        (without(OWN, 0x1017), [r"left to the drive  1017h:00, .*: only missing TPDOs show that the drive is gone"]),
        (without(without(OWN, 0x1016), (0x1400, 5)), [r"1016h:01, .*: nothing stops the axis when its master dies", r"1400h:05, .*: nothing stops the axis"]),
        (without(OWN, 0x1016), [r"1016h:01, .*: only its event timer \(1400h:05\) stops the axis"]),
        (stating(OWN, "6007", HighLimit=1), [r"6007h:00, for which drive\.eds permits 0 to 1, not 3: what it does when its master is lost"]),
        (fixed(OWN, "605A", 6), [r"605Ah:00, which is read-only in drive\.eds \(6\): what a quick stop does"]),
        (stating(OWN, "605A", HighLimit="eight"), [r"not read  .*drive\.eds:\d+: \[605A\] HighLimit: 'eight' is not a number"]),
        (mapped(OWN, 0x1400, 0x60400010, 0x607A0020, 0x60FE0110) + "[60FE]\nSubNumber=1\n[60FEsub1]\nDataType=6\nAccessType=rww\nPDOMapping=1\nDefaultValue=3\n",
         [r"fixed mapping  201h: 6040h:00 uint16, 607Ah:00 int32, 60FEh:01 uint16", r"sent along  60FEh:01 = 3 in RPDO1"]),
    ],
)  # fmt: skip
def test_values_left_to_the_drive_are_listed(hdbridge, tmp_path, eds, lines):
    profile_with(tmp_path / "axis", eds)
    done = hdbridge("check", "axis", "--json", "found.json")
    for line in lines:
        assert re.search(line, done.stdout, flags=re.MULTILINE), done.stdout
    found = json.loads((tmp_path / "found.json").read_text())
    listed = [
        each
        for key in ("left to the drive", "fixed mapping", "sent along", "not read")
        for each in found[key]
    ]
    assert len(listed) == len(lines)
    done = hdbridge("step", "axis", "--simulate", "--scheme", "none", "--count", 2)


@pytest.mark.parametrize(
    ("eds", "edit", "complaint"),
    [
        (without(OWN, 0x60E4), None, r"axis\.yaml:\d+:12: load_encoder\.source\.index: drive\.eds has no object 60E4h:01"),
        (stating(OWN, "60E4sub1", PDOMapping=0), None, r"load_encoder\.source\.index: drive\.eds says that 60E4h:01 cannot be mapped"),
        (OWN, (SOURCE, SOURCE.replace("int32", "int16")), r"axis\.yaml:\d+:\d+: load_encoder\.source\.type: drive\.eds says that 60E4h:01 is int32"),
        (stating(OWN, "6502", DefaultValue="0x43"), None, r"drive\.mode: csp is not among the modes of drive\.eds \(6502h is 00000043h\); 'mode: ip'"),
        (fixed(OWN, "60C2sub2", -3), ("cycle_ms: 4 ", "cycle_ms: 0.5 "), r"axis\.yaml:\d+:3: drive\.cycle_ms: drive\.eds does not permit 0\.5 ms"),
        (stating(OWN, "6072", HighLimit=900), None, r"axis\.yaml:\d+:3: limits\.torque_percent: gives 1000 for object 6072h:00; drive\.eds permits 0 to 900"),
        (without(OWN, 0x6061), None, r"axis\.yaml:\d+:3: drive\.eds: drive\.eds lacks 6061h:00 modes of operation display"),
        (without(OWN, 0x1600, 0x1601, 0x1602, 0x1603), None, r"the RPDOs of drive\.eds cannot carry 6040h:00 uint16, 607Ah:00 int32: it has none;"),
        (OWN.replace("[6064]\n", "[6064]\nDataType=zz\n"), None, r"drive\.eds:\d+: \[6064\] DataType: found 'zz'; expected a number"),
    ],
)  # fmt: skip
def test_impossible_settings_are_refused_by_check(hdbridge, tmp_path, eds, edit, complaint):
    profile_with(tmp_path / "axis", eds, *([edit] if edit else []))
    for command in (("check", "axis"), ("step", "axis", "--simulate", "--scheme", "none", "--count", 2)):
        done = hdbridge(*command, status=2)
        assert len(done.stderr.strip().splitlines()) == 1
        assert re.search(complaint, done.stderr), done.stderr
