"""Modules of ``skin`` need nothing that only POSIX systems have: tests/windows.py hides it."""

import subprocess
import sys
from pathlib import Path

import pytest

from skin.__main__ import verbs

SCRIPT = Path(__file__).with_name("windows.py")


@pytest.fixture
def windows(tmp_path):
    """Return a function that runs a verb in an empty folder as on Windows."""

    def run(*words):
        command = [sys.executable, str(SCRIPT), *words]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)

    return run


@pytest.mark.slow("imports all libraries anew")
def test_every_module_is_imported_and_every_verb_shows_its_help(windows):
    done = windows()
    assert done.returncode == 0, done.stderr
    for verb in verbs():
        assert f"    skin {verb}" in done.stdout


@pytest.mark.slow("trains a run with all libraries imported anew")
def test_a_run_is_trained(windows):
    small = ["data.gestures=48", "device.test_gestures=48", "evaluation.safe_gestures=64"]
    small += ["evaluation.devices=0", "evaluation.layouts=0"]
    done = windows("train", "experiment=rules", "simulator=naive", *small)
    assert done.returncode == 0, done.stderr
    assert "overall/accuracy" in done.stdout


@pytest.mark.slow("imports all libraries anew")
def test_the_emulator_asks_for_a_socket(windows):
    done = windows("emulate", "simulator=naive")
    assert done.returncode == 2
    assert done.stderr == "this system has no pseudo-terminals: give a TCP port, as in port=5555\n"


@pytest.mark.parametrize("port", ["COM3", "/dev/cu.usbmodem1101"])
def test_a_port_is_a_serial_port_by_any_name(windows, port):
    done = windows("listen", f"device.port={port}")
    assert done.returncode == 2
    assert done.stderr.startswith(f"no port {port}: there ")


def test_what_is_hidden_would_be_noticed(windows, tmp_path):
    """A module of another ``skin`` shows that."""
    (tmp_path / "skin").mkdir()
    (tmp_path / "skin" / "__init__.py").touch()
    for line in ("import fcntl", "import os; os.fork", "from signal import SIGKILL", "import os; os.getuid"):
        (tmp_path / "skin" / "__main__.py").write_text(f"{line}\n")
        code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(SCRIPT.parent)!r}]; import windows; "
        done = subprocess.run([sys.executable, "-c", f"{code}windows.main()"], capture_output=True, text=True)
        assert line.split()[-1].split(".")[-1] in done.stderr.splitlines()[-1]
        assert done.returncode == 1
