"""``hdbridge conform``: checks of CiA 301 and CiA 402 on any node."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from typer import Argument, Option

from hdbridge.cli import options as opt
from hdbridge.cli.options import taking
from hdbridge.cli.printing import note, print_table, progress_bar, write_json
from hdbridge.cli.session import BusOptions, deferred_interrupt
from hdbridge.errors import DriveError, InputError

if TYPE_CHECKING:
    from hdbridge.conformance import Check, Result


@taking(BusOptions)
def conform(
    reach: BusOptions,
    profile: Annotated[
        str | None,
        Argument(
            metavar="PROFILE",
            help="Axis whose drive is checked, or machine whose gateway is checked. Without it: --channel, "
            "--node and --eds.",
        ),
    ] = None,
    bitrate_bps: opt.Bitrate = None,
    node_id: Annotated[
        int | None, Option("--node", min=1, max=127, help="Node id; else the axis file's.")
    ] = None,
    eds: Annotated[
        Path | None,
        Option(
            "--eds", metavar="FILE", help="EDS of the node, which is compared with it; else the axis file's."
        ),
    ] = None,
    axis: opt.GatewayAxis = None,
    motion: Annotated[
        bool, Option("--motion", help="Also switch power on and move the axis; else power stays off.")
    ] = False,
    store: Annotated[
        bool,
        Option(
            "--store", help="Also save parameters (1010h) and restore defaults (1011h): stored ones are lost."
        ),
    ] = False,
    travel: Annotated[
        int | None,
        Option(
            "--travel",
            min=1,
            metavar="UNITS",
            help="Length of a test move; the axis stays within ten of them. Default: 0.02 turns (608Fh).",
        ),
    ] = None,
    only: Annotated[
        list[str] | None, Option("--only", metavar="ID", help="Only checks whose id begins with this.")
    ] = None,
    timeout_ms: Annotated[
        float, Option("--timeout-ms", min=1.0, max=60_000.0, help="Time-out for an SDO answer.")
    ] = 500.0,
    list_checks: Annotated[bool, Option("--list", help="List the checks and exit.")] = False,
    json_file: opt.Json = None,
) -> None:
    """Check a node against CiA 301 and CiA 402: NMT, SDO, PDO, SYNC, EMCY, its EDS, the drive profile.

    hdbridge conform --channel can0 --node 5 --eds drive.eds

    Listens first, and sends nothing if another master is heard. Resets the node several times and undoes each
    change; in the end the node is PRE-OPERATIONAL without power. With --motion the axis must be free to move.

    Exit status 4 if a check failed, or the node does not answer or is under power.
    """  # fmt: skip
    from hdbridge.axis import BusConfig
    from hdbridge.cli.machine import eds_of, gateway_axis
    from hdbridge.conformance import NodeTester, checks, run
    from hdbridge.conformance.tester import StoppedError, Timing
    from hdbridge.daemon.machine import machine_file
    from hdbridge.drive.link import Link
    from hdbridge.drive.masterdetection import MasterDetector, listening_s
    from hdbridge.files.edsfile import read_eds

    wanted = _chosen(checks(moves=motion, stores=store), checks(moves=True, stores=True), only)
    if list_checks:
        write_json(
            json_file, {"schema": "hdbridge.conform/1", "checks": [_described(each) for each in wanted]}
        )
        _print_list(wanted)
        return
    od = None
    if profile is not None and machine_file(profile) is not None:
        config, settings, model = gateway_axis(profile, axis)
        opened, node_id = reach.bare(settings.bus), settings.nodes[config.name]
        od = eds_of(config, settings, model) if eds is None else None
    elif profile is not None:
        session = reach.of(profile)
        config, opened = session.axis, session.connected()
        node_id, eds = node_id or config.drive.node_id, eds or config.eds_path
    elif reach.simulate or reach.channel is None or node_id is None:
        raise InputError("conform needs a node: give a PROFILE, or --channel (can0) and --node")
    else:
        interface = reach.interface or "socketcan"
        named = BusConfig(interface=interface, channel=reach.channel, bitrate_bps=bitrate_bps)
        opened = reach.bare(named)
    assert node_id is not None
    od = od if eds is None else read_eds(eds, node_id).dictionary
    with deferred_interrupt() as interrupted, opened as (bus, clock), progress_bar() as bar:
        link = Link(bus, clock)
        task = bar.add_task(f"{len(wanted)} checks", total=len(wanted))
        if not reach.simulate and not reach.force:
            detector = MasterDetector((node_id,), sdo_servers=(node_id,))
            detector.listen(link, listening_s())
            detector.raise_if_heard(link.name, listening_s())
        tester = NodeTester(
            link,
            node_id,
            od=od,
            travel=travel,
            timing=Timing(answer_s=timeout_ms / 1000.0),
            stopped=interrupted,
        )
        results = run(tester, wanted, lambda _: bar.advance(task))
    write_json(json_file, _document(link.name, node_id, eds, results))
    _print(results)
    if len(results) < len(wanted):
        raise StoppedError(f"ended after {len(results)} of {len(wanted)} checks; the power is off")
    failed = [each.check.id for each in results if each.verdict.value == "fail"]
    if failed:
        raise DriveError(
            f"node {node_id} on {link.name}: {len(failed)} of {len(results)} checks failed: "
            f"{', '.join(failed[:5])}"
            f"{' and more' if len(failed) > 5 else ''}; expected none to fail"
        )


def _chosen(allowed: Sequence[Check], every: Sequence[Check], only: Sequence[str] | None) -> list[Check]:
    if not only:
        return [*allowed]
    for prefix in only:
        if not any(each.id.startswith(prefix) for each in every):
            raise InputError(
                f"--only {prefix}: no check has such an id; 'hdbridge conform --list' shows them"
            )
        if not any(each.id.startswith(prefix) for each in allowed):
            raise InputError(f"--only {prefix}: these checks need --motion or --store")
    return [each for each in allowed if each.id.startswith(tuple(only))]


def _described(check: Check) -> dict[str, Any]:
    return {
        "id": check.id,
        "text": check.text,
        "clause": check.clause,
        "motion": check.moves,
        "store": check.stores,
    }


def _document(name: str, node_id: int, eds: Path | None, results: Sequence[Result]) -> dict[str, Any]:
    return {
        "schema": "hdbridge.conform/1",
        "bus": name,
        "node_id": node_id,
        "eds": None if eds is None else str(eds),
        "summary": _count(results),
        "checks": [
            {
                **_described(each.check),
                "result": each.verdict.value,
                "found": each.found,
                "expected": each.expected,
                "duration_s": round(each.duration_s, 6),
            }
            for each in results
        ],
    }


def _count(results: Sequence[Result]) -> dict[str, int]:
    from hdbridge.conformance import Verdict

    return {each.value: sum(result.verdict is each for result in results) for each in Verdict}


def _print_list(checks: Sequence[Check]) -> None:
    rows = [
        (each.id, each.text, each.clause, "--motion" if each.moves else "--store" if each.stores else "")
        for each in checks
    ]
    print_table(("id", "check", "clause", "needs"), rows)


def _print(results: Sequence[Result]) -> None:
    from hdbridge.conformance import Verdict

    subjects: dict[str, list[Result]] = {}
    for each in results:
        subjects.setdefault(each.check.id.split(".", maxsplit=1)[0], []).append(each)
    counts = {subject: _count(own).values() for subject, own in {**subjects, "all": results}.items()}
    summary = [(subject, *map(str, own)) for subject, own in counts.items()]
    print_table(("subject", "pass", "fail", "not applicable"), [*summary[:-1], (), summary[-1]])
    failed = [
        (each.check.id, each.check.text, each.found, each.expected, each.check.clause)
        for each in results
        if each.verdict is Verdict.FAIL
    ]
    if failed:
        print_table(("failed", "check", "found", "expected", "clause"), failed)
    reasons = Counter(each.found for each in results if each.verdict is Verdict.NOT_APPLICABLE)
    for reason, count in reasons.items():
        note(f"not applicable, {count} check{'s' * (count > 1)}: {reason}")


COMMANDS: Final = {"conform": conform}
