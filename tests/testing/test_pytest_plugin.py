"""The fixture `hdbridge_drive` in a user's pytest."""

import shutil
import subprocess
import sys

import pytest

from hdbridge.files.profile import bundled_profile

STRICT = ("--strict-markers", "-W", "error", "-p", "no:cacheprovider")
IN_PROCESS = ("-W", "ignore:Module already imported:pytest.PytestAssertRewriteWarning")
"""A second pytest in this process cannot rewrite modules that these tests have imported."""
PASSES = "def test_it(hdbridge_drive):\n    assert hdbridge_drive.state == 'switch on disabled'\n"


@pytest.fixture
def session(pytester):
    """Runs one test file in this process."""

    def run(text: str, *options: str) -> pytest.RunResult:
        pytester.makepyfile(text)
        return pytester.runpytest_inprocess(*STRICT, *IN_PROCESS, *options)

    return run


def show(name: str) -> str:
    """Returns a test that prints an attribute of the fixture."""
    return f"def test_it(hdbridge_drive):\n    print('got', hdbridge_drive.{name}, repr(hdbridge_drive))\n"


def test_pytest_loads_next_to_nothing_for_it():
    """Pytest loads the plugin in every run of an environment that contains hdbridge, used or not."""
    program = (
        "import sys, pytest; before = {*sys.modules}; import hdbridge.pytest_plugin; "
        "print(sorted({*sys.modules} - before))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['hdbridge', 'hdbridge.pytest_plugin']"


def test_a_drive_with_default_options(session):
    session(PASSES).assert_outcomes(passed=1)
    done = session(show("in_process"), "-s")
    done.stdout.fnmatch_lines(["*got True <simulated drive 1, axis 'demo', on virtual: switch on disabled>*"])


def test_marker_before_command_line_before_ini_file(session, pytester):
    pytester.makeini("[pytest]\nhdbridge_profile = article\nhdbridge_bus = lockstep\n")
    session(show("bus"), "-s").assert_outcomes(failed=1)
    session(show("lockstep"), "-s").stdout.fnmatch_lines(["*got True*'article', on lockstep*"])
    done = session(show("lockstep"), "-s", "--hdbridge-bus", "virtual", "--hdbridge-profile", "demo")
    done.stdout.fnmatch_lines(["*got False*'demo', on virtual*"])
    marked = "import pytest\n@pytest.mark.hdbridge_drive(profile='article', bus='lockstep', seed=3)\n"
    done = session(marked + show("lockstep"), "-s", "--hdbridge-bus", "virtual", "--hdbridge-profile", "demo")
    done.stdout.fnmatch_lines(["*got True*'article', on lockstep*"])


def test_two_tests_have_two_drives(session):
    text = """
        import pytest

        @pytest.mark.parametrize("number", [1, 2])
        @pytest.mark.parametrize("bus", ["virtual", "lockstep"])
        def test_it(request, number, bus):
            request.node.add_marker(pytest.mark.hdbridge_drive(bus=bus))
            drive = request.getfixturevalue("hdbridge_drive")
            assert drive.emergencies == ()
            drive.fault("drive_fault")
            drive.wait_until(lambda: drive.state == "fault")
    """
    session(text).assert_outcomes(passed=4)


def test_a_twin_precedes_a_truth_and_paths_are_relative_to_their_origin(session, pytester):
    axis = pytester.mkdir("axes") / "mine"
    shutil.copytree(bundled_profile("demo"), axis)
    marked = "import pytest\n@pytest.mark.hdbridge_drive(profile='axes/mine', bus='lockstep')\n"
    session(marked + show("truth_path.name"), "-s").stdout.fnmatch_lines(["*got truth.yaml*"])
    text = (axis / "truth.yaml").read_text(encoding="utf-8").replace("name: demo", "name: worn")
    (axis / "twin.yaml").write_text(text, encoding="utf-8")
    session(marked + show("truth_path.name"), "-s").stdout.fnmatch_lines(["*got twin.yaml*'worn'*"])
    pytester.makeini("[pytest]\nhdbridge_profile = axes/mine\nhdbridge_truth = axes/mine/truth.yaml\n")
    session(show("truth_path.name"), "-s").stdout.fnmatch_lines(["*got truth.yaml*'demo'*"])
    (axis / "twin.yaml").unlink()
    (axis / "truth.yaml").unlink()
    done = session(marked + PASSES, "-o", "hdbridge_truth=")
    done.stdout.fnmatch_lines(["*mine/truth.yaml: no such file, and no twin.yaml in the same folder*"])


def test_errors_are_one_line(session):
    done = session(PASSES, "--hdbridge-profile", "articel", "--tb", "short")
    done.assert_outcomes(errors=1)
    done.stdout.fnmatch_lines(["hdbridge_drive: articel: no such file*one of: *did you mean 'article'?"])
    assert "Traceback" not in done.stdout.str()
    assert "During handling" not in done.stdout.str()


@pytest.mark.parametrize(
    ("mark", "complaint"), [("profil='demo'", "found profil"), ("'demo'", "found *demo*")]
)
def test_a_marker_with_a_wrong_name_is_refused(session, mark, complaint):
    done = session(f"import pytest\n@pytest.mark.hdbridge_drive({mark})\n{PASSES}")
    done.assert_outcomes(errors=1)
    done.stdout.fnmatch_lines(
        [f"*the marker hdbridge_drive: {complaint}; expected profile, bus, seed, truth, firmware"]
    )


def test_a_failing_test_prints_the_drives_history(session):
    text = """
        import pytest

        @pytest.mark.hdbridge_drive(profile="article", bus="lockstep")
        def test_it(hdbridge_drive):
            hdbridge_drive.note("this is where it went wrong")
            hdbridge_drive.fault("drive_fault", after_s=0.1)
            hdbridge_drive.sleep(0.5)
            assert False
    """
    done = session(text)
    done.assert_outcomes(failed=1)
    done.stdout.fnmatch_lines(
        [
            "*simulated drive*",
            "<simulated drive 1, axis 'article', on lockstep: fault>",
            "*0.000 s  note   this is where it went wrong",
            "*0.100 s  fault  drive_fault code=0x3210",
            "*0.100 s  emcy   3210h (DC link over-voltage)",
            "*0.100 s  state  fault",
            "*drive sent  081  10 32 05 00 00 00 00 00",
            "true angles in the end: load *",
        ]
    )


def test_a_wrong_call_is_reported_at_the_line_of_the_test(session):
    done = session("def test_it(hdbridge_drive):\n    hdbridge_drive.fault('encoder_jmp')\n")
    done.stdout.fnmatch_lines([">*hdbridge_drive.fault('encoder_jmp')", "E *did you mean 'encoder_jump'*"])
    assert "def find" not in done.stdout.str()


def test_a_bus_left_open_is_harmless(session):
    text = """
        import can
        import pytest

        @pytest.mark.parametrize("bus", ["virtual", "lockstep"])
        def test_it(request, bus):
            request.node.add_marker(pytest.mark.hdbridge_drive(bus=bus))
            drive = request.getfixturevalue("hdbridge_drive")
            can.Bus(interface=drive.interface, channel=drive.channel)
    """
    session(text).assert_outcomes(passed=2)
