"""Reading a folder while the recorder renames and removes its files."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from support.command import run_here
from support.flight import START_NS, flight_log, samples
from support.meanwhile import before_each

from hdbridge.daemon.recorder.flightlog import Batch
from hdbridge.daemon.recorder.reading import GoneError, flight_files, read


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A recording that is being written and two that are finished."""
    made = tmp_path / "recordings"
    for number in range(3):
        log, clock = flight_log(made)
        clock.ns = START_NS + number * 10**10
        log.put(Batch(samples(250, 1 + 250 * number)))
        log.flush()
        if number < 2:
            log.close()
        else:
            log._file.abandon()
    assert len(flight_files([made])) == 3
    return made


def stages(path: Path) -> list[Path]:
    """Returns the names that the recorder may still give to a recording."""
    finished = path.with_name(path.name.removesuffix(".part"))
    kept = path.parent / "kept" / finished.name
    return [each for each in (finished, kept) if each != path]


def renames(folder: Path, names: list[str]) -> Callable[[str, Path], None]:
    """Returns a hook that renames each of these recordings when it is about to be opened, to its next
    possible name.
    """

    def hook(event: str, path: Path) -> None:
        if event == "open" and path.is_relative_to(folder) and path.name in names and path.exists():
            left = stages(path) if path.parent == folder else []
            if left:
                left[0].parent.mkdir(exist_ok=True)
                path.rename(left[0])
                names.append(left[0].name)

    return hook


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_recording_renamed_meanwhile_is_listed_and_exported(folder: Path, which: int) -> None:
    files = flight_files([folder])
    with before_each(renames(folder, [files[which].name])):
        run_here(folder.parent, "record", "list", folder, "--json", "listed.json")
    found = json.loads((folder.parent / "listed.json").read_text())["flights"]
    assert [each["cycles"] for each in found] == [250, 250, 250]
    files = flight_files([folder])
    with before_each(renames(folder, [files[which].name])):
        done = run_here(folder.parent, "record", "export", folder, "--all-states", "--out", "out")
    assert "750 samples" in done.stdout


def test_a_renamed_recording_is_found_by_its_old_name(folder: Path) -> None:
    (part,) = folder.glob("*.part")
    part.rename(part.with_name(part.name.removesuffix(".part")))
    run_here(folder.parent, "record", "info", part)
    assert len(read(part).machine["cycle"]) == 250


@pytest.mark.parametrize("command", [("list",), ("export", "--all-states", "--out", "out"), ("mend",)])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_recording_removed_meanwhile_is_omitted(folder: Path, command: tuple[str, ...], which: int) -> None:
    gone = flight_files([folder])[which]

    def hook(event: str, path: Path) -> None:
        if event == "open" and path == gone:
            gone.unlink(missing_ok=True)

    doing, *options = command
    with before_each(hook):
        done = run_here(folder.parent, "record", doing, folder, *options)
    assert gone.name not in done.stdout
    named = run_here(
        folder.parent,
        "record",
        doing,
        gone,
        *("other" if each == "out" else each for each in options),
        status=2,
    )
    assert "no such file" in named.stderr
    with pytest.raises(GoneError):
        read(gone)


@pytest.mark.parametrize("moment", [1, 2, 3, 4])
def test_renaming_during_the_listing_neither_duplicates_nor_drops_recordings(folder, moment):
    looks = 0

    def hook(event: str, path: Path) -> None:
        nonlocal looks
        if event == "os.scandir" and path.is_relative_to(folder):
            looks += 1
            if looks == moment:
                for part in folder.glob("*.part"):
                    part.rename(part.with_name(part.name.removesuffix(".part")))

    (folder / "kept").mkdir()
    with before_each(hook):
        found = flight_files([folder])
    assert len(found) == 3
    assert all(len(read(each).machine["cycle"]) == 250 for each in found)
