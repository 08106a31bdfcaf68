"""Every command as a person starts it: a mistake is answered at once, in one sentence."""

import re
import subprocess
import sys

import pytest

from skin.__main__ import verbs

HEAVY = re.compile(r"\| +(torch|mlflow|pytorch_lightning|numpy|scipy)$", re.MULTILINE)


@pytest.mark.parametrize("verb", verbs())
def test_a_mistake_waits_for_no_heavy_import(verb, tmp_path):
    command = [sys.executable, "-X", "importtime", "-m", "skin", verb, "typo=1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "hydra" in done.stderr  # imports are told
    said = "\n".join(line for line in done.stderr.splitlines() if not line.startswith("import time:"))
    assert "typo" in said
    assert "Traceback" not in said
    assert not HEAVY.findall(done.stderr)
