"""Commands as a person starts them: scripts are short for verbs, and a mistake is answered at once."""

import subprocess
import sys

import pytest

from skin.__main__ import verbs
from skin.core.files import ROOT

WRONG = [*((verb, "typo=1", "typo") for verb in verbs()), ("train", "model=cn", "cn")]


@pytest.mark.parametrize(("verb", "word", "said"), WRONG)
def test_a_mistake_waits_for_no_heavy_import(verb, word, said, light, tmp_path):
    done = light(tmp_path, verb, word)
    assert (done.returncode, done.stdout) == (2, "\n"), done.stderr
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def test_help_waits_for_none(light, tmp_path):
    done = light(tmp_path, "train", "--help")
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, ""), done.stderr


@pytest.mark.parametrize("script", ["train", "evaluate", "generate", "record", "live", "reproduce_table"])
def test_a_script_shows_the_help_of_its_command(script):
    command = [sys.executable, str(ROOT / "experiments" / f"{script}.py"), "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert f"skin {script.replace('reproduce_table', 'study')}" in done.stdout
