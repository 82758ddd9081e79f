"""Pages that show commands, run in order as printed: `tools/pages.py` is the runner."""

import pages
import pytest

ROOT = pages.ROOT
RUN = {
    path: pages.read(path.read_text(encoding="utf-8"))
    for path in sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
}
QUICK = {"README.md", "docs/bring-up.md", "docs/daemon.md"}
"""Pages that take seconds; the others take minutes."""


def _name(path):
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=_name(path), marks=[] if _name(path) in QUICK else [pytest.mark.slow])
        for path, page in RUN.items()
        if page.commands
    ],
)
@pytest.mark.timeout(1800)
def test_documented_commands_give_the_documented_output(path, tmp_path):
    (tmp_path / "page").mkdir()
    wrong, _ = pages.run(path, tmp_path / "page")
    assert not wrong, "\n".join([*wrong, f"run python tools/pages.py --write {_name(path)}"])


@pytest.mark.parametrize("path", RUN, ids=_name)
def test_each_command_of_a_page_is_run_or_left_out_for_a_reason(path):
    """Commands in blocks of other kinds would never be run."""
    text = path.read_text(encoding="utf-8")
    blocks = [block for block in pages.FENCE.finditer(text) if block["kind"] in ("", "text")]
    loose = [
        line
        for block in blocks
        for line in block["text"].splitlines()
        if line.startswith(("hdbridge ", "$ "))
    ]
    loose += [line for line in text.splitlines() if line.startswith(("    hdbridge ", "    $ "))]
    outputs = path.name == "commands.md"
    assert outputs or not loose
    assert all(reason for _, reason in RUN[path].left_out)


def run(text, tmp_path):
    (tmp_path / "page").mkdir()
    (tmp_path / "page.md").write_text(text, encoding="utf-8")
    return pages.run(tmp_path / "page.md", tmp_path / "page")


@pytest.mark.parametrize(
    ("block", "complaint"),
    [
        ("```console\n$ echo one\ntwo\n```", "not printed: two"),
        ("```console\n$ printf 'a\\nb\\nc\\n'\na\nc\n```", "not printed: c"),
        ("```console\n$ echo 3.5 deg\n9.5 deg\n```", "9.5 and 3.5"),
        ("```sh\nfalse\n```", "exit status 1, not 0"),
        ("<!-- exit status: 2 -->\n```sh\nfalse\n```", "exit status 1, not 2"),
    ],
)
def test_differences_from_the_page_are_reported(block, complaint, tmp_path):
    wrong, _ = run(f"# Page\n\n{block}\n", tmp_path)
    assert complaint in "\n".join(wrong)


def test_figures_within_the_tolerance_dates_and_widths_may_differ(tmp_path):
    shown = "┃ 101.9   │ 2026-01-05T13:30:00Z ━"
    printed = "┃ 101.6 │ 2026-11-25T10:00:00Z ━━━"
    assert run(f"# Page\n\n```console\n$ echo '{printed}'\n{shown}\n```\n", tmp_path)[0] == []


def test_outputs_are_written_into_the_page_but_dates_are_kept(tmp_path):
    page = (
        "# Page\n\n```console\n$ echo '  9.5 at 2026-11-25T10:00:00Z'\n  3.5 at 2026-01-05T13:30:00Z\n```\n"
    )
    _, found = run(page, tmp_path)
    assert pages.rewritten(page, found) == page.replace("  3.5 at", "  9.5 at")


def test_an_unrunnable_page_states_the_reason():
    page = pages.read("<!-- not run: no drive -->\n\n# Page\n\n```sh\nhdbridge move my-axis 3\n```\n")
    assert page.commands == []
    assert [reason for _, reason in page.left_out] == ["no drive"]
