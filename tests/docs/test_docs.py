"""Links on the pages are valid, commands exist, and examples run."""

import re
from pathlib import Path

import command_reference
import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
API_EXAMPLES = re.findall(
    r"```python\n(.*?)```", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), re.DOTALL
)


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def anchors(page: Path) -> set[str]:
    """The names that GitHub gives to a page's headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in headings}


def command_lines(page: Path) -> list[str]:
    """Lines of code blocks that call hdbridge, continued lines joined."""
    text = re.sub(r"\\\n\s*", " ", page.read_text(encoding="utf-8"))
    fenced = re.findall(r"^```\w*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    code = [*"\n".join(fenced).splitlines(), *re.findall(r"^    .*$", text, re.MULTILINE)]
    found = (re.match(r"\s*(?:\$ )?(?:\.venv/bin/)?(hdbridge [a-z-].*)", each) for each in code)
    return [each[1] for each in found if each]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_are_valid(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    lost = []
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            lost.append(link)
    assert lost == []


def test_pages_that_messages_profiles_and_tools_name_exist():
    files = (
        path for folder in ("hdbridge", "profiles", "tools", "tests") for path in (ROOT / folder).rglob("*")
    )
    named = {
        (path, page)
        for path in files
        if path.suffix in {".py", ".yaml", ".html", ".js", ".sh"}
        for page in re.findall(r"\bdocs/[\w-]+\.md", path.read_text(encoding="utf-8"))
    }
    assert len(named) > 30
    assert [(name(path), page) for path, page in named if not (ROOT / page).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_on_the_pages_exist_with_their_options(page):
    wrong = [command_reference.refused(line) for line in command_lines(page)]
    assert [each for each in wrong if each] == []


def test_the_command_line_check_finds_errors():
    refused = command_reference.refused
    assert refused("hdbridge step my-axis --simulate --count 60   # with a remark") is None
    assert refused("hdbridge model activate my-axis 3 --reason summer") is None
    assert "no option --cuont" in refused("hdbridge step my-axis --cuont 60")
    assert "no value" in refused("hdbridge step my-axis --count")
    assert "missing" in refused("hdbridge step --simulate")
    assert "too many" in refused("hdbridge step one two")
    assert "no command" in refused("hdbridge stpe one")


def test_the_reference_of_commands_is_up_to_date():
    page = command_reference.PAGE.read_text(encoding="utf-8")
    assert page == command_reference.page(), "run python tools/command_reference.py"


def test_every_command_has_a_heading_and_every_option_a_description():
    page = command_reference.page()
    for command in command_reference.commands():
        assert f"### `{command.usage}`" in page
        assert [each.names[0] for each in command.parameters if each.is_option and not each.help] == []


def test_the_readme_names_every_command():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^- `hdbridge [^:]*:", text, re.MULTILINE)
    listed = {name for row in rows for name in re.findall(r"`hdbridge ([\w-]+)", row)}
    assert listed == {each.name.split()[0] for each in command_reference.commands()}


def test_every_page_is_in_the_index():
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    linked = set(re.findall(r"\]\(([\w-]+\.md)\)", index))
    assert {each.name for each in (ROOT / "docs").glob("*.md")} - {"README.md"} == linked


@pytest.mark.parametrize("number", range(len(API_EXAMPLES)))
def test_examples_of_the_library_run(number, tmp_path, monkeypatch, capsys):
    """Each example is a separate program; its expected output, if stated, follows `# ->`."""
    monkeypatch.chdir(tmp_path)
    program = API_EXAMPLES[number]
    exec(compile(program, f"docs/api.md, example {number + 1}", "exec"), {"__name__": "__main__"})
    promised = re.findall(r"# -> (.*)$", program, re.MULTILINE)
    assert capsys.readouterr().out.splitlines() == promised


def test_the_readme_example_runs(monkeypatch, capsys):
    """Runs from a fresh clone, within its length limit, with the answer that the page prints."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    lines = [each for each in program.splitlines() if each]
    assert len(lines) <= 9
    assert sum("import" in each for each in lines) <= 2
    monkeypatch.chdir(ROOT)
    exec(compile(program, "README.md, example", "exec"), {"__name__": "__main__"})
    printed = text.partition("```\n\nIt prints")[2].partition("\n> ")[2].partition("\n\n")[0]
    number = re.compile(r"\d+(?:\.\d+)?")
    answers = [" ".join(each.replace("\n> ", " ").split()) for each in (printed, capsys.readouterr().out)]
    assert number.sub("#", answers[1]) == number.sub("#", answers[0])
    sizes = [[float(each) for each in number.findall(answer)] for answer in answers]
    assert sizes[1] == pytest.approx(sizes[0], rel=0.1)
