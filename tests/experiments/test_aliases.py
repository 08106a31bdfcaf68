"""The six scripts in experiments/ run a command of ``skin``."""

import subprocess
import sys

import pytest

from skin.core.files import ROOT

COMMANDS = {
    "train": "train",
    "evaluate": "evaluate",
    "generate": "generate",
    "record": "record",
    "live": "live",
    "reproduce_table": "study",
}


@pytest.mark.parametrize(("script", "verb"), COMMANDS.items())
def test_a_script_shows_the_help_of_its_command(script, verb):
    command = [sys.executable, str(ROOT / "experiments" / f"{script}.py"), "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert f"skin {verb}" in done.stdout
