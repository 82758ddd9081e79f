"""`import hdbridge`: the names that a user needs, and nothing loaded before it is used."""

import subprocess
import sys
from pathlib import Path

import pytest

import hdbridge
from hdbridge import errors

PROFILE = Path(__file__).parents[2] / "profiles" / "article"


def python(program: str) -> str:
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.strip()


def test_importing_it_loads_nothing():
    """Neither its own modules nor those of Python, in which Ctrl-C would print a traceback."""
    program = "import sys; before = set(sys.modules); import hdbridge; print(*set(sys.modules) - before)"
    assert set(python(program).split()) == {"hdbridge", "__future__"}


@pytest.mark.parametrize("name", hdbridge.__all__)
def test_every_public_name_is_documented(name):
    found = getattr(hdbridge, name)
    assert found.__name__ == name
    assert found.__doc__
    assert name in dir(hdbridge)


def test_nothing_else_is_shown():
    """Completion of `hdbridge.` lists only the public names, whatever was loaded before."""
    shown = python(
        "import hdbridge.analysis.diagnosis, hdbridge.axis, hdbridge; print(*dir(hdbridge))"
    ).split()
    assert [each for each in shown if not each.startswith("__")] == sorted(hdbridge.__all__)


def test_another_name_is_refused_as_python_does():
    with pytest.raises(AttributeError, match="no attribute 'Brench'"):
        hdbridge.Brench  # noqa: B018


@pytest.mark.parametrize("name", ["simulated"])
def test_a_function_is_not_hidden_by_the_module_of_its_name(name):
    """By default, an import of the module would replace the function, before or after its first use."""
    assert python(f"import hdbridge.{name}\nprint(type(hdbridge.{name}).__name__)") == "function"
    assert (
        python(f"import hdbridge\nhdbridge.{name}\nfrom hdbridge import {name}\nprint({name}.__name__)")
        == name
    )


def test_every_error_is_public():
    kinds = [each for each in vars(errors).values() if isinstance(each, type)]
    raised = {each.__name__ for each in kinds if issubclass(each, errors.HdbridgeError)}
    assert raised <= set(hdbridge.__all__)


@pytest.mark.parametrize(
    "axis", ["'article'", "PROFILE", "str(PROFILE / 'axis.yaml')", "AxisConfig.load(PROFILE)"]
)
def test_an_axis_is_simulated_by_name_path_or_content(axis, tmp_path, monkeypatch):
    """As a first-time user does: in any folder, with nothing but the package."""
    monkeypatch.chdir(tmp_path)
    given = eval(axis, {"PROFILE": PROFILE, "AxisConfig": hdbridge.AxisConfig})
    with hdbridge.simulated(given) as drive:
        assert (
            drive.boot().identity["product_code"]
            == hdbridge.AxisConfig.load(PROFILE).drive.identity.product_code
        )


@pytest.mark.parametrize("axis", ["artikle", "no/such/folder", Path("axis.yml")])
def test_an_axis_that_does_not_exist_is_refused(axis):
    with (
        pytest.raises(hdbridge.InputError, match=r"expected a path or one of: .*article"),
        hdbridge.simulated(axis),
    ):
        pytest.fail("it was simulated")
