"""``hdbridge fleet``: diagnoses many joints and ranks them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final
from urllib.parse import unquote

from typer import Argument, Option

from hdbridge.cli import options as opt
from hdbridge.cli.options import need_extra, taking
from hdbridge.cli.printing import note, print_table, progress_bar, say, write_json, write_page
from hdbridge.cli.session import deferred_interrupt
from hdbridge.errors import InputError
from hdbridge.files.atomic import sole_writer
from hdbridge.files.expectation import nearest
from hdbridge.files.outputs import Kind

if TYPE_CHECKING:
    from hdbridge.fleet.dataset import Dataset
    from hdbridge.fleet.sources import Source, Stored
    from hdbridge.fleet.summary import Row, Summary

PAGE_NAME = "fleet.html"
PRIOR_NAME = "fleet.parquet"
_EXTRA = ("distributed", "pyarrow", "fsspec")

OutArgument = Annotated[Path, Argument(metavar="OUT", help="The --out folder of a run.")]
LimitOption = Annotated[
    float,
    Option(
        "--limit",
        metavar="ARCSEC",
        min=0.1,
        max=3600.0,
        help="Limit on the peak of a cause; the page predicts the hours until it is reached.",
    ),
]
PagesOption = Annotated[
    bool, Option("--pages", help="Also write the page of each listed joint, into OUT/pages.")
]


@dataclass(frozen=True)
class Fleet:
    """Recordings to diagnose, from the options of `run` or `watch`; InputError names a wrong option."""

    sources: Annotated[
        list[str] | None,
        Argument(metavar="SOURCE...", help="Folders, globs or URLs (s3://, sftp://, ...) of recordings."),
    ] = None
    out: Annotated[
        Path | None,
        Option("--out", metavar="FOLDER", help="Folder of the results; an earlier run in it is continued."),
    ] = None
    manifest: Annotated[
        Path | None,
        Option("--manifest", metavar="M.csv|M.parquet", help="Table of the recordings: docs/fleet.md."),
    ] = None
    model: Annotated[
        Path | None, Option("--model", metavar="MODEL.yaml", help="Model of joints without one of their own.")
    ] = None
    models: Annotated[
        Path | None, Option("--models", metavar="FOLDER", help="Folder with a model per joint, JOINT.yaml.")
    ] = None
    scheduler: Annotated[
        str | None, Option("--scheduler", metavar="ADDRESS", help="Running Dask scheduler: tcp://HOST:8786.")
    ] = None
    workers: Annotated[
        int | None,
        Option("--workers", min=1, max=1000, help="Processes on this computer; else one per core."),
    ] = None
    memory: Annotated[str, Option("--memory", metavar="SIZE", help="Memory limit of each process.")] = "2GB"
    limit_arcsec: LimitOption = 10.0
    pages: PagesOption = False
    timeout_s: Annotated[
        float,
        Option(
            "--timeout",
            metavar="SECONDS",
            min=0.1,
            max=3600.0,
            help="Time-out for a server of SOURCE, s.",
        ),
    ] = 20.0

    def __post_init__(self) -> None:
        from hdbridge.axis.model import TransmissionModel

        need_extra("a fleet needs", _EXTRA, "fleet")
        logging.getLogger("paramiko").addHandler(logging.NullHandler())  # else its thread prints a traceback
        if self.out is None:
            raise InputError("--out is missing; name a new folder, or one of an earlier run")
        if not self.sources and self.manifest is None:
            raise InputError(
                "no source; name folders, globs or URLs of recordings, or a manifest with --manifest"
            )
        if self.scheduler is not None and self.workers is not None:
            raise InputError(
                "--workers: a running cluster has its own workers; leave out --workers or --scheduler"
            )
        _check_memory(self.memory)
        if self.model is not None:
            TransmissionModel.load(self.model)
        if self.models is not None and not self.models.is_dir():
            raise InputError(
                f"--models: '{self.models}' is not a folder; expected one with JOINT.yaml for each joint"
            )

    @cached_property
    def dataset(self) -> Dataset:
        """Data set of the results."""
        from hdbridge.fleet.dataset import Dataset

        assert self.out is not None
        return Dataset(self.out)

    def find(self, stored: Stored, *, may_be_empty: bool = False) -> Sequence[Source]:
        """Returns the available recordings; raises `InputError` for an invalid source or manifest."""
        from hdbridge.fleet.sources import find_sources

        return find_sources(
            self.sources or [],
            self.manifest,
            stored,
            may_be_empty=may_be_empty,
            timeout_s=self.timeout_s,
            report=_note_once,
        )

    def diagnose(
        self, found: Sequence[Source], interrupted: Callable[[], bool], retried: Collection[str] | None = None
    ) -> None:
        """Diagnoses the recordings, showing a progress bar."""
        from hdbridge.fleet.engine import RETRIED, Cluster, Progress
        from hdbridge.fleet.engine import run as run_fleet

        note(f"{len(found)} sources, {len({each.joint for each in found} - {None})} joints")
        with progress_bar() as bar:
            task = bar.add_task("diagnosing", total=len(found))

            def notify(now: Progress) -> None:
                words = f"{now.done} of {now.total}" + f", {now.failed} failed" * bool(now.failed)
                bar.update(task, completed=now.done, total=max(now.total, 1), description=words)

            end = run_fleet(
                found,
                self.dataset,
                Cluster(self.scheduler, self.workers, self.memory),
                model=self.model,
                models=self.models,
                progress=notify,
                interrupted=interrupted,
                retried=RETRIED if retried is None else retried,
            )
        memory = f"; largest memory of a worker {end.memory_mb:.0f} MB" if end.memory_mb else ""
        counts = f"{end.done} recordings, {end.known} of them known already, {end.failed} newly failed"
        say(f"{self.dataset.folder}: {counts}{memory}")

    def summarise(self) -> Summary:
        """Prints, writes and returns the summary of the data set."""
        return _summarise(self.dataset, self.limit_arcsec, pages=self.pages)

    def say_interrupted(self) -> None:
        """Reports that the results so far are kept."""
        note(f"interrupted; {self.dataset.folder} keeps what is done, and the same command continues")


@taking(Fleet)
def run(fleet: Fleet) -> None:
    """Diagnose every recording that is not in FOLDER yet, and write Parquet and a page there.

    Ctrl-C keeps finished results; the same command continues. Exit status 2 if a recording in FOLDER has no
    diagnosis; the error gives their number, and everything is written.
    """
    found = fleet.find(fleet.dataset.stored())
    fleet.dataset.create()
    with deferred_interrupt() as interrupted:
        try:
            fleet.diagnose(found, interrupted)
        except KeyboardInterrupt:
            fleet.say_interrupted()
            raise
    summary = fleet.summarise()
    if summary.failed:
        raise InputError(
            f"recordings without a diagnosis: {len(summary.failed)} of {summary.recordings}; the first: "
            f"{summary.failed[0][2]}"
        )


@taking(Fleet)
def watch(
    fleet: Fleet,
    interval_s: Annotated[
        float,
        Option("--interval", metavar="SECONDS", min=0.1, max=86_400.0, help="Time between two listings, s."),
    ] = 60.0,
    once: Annotated[bool, Option("--once", help="End after one round, for a timer such as cron.")] = False,
) -> None:
    """Diagnose new recordings as they arrive, and update Parquet and page in FOLDER.

    Ctrl-C keeps finished results (exit status 0).
    """
    from hdbridge.fleet.engine import watch as watch_fleet

    with deferred_interrupt() as interrupted:

        def diagnose(found: Sequence[Source], retried: Collection[str]) -> None:
            fleet.diagnose(found, interrupted, retried)
            fleet.summarise()

        try:
            watch_fleet(
                partial(fleet.find, may_be_empty=True), fleet.dataset, interval_s, diagnose,
                once=once, report=note, interrupted=interrupted,
            )  # fmt: skip
        except KeyboardInterrupt:
            fleet.say_interrupted()


def report(
    out: OutArgument,
    html_file: Annotated[
        Path | None,
        Option("--html", metavar="PAGE", help="Write the page here; else OUT/fleet.html."),
        Kind.PAGE,
    ] = None,
    json_file: opt.Json = None,
    limit_arcsec: LimitOption = 10.0,
    pages: PagesOption = False,
    joints: Annotated[
        list[str] | None, Option("--joint", metavar="NAME", help="Also write the page of this joint.")
    ] = None,
) -> None:
    """Write the page of a run again, and print the joints to inspect first."""
    from hdbridge.fleet.dataset import Dataset

    need_extra("a fleet needs", _EXTRA, "fleet")
    dataset = Dataset(out)
    dataset.check()
    _summarise(dataset, limit_arcsec, html_file, json_file, pages=pages, joints=joints or ())


def simulate(
    folder: Annotated[
        Path, Argument(metavar="FOLDER", help="Write the fleet here: a new folder."), Kind.FOLDER
    ],
    joints: Annotated[int, Option("--joints", min=4, max=100_000, help="Number of joints.")] = 12,
    recordings: Annotated[int, Option("--recordings", min=3, max=1000, help="Recordings per joint.")] = 4,
    seed: Annotated[int, Option("--seed", help="Seed of the fleet.")] = 0,
) -> None:
    """Make recordings of a simulated fleet: growing known causes, damaged files, exchanged joints.

    FOLDER receives the recordings, `manifest.csv`, and the truth, `answers.json`.
    """
    from hdbridge.fleet.simulate import simulate as make

    with sole_writer(folder), progress_bar() as bar:
        task = bar.add_task("simulating", total=1.0)
        make(folder, joints, recordings, seed, lambda share: bar.update(task, completed=share))
    say(f"{folder}: {joints} joints with {recordings} recordings each")


def _summarise(
    dataset: Dataset,
    limit_arcsec: float,
    page: Path | None = None,
    json_file: Path | None = None,
    *,
    pages: bool = False,
    joints: Sequence[str] = (),
) -> Summary:
    """Prints, writes and returns the summary; writes the pages of ``joints``, and all with ``pages``."""
    from hdbridge.fleet.prior import write_prior
    from hdbridge.fleet.report import ROWS, fleet_page, hours_words, shown
    from hdbridge.fleet.summary import summarise

    rows = dataset.recordings()
    latest = shown(rows)
    for joint in joints:
        if joint not in latest:
            close = nearest(joint, [*latest])
            raise InputError(
                f"--joint: no diagnosis of '{joint}' in {dataset.folder}"
                + (f" (did you mean {close}?)" if close else "")
            )
    summary: Summary = summarise(rows, limit_arcsec)
    write_json(json_file, summary.as_dict())
    write_prior(dataset.folder / PRIOR_NAME, rows)
    listed = [each.joint for each in summary.first[:ROWS]] if pages else []
    found = _with_pages(dataset.folder, latest, dict.fromkeys([*joints, *listed]))
    if summary.first:
        first = [
            (
                each.joint,
                each.cause,
                f"{each.probability:.2f}",
                f"{each.peak_arcsec:.1f}",
                hours_words(each.remaining),
            )
            for each in summary.first
        ]
        print_table(("joint", "cause", "probability", "peak, arcsec", "hours to the limit"), first)
    else:
        say("No joint stands out." if latest else "No recording has a diagnosis.")
    for line in summary.lines():
        say(line)
    target = page or dataset.folder / PAGE_NAME
    for joint in dict.fromkeys(each for each in joints if each in found):
        note(f"page of {joint}: {dataset.folder / unquote(found[joint])}")
    beside = target.resolve().parent == dataset.folder.resolve()
    if not beside:  # pages are in OUT
        found = {joint: (dataset.folder.resolve() / each).as_uri() for joint, each in found.items()}
    write_page(target, fleet_page(summary, dataset.folder, found))
    return summary


def _with_pages(folder: Path, latest: Mapping[str, Row], wanted: Collection[str]) -> dict[str, str]:
    """Writes the missing pages of the wanted joints; returns the addresses of all pages, by joint."""
    from hdbridge.fleet.report import links, write_page

    there = links(folder, latest)
    missing = [each for each in wanted if each not in there]
    if missing:
        with progress_bar() as bar:
            for each in bar.track(missing, description="pages of joints"):
                try:
                    write_page(folder, latest[each])
                except InputError as problem:  # for example a removed recording
                    note(f"no page of {each}: {problem}")
        there = links(folder, latest)
    return there


_note_once = cache(note)
"""Prints a remark only the first time, because `watch` reads the manifest repeatedly."""


def _check_memory(text: str) -> None:
    from dask.utils import parse_bytes

    try:
        enough = parse_bytes(text) >= 200_000_000
    except ValueError:
        raise InputError(f"--memory: found '{text}'; expected a size such as 2GB") from None
    if not enough:
        raise InputError(
            f"--memory: found '{text}'; expected at least 200MB: the libraries alone need so much"
        )


COMMANDS: Final = {"fleet": {"run": run, "watch": watch, "report": report, "simulate": simulate}}
