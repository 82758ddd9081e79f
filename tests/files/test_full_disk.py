"""On a full or read-only disk the old file remains, and no part of the new one is left."""

import subprocess
import sys

import pytest

from hdbridge.errors import InputError
from hdbridge.files.atomic import make_folder

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
