"""The example of docs/ci.md on a real CAN stack: the motion program in a process of its own."""

from support import ci_page


def test_the_example_on_vcan(interface, pytester):
    ci_page.write(pytester.path)
    done = pytester.runpytest_subprocess(
        "-q",
        "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:hypothesispytest", "-p", "no:schemathesis",
        "--hdbridge-bus", f"socketcan:{interface}",
        "--ignore=test_with_canopen.py",
        "-k", "goes or encoder_jump or killed",
    )  # fmt: skip
    done.assert_outcomes(passed=3, deselected=10)
