"""A disk that is full or read-only: one line says so, what was there stays, and the same command goes on."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

TRAIN = ("+experiment=smoke", "stages=[train]", "n_threads=1", "tracking.snapshot_period_s=1e-6")

ON_DISKS = """
import subprocess, sys
place, disks, command = sys.argv[1], sys.argv[2].split(), sys.argv[3:]
subprocess.run(["mount", "-t", "tmpfs", "tmpfs", place], check=True)
for disk in disks:
    subprocess.run(["mount", "-o", f"remount,{disk}", place], check=True)
    done = subprocess.run([sys.executable, "-m", "negopipe", *command], capture_output=True, text=True)
    print(repr((done.returncode, done.stdout, done.stderr)))
"""
"""Runs a command line on one disk after the other, in a name space where `place` is a file system of its own."""


def run_on(disks: str, place: Path) -> list[tuple[int, str, str]]:
    """Exit code, stdout and stderr on each disk of `disks`, mount options separated by blanks."""
    place.mkdir()
    inside = [sys.executable, "-c", ON_DISKS, str(place), disks, *TRAIN, f"outputs={place}/outputs"]
    command = ["unshare", "--user", "--map-root-user", "--mount", *inside]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return [ast.literal_eval(line) for line in done.stdout.splitlines()]


@pytest.fixture(scope="module", autouse=True)
def can_mount(tmp_path_factory: pytest.TempPathFactory) -> None:
    place = tmp_path_factory.mktemp("disk")
    mount = f"mount -t tmpfs tmpfs {place}"
    command = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", mount]
    try:
        done = subprocess.run(command, capture_output=True, check=False)
    except OSError:
        pytest.skip("there is no unshare")
    if done.returncode != 0:
        pytest.skip("this user may not mount a disk to fill")


def only_line(text: str) -> str:
    (line,) = text.splitlines()
    return line


@pytest.mark.slow
def test_a_full_disk_ends_in_one_line_and_with_more_room_it_goes_on(tmp_path: Path) -> None:
    """8 MB take the store and the beginning of a training, not two snapshots of it."""
    full, larger = run_on("size=8m size=200m", tmp_path / "disk")
    assert full[0] == 1
    assert "No space left on device" in only_line(full[2])
    assert (larger[0], larger[2]) == (0, "")


def test_a_read_only_folder_ends_in_one_line(tmp_path: Path) -> None:
    ((code, _, said),) = run_on("ro", tmp_path / "disk")
    assert code == 1
    assert only_line(said).startswith("outputs must be a folder with room and write permission, got Read-only file")
