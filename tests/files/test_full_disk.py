"""On a full or read-only disk the old file remains, and no part of the new one is left."""

import subprocess
import sys
from pathlib import Path

import pytest
from support.command import run_here

from hdbridge.errors import HdbridgeError, InputError
from hdbridge.files.atomic import make_folder, write_folder
from hdbridge.files.outputs import Kind, Output, check_outputs

SCRIPT = """
import resource, sys
from hdbridge.errors import OutputError
from hdbridge.files.atomic import write_atomically
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))  # as on a full disk
try:
    write_atomically(sys.argv[1], "new" * 1000)
except OutputError as error:
    print(error)
"""


def test_the_old_file_remains_and_no_part_of_the_new_one(tmp_path):
    path = tmp_path / "model.yaml"
    path.write_text("old")
    done = subprocess.run(
        [sys.executable, "-B", "-c", SCRIPT, str(path)], capture_output=True, text=True, check=True
    )
    assert "model.yaml: cannot be written" in done.stdout
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_takes_no_files_is_refused_by_its_own_name():
    with pytest.raises(InputError, match=r"^/proc: cannot write into this folder"):
        make_folder("/proc")


@pytest.mark.parametrize("folder", ["/proc/of/mine", "/proc/mine"])
@pytest.mark.parametrize(
    "write",
    [
        lambda folder: write_folder(folder, {"axis.yaml": b"name: mine"}),
        lambda folder: check_outputs([Output("--record", folder, Kind.FOLDER)]),
    ],
)
def test_an_error_names_what_the_user_named_and_no_temporary_file(folder, write):
    with pytest.raises(HdbridgeError, match=rf"^{folder}: cannot"):
        write(Path(folder))


NEW = """
import resource, sys
from hdbridge.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))  # as on a full disk
sys.argv = ["hdbridge", "new", sys.argv[1]]
main()
"""


def test_a_new_axis_on_a_full_disk_names_its_own_file_and_leaves_nothing(tmp_path):
    asked = [sys.executable, "-B", "-c", NEW, str(tmp_path / "cell" / "mine")]
    done = subprocess.run(asked, capture_output=True, text=True, check=False)
    assert done.returncode == 6, done.stderr
    assert f"hdbridge: {tmp_path}/cell/mine/axis.yaml: cannot be written: " in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def full_disk(tmp_path):
    """Returns a function that makes a folder on a disk with room for this number of files and folders."""
    disk = tmp_path / "disk"
    disk.mkdir()

    def mounted(files):
        options = f"size=64k,nr_inodes={files + 1}"  # one is the folder itself
        mount = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(disk)]
        if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
            pytest.skip("needs the right to mount a file system")
        return disk

    yield mounted
    subprocess.run(["umount", str(disk)], capture_output=True, check=False)


@pytest.mark.parametrize("room", [0, 1])
@pytest.mark.parametrize(
    "asked",
    [
        ("new", "mine"),
        ("demo", "--count", 2),
        ("step", "article", "--simulate", "--count", 2, "--scheme", "none", "--record", "kept"),
        ("measure", "article", "--simulate", "--out", "kept"),
        ("fleet", "simulate", "fleet"),
    ],
    ids=lambda asked: asked[0],
)
def test_a_disk_without_room_for_a_folder_is_one_error_and_nothing_is_left(full_disk, room, asked):
    disk = full_disk(room)
    done = run_here(disk, *asked, status=6)
    (line,) = [each for each in done.stderr.splitlines() if each.startswith("hdbridge: ")]
    assert "No space left on device" in line
    assert "booted" not in done.stderr
    assert list(disk.iterdir()) == []
