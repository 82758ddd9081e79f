"""Folder of the flight recorder."""

import shutil
from pathlib import Path

import pytest

from hdbridge.daemon.machine import Machine


@pytest.fixture
def profile(tmp_path):
    folder = tmp_path / "axis"
    shutil.copytree("profiles/demo", folder)
    return folder


def test_folder_next_to_the_profile_without_a_service_manager(profile):
    assert Machine.find(str(profile)).recorder_folder({}) == profile / "recordings" / "daemon"


def test_folder_in_the_state_directory_of_the_service(profile):
    folder = Machine.find(str(profile)).recorder_folder({"STATE_DIRECTORY": "/var/lib/hdbridge:/other"})
    assert folder == Path("/var/lib/hdbridge/recordings")


def test_folder_never_among_the_bundled_profiles(tmp_path):
    folder = Machine.find("demo").recorder_folder({"XDG_STATE_HOME": str(tmp_path)})
    assert folder == tmp_path / "hdbridge" / "demo" / "recordings"


def test_folder_of_the_machine_file_is_relative_to_it(profile):
    file = profile / "machine.yaml"
    head = "schema: hdbridge.machine/1\nname: cell\n"
    file.write_text(f"{head}axes: [{{profile: {profile}}}]\nrecorder: {{folder: here}}\n")
    machine = Machine.load(file)
    assert machine.recorder_folder({"STATE_DIRECTORY": "/var/lib/hdbridge"}) == profile / "here"
