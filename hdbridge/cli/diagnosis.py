"""Commands that report the deficiencies of a model: `diagnose`, `improve`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from typer import Argument, Option

from hdbridge.cli import options as opt
from hdbridge.cli.calibration import PlanOptions, print_next
from hdbridge.cli.options import need_extra, taking
from hdbridge.cli.printing import note, print_blocks, print_table, say, write_json, write_page, write_result
from hdbridge.cli.recordings import Part, is_flight, remarks
from hdbridge.cli.session import Session, model_file
from hdbridge.errors import InputError, command
from hdbridge.files.outputs import Kind

if TYPE_CHECKING:
    from hdbridge.analysis.findings import Diagnosis
    from hdbridge.analysis.probability import Prior
    from hdbridge.commissioning.improvement import Improvement
    from hdbridge.records.recording import Recording


@taking(Part, opt.CsvFormat)
def diagnose(
    part: Part,
    csv: opt.CsvFormat,
    records: Annotated[
        list[Path] | None,
        Argument(
            metavar="RECORD...",
            help="CSV files, recording folders, or flight recordings (MCAP files or their folder), in their "
            "order.",
        ),
    ] = None,
    model: Annotated[
        str | None,
        Option(
            "--model",
            metavar="MODEL.yaml|PROFILE",
            help="Model to test, or its profile. Flight recordings: else the model used last.",
        ),
    ] = None,
    json_file: opt.Json = None,
    html_file: opt.Html = None,
    extend: Annotated[
        Path | None,
        Option("--extend", metavar="NEW_MODEL.yaml", help="Write the extended model."),
        Kind.MODEL,
    ] = None,
    independent_zeros: opt.IndependentZeros = False,
    prior: Annotated[
        Path | None,
        Option(
            "--prior",
            metavar="FLEET.parquet",
            help="fleet.parquet of hdbridge fleet run: prevalence of each cause.",
        ),
    ] = None,
    group: Annotated[
        list[str] | None,
        Option(
            "--group",
            metavar="NAME=VALUE",
            help="Group of this joint in the prior: gear=..., batch=..., cell=..., lubricant=...",
        ),
    ] = None,
    plan: Annotated[
        str | None,
        Option(
            "--plan",
            metavar="PLAN.yaml",
            help="Without records: causes that this plan could detect, from which size, and separate.",
        ),
    ] = None,
) -> None:
    """Compare records with a model; name the causes that it lacks, and those that are not separable."""
    from hdbridge.analysis.diagnosis import diagnose
    from hdbridge.analysis.identifiability import plan_report
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.motion.procedures.plan import Plan
    from hdbridge.records.recording import Recording
    from hdbridge.report.diagnosis import diagnosis_page, figures, shares_table

    flights = [each for each in records or () if is_flight(each)]
    chosen = {"--axis": part.axis, "--from": part.begin, "--to": part.end}
    if not flights and (name := next((name for name, text in chosen.items() if text), "")):
        raise InputError(f"{name} is for flight recordings; expected an MCAP file or a folder of them")
    flown, used = part.read(flights) if flights else (None, None)
    if model is None and used is not None and used.text:
        path = flights[0] / f"model {used.version}"
        known = TransmissionModel.from_text(used.text, path)
    elif model is None:
        first = command("fit", *(records or [Path("RECORD")]), "--ratio", "N", "--out", "model.yaml")
        raise InputError(
            "--model is missing; pass the profile of a calibrated axis (--model PROFILE), or fit a model "
            f"first: {first}, then pass --model model.yaml"
        )
    else:
        path = model_file(model)
        known = TransmissionModel.load(path)
    if plan is not None:
        if records:
            raise InputError("--plan needs no records; leave them out")
        report = plan_report(Plan.load(plan), known)
        write_json(json_file, report)
        _print_plan(report)
        return
    if not records:
        raise InputError("no record; name CSV files or recording folders, or a plan with --plan")
    recordings = csv.load([each for each in records if each not in flights])
    if flown is not None:
        recordings[flights[0]] = flown
        for each in remarks(flown):
            note(each)
    result = diagnose(
        recordings,
        known,
        independent_zeros=independent_zeros,
        prior=_prior(prior, group or []),
        progress=lambda words: note(f"{words} ..."),
    )
    recording = Recording.joined(list(recordings.values()))
    lists = {**{f"--{name}": texts for name, texts in vars(csv).items()}, "--group": group}
    said = [word for name, texts in lists.items() for text in texts or () for word in (name, text)]
    single = {"--model": model, **chosen, "--prior": prior}
    said += [word for name, text in single.items() if text for word in (name, str(text))]
    document = result.as_dict()
    # Files are written first, because the reader of the tables may close the pipe (`| head`).
    write_json(json_file, document)
    if html_file is not None:
        page = diagnosis_page(
            result,
            title=_title(recording, records),
            provenance=_provenance(recording, records, path),
            command=command("diagnose", *records, *said),
        )
        write_page(html_file, page)
    if extend is not None:
        write_result(extend, result.model.dump())
    print_diagnosis(result)
    print_blocks(figures(result).blocks, "Model and measurement")
    shares = {name: tuple(each.values()) for name, each in document["seen_over"].items()}
    print_blocks([shares_table(shares)], "Fraction of the difference explained by means over a coordinate")


def _prior(path: Path | None, groups: Sequence[str]) -> Prior | None:
    """Reads the prior for a joint of these groups; None without a file."""
    if path is None:
        if groups:
            raise InputError("--group needs --prior with the fleet of these groups")
        return None
    need_extra("a prior needs", ("pyarrow",), "fleet")
    from hdbridge.fleet.prior import GROUPS, read_prior

    of = {}
    for each in groups:
        name, equals, value = each.partition("=")
        if name not in GROUPS or not equals:
            raise InputError(
                f"--group: found '{each}'; expected NAME=VALUE with NAME one of {', '.join(GROUPS)}"
            )
        of[name] = value
    return read_prior(path, of)


def print_diagnosis(result: Diagnosis) -> None:
    """Prints verdict, findings, next experiments, and causes that were not reported."""
    from hdbridge.report.diagnosis import finding_blocks, found

    say(result.verdict())
    if result.findings:
        print_blocks(found(result).blocks)
    for number, each in enumerate(result.findings, 1):
        say(f"{number}. {each.cause.replace('_', ' ')}", style="bold")
        print_blocks(finding_blocks(each))
    for remark in (*result.remarks, *(f"not named: {each}" for each in result.considered)):
        note(remark)


def _title(recording: Recording, records: Sequence[Path]) -> str:
    if recording.axis:
        return f"Diagnosis of axis '{recording.axis}'"
    names = [each.name for each in records]
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"Diagnosis of {', '.join(names[:3])}{more}"


def _provenance(recording: Recording, records: Sequence[Path], model: Path) -> list[tuple[str, str]]:
    import numpy as np

    known = (("axis", recording.axis), ("recorded", recording.date))
    rows = [*(("record", str(each)) for each in records), ("model", str(model))]
    rows += [(name, value) for name, value in known if value]
    return [*rows, ("samples", f"{len(recording.record):,} in {np.ptp(recording.record.time_s):,.0f} s")]


def _print_plan(report: dict[str, Any]) -> None:
    say(report["record"]["sentence"].replace("record", "plan", 1))
    rows = []
    for name, each in report["identifiability"].items():
        limit = each["detection_limit_arcsec"]
        words = (
            f"{limit:.2g} arcsec" if each["detectable"] else f"no: {each.get('reason') or 'limit too high'}"
        )
        rows.append((name, words, ", ".join(each["aliases"])))
    print_table(("cause", "detected from", "not separable from"), rows)
    for each in report["notes"]:
        note(each)


LEFT_OF_FLOOR = 1.5
"""Ratio of the stepping test's three sigma to the best possible, above which a further cause is suspected."""


@taking(Session, PlanOptions, opt.CsvFormat)
def improve(
    session: Session,
    measured: PlanOptions,
    csv: opt.CsvFormat,
    given: Annotated[
        list[Path] | None,
        Option(
            "--from",
            metavar="RECORDING",
            help="Diagnose this and measure nothing; may be repeated, in order of time.",
        ),
    ] = None,
    independent_zeros: opt.IndependentZeros = False,
    auto: Annotated[
        bool, Option("--auto", help="Run further experiments if causes cannot be separated.")
    ] = False,
    rounds: Annotated[
        int, Option("--rounds", min=1, max=20, help="With --auto: maximum number of experiments.")
    ] = 3,
    json_file: opt.Json = None,
    html_file: opt.Html = None,
) -> None:
    """Diagnose the active model, extend it, step with both, and keep the better one as pending.

    The axis moves within the limits of its axis file. Ctrl-C stops it and keeps what was measured.
    """
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.axis.model.store import MODELS
    from hdbridge.commissioning.improvement import Source, improve
    from hdbridge.commissioning.improvement.trial import trial_s

    axis, active = session.axis, TransmissionModel.load(session.files.model)
    if given and measured.resume is not None:
        raise InputError("--from and --resume exclude each other: leave one of them out")
    recordings = csv.load(given or ())  # refused before anything is connected
    MODELS.check_pending(session.files.folder)
    work = measured.of(session)
    test_min = trial_s(work.plan, axis, active) / 60
    trial = f"{test_min:.1f} min to step with both models, if something is found"
    if recordings:
        note(f"no measurement first; {trial}")
    else:
        work.announce(trial)
    with work.booted() as (drive, callbacks):
        journal = None if recordings else work.begun(drive)
        source = Source(work.plan, work.folder, journal, recordings, independent_zeros)
        rounds = rounds if auto else 0
        result = improve(drive, source, session.files.folder, active, work.date, callbacks, rounds=rounds)
    _conclude(result, work.folder, session, json_file, html_file)


def _conclude(
    result: Improvement, folder: Path, session: Session, json_file: Path | None, html_file: Path | None
) -> None:
    """Writes and prints the result and the next steps."""
    from hdbridge.report.stepping import trial_sections

    page = html_file or (folder / "report.html" if folder.is_dir() else None)
    write_json(json_file, result.as_dict())
    if page is not None:
        _write_improvement_page(page, result)
    print_diagnosis(result.diagnosis)
    for line in result.extension.left:
        say(line)
    for line in result.fault_notes:
        say(f"note: {line}")
    if result.further is not None:
        further = result.further
        say(
            f"the axis could separate {', '.join(further.separates)} on its own (--auto), in "
            f"{further.duration_s / 60:.0f} min: {further.plan.about}"
        )
    if result.trial is not None:
        for section in trial_sections(result.trial):
            print_blocks(section.blocks, section.title)
        if result.trial.of_floor > LEFT_OF_FLOOR:
            say(
                f"stepping is still {result.trial.of_floor:.1f} times the floor: an error remains that "
                "these data do not show; --auto, or a plan with two load turns, shows more"
            )
    say(result.offer.reason, style=None if result.offer.made else "bold")
    say(f"\nrecordings: {', '.join(result.recordings)}")
    if page is not None:
        say(f"report: {page}")
    print_next(result.offer, session)


def _write_improvement_page(path: Path, result: Improvement) -> None:
    """Writes the diagnosis with the stepping test as a self-contained page."""
    from hdbridge.report.diagnosis import diagnosis_page

    provenance = {
        "axis": result.axis,
        "recordings": ", ".join(result.recordings),
        "recorded": result.date or "not known",
        "plan": result.plan,
        **{f"round {number}": each.about for number, each in enumerate(result.rounds, 1)},
        **({"tolerated faults": "; ".join(result.fault_notes)} if result.fault_notes else {}),
    }
    page = diagnosis_page(
        result.diagnosis,
        title=f"Improvement of axis '{result.axis}'",
        provenance=provenance,
        trial=result.trial,
        offer=result.offer,
    )
    write_page(path, page)


COMMANDS: Final = {"diagnose": diagnose, "improve": improve}
