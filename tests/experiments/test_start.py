"""Every command as a person starts it: a mistake is answered at once, in one sentence."""

import re
import subprocess
import sys

import pytest

from skin.config import ROOT

SCRIPTS = {path.name: path for path in (ROOT / "experiments").glob("*.py")}
COMMANDS = sorted(name for name, path in SCRIPTS.items() if '__name__ == "__main__"' in path.read_text())
GIVEN = {"paired.py": ["rules", "features"], "study.py": ["norm"]}
HEAVY = re.compile(r"\| +(torch|mlflow|pytorch_lightning|numpy|scipy)$", re.MULTILINE)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_mistake_waits_for_no_heavy_import(name, tmp_path):
    command = [sys.executable, "-X", "importtime", str(SCRIPTS[name]), *GIVEN.get(name, []), "typo=1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "hydra" in done.stderr  # imports are told
    said = "\n".join(line for line in done.stderr.splitlines() if not line.startswith("import time:"))
    assert "typo" in said
    assert "Traceback" not in said
    assert not HEAVY.findall(done.stderr)
