"""``hdbridge gateway`` and the key ``gateway`` of a machine file."""

import shutil
from pathlib import Path

import can
import canopen
import pytest
from support.command import run_here

from hdbridge.canframe import DataFrame

PROFILE = Path(__file__).parents[2] / "profiles" / "article"
MACHINE = """
schema: hdbridge.machine/1
name: between
axes:
  - profile: article
gateway:
  bus: {interface: udp_multicast, channel: 239.74.163.11, options: {port: 43210}}
  nodes: {article: 5}
"""


def machine(tmp_path, text=MACHINE):
    path = tmp_path / "machine.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_eds_has_the_scale_and_the_limits_of_the_load(tmp_path):
    done = run_here(tmp_path, "gateway", "eds", machine(tmp_path))
    (tmp_path / "bridge.eds").write_text(done.stdout, encoding="utf-8")
    od = canopen.import_od(str(tmp_path / "bridge.eds"), 5)
    per_turn = od[0x608F][1].default
    assert per_turn == 12_960_000
    assert od[0x6092][1].default * od[0x6091][2].default == per_turn * od[0x6091][1].default
    assert [od[0x607D][sub].default for sub in (1, 2)] == [-400 * 36_000, 400 * 36_000]
    assert od[0x607F].default == 20 * 36_000
    assert od[0x6502].default & 0xA1 == 0xA1
    assert od[0x1400][1].default == 0x205
    assert od[0x1402][1].default == 0x80000405
    assert len(od[0x2200]) == 7


def test_the_ideal_drive_answers_on_the_bus_of_the_gateway(tmp_path):
    path = machine(tmp_path)
    with can.Bus(interface="udp_multicast", channel="239.74.163.11", port=43210) as bus:
        done = run_here(tmp_path, "simulate", path, "--gateway", "--duration", "0.5")
        assert "ideal drive: node 5" in done.stderr
        seen = []
        while (message := bus.recv(0.1)) is not None:
            seen.append((message.arbitration_id, bytes(message.data)))
        assert (0x705, b"\0") in seen
        bus.send(DataFrame(0x000, b"\x01\x05"))


def test_a_second_node_of_the_same_id_is_refused(tmp_path):
    path = machine(tmp_path)

    with can.Bus(interface="udp_multicast", channel="239.74.163.11", port=43210) as bus:

        def answer(message):
            if message.arbitration_id == 0x605:
                bus.send(DataFrame(0x585, b"\x43\x00\x10\x00\x92\x01\x02\x00"))

        notifier = can.Notifier(bus, [answer])
        done = run_here(tmp_path, "simulate", path, "--gateway", "--duration", "0.1", status=3)
        notifier.stop()
    assert "a node 5 is on this bus already (585h); stop it first" in done.stderr


@pytest.mark.parametrize(
    ("replaced", "by", "words"),
    [
        (
            "{article: 5}",
            "{arm: 5}",
            "machine.yaml:8:16: gateway.nodes.arm: no axis 'arm'; expected one of: article",
        ),
        ("{article: 5}", "{article: 0}", "gateway.nodes.article: found 0; expected an integer from 1 to 127"),
        (
            "{interface: udp_multicast, channel: 239.74.163.11, options: {port: 43210}}",
            "{interface: virtual, channel: hdbridge}",
            "virtual:hdbridge is the bus of the drives; expected another one",
        ),
        ("{article: 5}", "{}", "machine.yaml:8:10: gateway.nodes: found an empty mapping; expected a map"),
        (
            "udp_multicast, channel: 239.74.163.11",
            "socketcann, channel: can1",
            "machine.yaml:7:20: gateway.bus.interface: python-can has no interface 'socketcann'",
        ),
        (
            "239.74.163.11",
            "1.2.3.4",
            "machine.yaml:7:44: gateway.bus.channel: found '1.2.3.4'; expected a multicast address",
        ),
    ],
)
def test_an_impossible_gateway_is_refused_by_check(tmp_path, replaced, by, words):
    done = run_here(tmp_path, "check", machine(tmp_path, MACHINE.replace(replaced, by)), status=2)
    assert words in done.stderr


def test_positions_have_to_fit_into_32_bits(tmp_path):
    shutil.copytree(PROFILE, tmp_path / "own")
    text = (tmp_path / "own" / "axis.yaml").read_text(encoding="utf-8")
    text = text.replace("position_max_deg: 400", "position_max_deg: 3600")
    (tmp_path / "own" / "axis.yaml").write_text(text, encoding="utf-8")
    text = MACHINE.replace("profile: article", "profile: own")
    text = text.replace("nodes:", "counts_per_turn: 268435456\n  nodes:")
    done = run_here(tmp_path, "check", machine(tmp_path, text), status=2)
    assert "the limits of 'article' do not fit into 32 bits; expected at most 214748363" in done.stderr
    done = run_here(tmp_path, "check", machine(tmp_path, text.replace("268435456", "214748363")))


def test_a_machine_without_a_gateway_says_which_key_is_missing(tmp_path):
    done = run_here(tmp_path, "gateway", "eds", "article", status=2)
    assert "expected a machine file with a key 'gateway'" in done.stderr
    done = run_here(tmp_path, "gateway", "eds", machine(tmp_path), "--axis", "arm", status=2)
    assert "--axis arm: not in the gateway; expected one of: article" in done.stderr
