"""Report page of a diagnosis: verdict, advice, each finding with its chart, and all observations."""

from collections.abc import Iterator, Mapping, Sequence

from hdbridge import __version__
from hdbridge.analysis.findings import UNEXPLAINED, Diagnosis, Finding
from hdbridge.analysis.views import ResidualViews
from hdbridge.axis.effects import CATALOGUE
from hdbridge.commissioning.calibration.pipeline import Offer
from hdbridge.commissioning.improvement.trial import Trial
from hdbridge.report.page import (
    SIGMA,
    Block,
    Command,
    Facts,
    Grid,
    Heading,
    Page,
    Section,
    Status,
    Table,
    sentence,
)
from hdbridge.report.residuals import beside_charts, partial_residual, partial_residual_chart, residual_charts
from hdbridge.report.stepping import of_offer, trial_sections
from hdbridge.units import with_interval, without_unit


def diagnosis_page(
    diagnosis: Diagnosis,
    *,
    title: str,
    provenance: Mapping[str, str] | Sequence[tuple[str, str]] = (),
    trial: Trial | None = None,
    offer: Offer | None = None,
    command: str = "hdbridge diagnose RECORD... --model MODEL.yaml",
) -> Page:
    """Returns the page of a diagnosis.

    ``provenance`` contains names and values that describe the origin of records and model. ``trial`` has
    the tests with the old and the extended model, if there were any; they precede the findings.
    ``offer`` is the outcome for the extended model, if it was tested for commit. ``command`` is the command
    line of the diagnosis.
    """
    seen = diagnosis.views()
    verdict = diagnosis.verdict()
    given = provenance.items() if isinstance(provenance, Mapping) else provenance
    sections = [_to_do(diagnosis)]
    if trial is not None:
        sections += trial_sections(trial)
    if diagnosis.findings:
        sections.append(found(diagnosis))
    sections += [_finding(number, each, diagnosis) for number, each in enumerate(diagnosis.findings, 1)]
    sections += [
        figures(diagnosis),
        Section(
            "Model and measurement",
            "The transmission error on the same trajectory: load encoder minus motor angle divided by the "
            "ratio, without the zero offset.",
            [Grid([*beside_charts(diagnosis.traces)], columns=1)],
        ),
        _over(seen),
        _could(diagnosis),
    ]
    if facts := [*_remarks(diagnosis), *given]:
        sections.append(Section("Provenance", "", [Facts(facts)]))
    if offer is not None:
        status, commands = of_offer(offer)
    else:
        status = Status.FOUND if diagnosis.findings else Status.NOTHING_FOUND
        commands = _commands(diagnosis, command)
    return Page(
        title=title,
        verdict=f"{sentence(offer.reason)} {verdict}" if offer is not None else verdict,
        status=status,
        commands=commands,
        sections=sections,
        footer=f"hdbridge {__version__}. Errors are arcseconds at the load; rms is the root mean square, "
        f"{SIGMA} three standard deviations; intervals are of 95 %.",
    )


def _commands(diagnosis: Diagnosis, command: str) -> tuple[Command, ...]:
    if all(each.cause == UNEXPLAINED for each in diagnosis.findings):
        return ()
    return (
        Command(f"{command} --extend NEW_MODEL.yaml", "writes the extended model"),
        Command("hdbridge improve PROFILE", "tries it on the axis, and keeps it as pending if it is better"),
    )


def _to_do(diagnosis: Diagnosis) -> Section:
    if not diagnosis.findings:
        return Section(
            "What to do",
            "Nothing. 'What this record could show' lists the causes that it would have shown, and those "
            "that it would not.",
        )
    rows: list[tuple[str, str]] = []
    for number, each in enumerate(diagnosis.findings, 1):
        remedy = "do not compensate for an unexplained error; investigate it first, and keep the record"
        if each.cause in CATALOGUE:
            remedy = CATALOGUE[each.cause].about.remedy
        rows.append((f"{number}. {_name(each.cause)}", sentence(remedy)))
    return Section("What to do", "", [Facts(rows)])


def found(diagnosis: Diagnosis) -> Section:
    """Returns the table of findings with their probability, size and gain."""
    rows: list[list[str | float]] = []
    for number, each in enumerate(diagnosis.findings, 1):
        rows.append(
            [
                f"{number}. {_name(each.cause)}",
                f"{each.probability:.2f}",
                each.peak_arcsec,
                each.gain.before_arcsec if each.gain else "not made",
                each.gain.after_arcsec if each.gain else "",
                f"{100.0 * each.gain.recovered:.0f} %" if each.gain else "",
            ]
        )
    header: list[str | Heading] = [
        "cause",
        Heading("probability", ""),
        Heading("size"),
        Heading("held out"),
        Heading("with it"),
        Heading("gain", ""),
    ]
    return Section(
        "What was found",
        "Size: half the span of its contribution to this record. Held out: residual (rms) of the given model "
        "with the other findings, and of the written model, on stretches of time left out of the fit. "
        "Gain: the fraction of the mean square removed.",
        [Table(header, rows)],
    )


def _finding(number: int, finding: Finding, diagnosis: Diagnosis) -> Section:
    title = _title(finding.cause)
    drawn = partial_residual(finding, diagnosis)
    blocks = [partial_residual_chart(drawn), *finding_blocks(finding), Facts([*_about(finding)])]
    if drawn.strength is not None:
        text = (
            f"Growth of the {drawn.strength.of} of the model, by least squares in each bin; "
            "bars are one standard deviation."
        )
    elif drawn.own_arcsec is None:
        text = "The residual that no cause explains. Dots are means, bars the spread of the readings in them."
    else:
        text = (
            "All other findings are in the model, so this is the finding alone, with the noise. Dots are "
            "means, bars the spread of their readings, lines the finding's contribution."
        )
    return Section(f"{number}. {sentence(title).rstrip('.')}", text, blocks)


def finding_blocks(finding: Finding) -> Iterator[Block]:
    """Yields the parameters of a finding, its alternatives and coordinate, and what is left to do."""
    if finding.parameters:
        yield _parameters(finding)
    facts = (
        ("depends on", finding.lives_in),
        ("it may also be", _listed([*map(_title, finding.aliases)], "or")),
        ("not offered", finding.refusal()),
        ("measure next", finding.experiment),
        ("prior", finding.prior),
    )
    yield Facts([(name, text) for name, text in facts if text])


def _parameters(finding: Finding) -> Table:
    rows: list[list[str | float]] = []
    for name, each in finding.parameters.items():
        words = without_unit(name).replace("_", " ")
        unit = "" if each.unit == "1" else each.unit
        if each.high > each.low:
            half_width = 0.5 * (each.high - each.low)
            values = (with_interval(one, half_width)[0] for one in (each.value, each.low, each.high))
            rows.append([words, *values, unit])
        else:
            rows.append([words, f"{each.value:.7g}", "by search", "", unit])
    return Table(["parameter", "value", "95 % from", "to", "unit"], rows)


def _about(finding: Finding) -> Iterator[tuple[str, str]]:
    about = CATALOGUE[finding.cause].about if finding.cause in CATALOGUE else None
    yield "probability", _sure(finding)
    if not finding.aliases:
        other = "no other cause of the catalogue: all are separable with these data"
        yield "aliases", other if about else "no cause of the catalogue fits"
    if about:
        yield "symptom", sentence(about.signature)
        yield "consequence", sentence(about.consequence)
        able = CATALOGUE[finding.cause].compensable
        yield "compensation", f"{'possible' if able.possible else 'no'}: {able.why.removeprefix('no, ')}"
        yield "equation", about.equation
        yield "name in files", finding.cause
    if finding.note:
        yield "note", sentence(finding.note)


def _sure(finding: Finding) -> str:
    if finding.cause == UNEXPLAINED:
        return f"{finding.probability:.2f} that there is something which the catalogue does not have"
    others = ", or one that it cannot be distinguished from," if finding.aliases else ""
    return f"{finding.probability:.2f} that this cause{others} is there"


def figures(diagnosis: Diagnosis) -> Section:
    """Returns the differences between model and measurement: overall, and by kind of motion."""
    stages: list[list[str | float]] = [
        [words, each.rms_arcsec, each.three_sigma_arcsec]
        for words, each in (
            ("the model as given", diagnosis.baseline),
            ("its own parameters refitted", diagnosis.refitted),
            ("extended", diagnosis.extended),
        )
    ]
    stages.append(["noise of a reading", diagnosis.noise_floor_arcsec, 3.0 * diagnosis.noise_floor_arcsec])
    kinds: list[list[str | float]] = [
        [name, one.rms_arcsec, one.three_sigma_arcsec, other.rms_arcsec, other.three_sigma_arcsec]
        for name, (one, other) in diagnosis.by_kind.items()
    ]
    return Section(
        "Differences between model and measurement",
        "Overall, by kind of motion and by direction.",
        [
            Table(["overall", Heading("rms"), Heading(SIGMA)], stages),
            Table(["motion", *map(Heading, ("as given, rms", SIGMA, "extended, rms", SIGMA))], kinds),
        ],
    )


def _over(seen: ResidualViews) -> Section:
    return Section(
        "Residuals over all coordinates",
        "Measurement minus model; lines are means over bins, grey dots readings minus the model as given, "
        "all charts to one scale, the most informative first.\n\nThe table lists the fraction of the mean "
        "square that such means predict on other stretches of time.",
        [
            Grid([*residual_charts(seen)]),
            shares_table(seen.shares()),
        ],
    )


def shares_table(shares: Mapping[str, tuple[float, float]]) -> Table:
    """Returns the fraction of the mean square that each coordinate explains (`ResidualViews.shares`)."""
    rows = [
        [name, f"{100.0 * before:.1f} %", f"{100.0 * after:.1f} %"]
        for name, (before, after) in sorted(shares.items(), key=lambda each: -each[1][0])
    ]
    heads = (Heading(each, "of the squares") for each in ("as given", "extended"))
    return Table(["over the", *heads], rows)


def _could(diagnosis: Diagnosis) -> Section:
    rows: list[list[str | float]] = []
    ranked = sorted(
        diagnosis.identifiability.items(),
        key=lambda each: (not each[1].detectable, each[1].detection_limit_arcsec or 0.0),
    )
    for name, each in ranked:
        limit = each.detection_limit_arcsec
        rows.append(
            [
                _title(name),
                f"{limit:.2f}" if limit is not None and each.detectable else "not seen",
                each.reason or ", ".join(map(_name, each.aliases)),
            ]
        )
    return Section(
        "What this record could show",
        "Detection limit and aliases of each cause, or the reason why it is not detectable.",
        [Table(["cause", Heading("from"), "not separable from, or why not"], rows)],
    )


def _remarks(diagnosis: Diagnosis) -> Iterator[tuple[str, str]]:
    yield from (("about the record", each) for each in diagnosis.remarks)
    yield from (("considered, not named", each.replace("_", " ")) for each in diagnosis.considered)
    yield "samples evaluated", f"{len(diagnosis.traces.time_s):,}"


def _name(cause: str) -> str:
    return cause.replace("_", " ")


def _title(cause: str) -> str:
    """Returns the title of a cause, preceded by its name unless the title contains it."""
    name = _name(cause)
    if cause not in CATALOGUE:
        return name
    title = CATALOGUE[cause].about.title
    return title if name in title else f"{name} ({title})"


def _listed(words: Sequence[str], last: str = "and") -> str:
    if len(words) < 2 or any("," in each for each in words):
        return "; ".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"
