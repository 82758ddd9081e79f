"""Invalid command lines give one line with the given and the expected value."""

import pytest


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ("step", "article", "--count", "abc"),
            "--count: found 'abc'; expected an integer from 2 to 100000; see hdbridge step --help",
        ),
        (("step", "article", "--count", 1), "--count: found '1'; expected a number from 2 to 100000"),
        (("latency", "--duration", "soon"), "--duration: found 'soon'; expected a number from 0.1 to 86400"),
        (("step", "article", "--scheme", "bth"), "--scheme: found 'bth'; expected none or synchronous or"),
        (("step", "article", "--scheme", "bth"), "(did you mean both?)"),
        (("step", "article", "--cuont", 5), "--cuont: no such option (did you mean --count?)"),
        (("step", "article", "--count"), "--count: a value is missing"),
        (("step",), "PROFILE: is missing; see hdbridge step --help"),
        (("fit",), "RECORD: is missing"),
        (("step", "article", "twice"), "'twice': expected no further argument"),
        (("stpe", "article"), "'stpe': no such command (did you mean 'step'?); see hdbridge --help"),
        (("model", "lgo"), "'lgo': no such command (did you mean 'log'?); see hdbridge model --help"),
        (("model", "activate", "article", "x"), "VERSION: found 'x'; expected an integer of at least 1"),
        (("step", "article", "--count", "1\n2"), r"--count: found '1\n2'"),
    ],
)
def test_errors_state_the_given_and_the_expected_value(hdbridge, arguments, line):
    done = hdbridge(*arguments, status=2)
    assert done.stdout == ""
    (said,) = done.stderr.splitlines()
    assert said.startswith("hdbridge: ")
    assert line in said


@pytest.mark.parametrize("arguments", [(), ("model",)])
def test_without_a_command_the_overview_is_shown(hdbridge, arguments):
    done = hdbridge(*arguments, status=2)
    assert "Usage" in done.stdout
    assert done.stderr == ""
