"""Ctrl-C while a command is still importing: no traceback, and the exit code of a signal."""

import signal
import subprocess
import sys

import pytest

from skin.paths import ROOT

# As early as the first import of ours, and in the middle of a heavy one.
MOMENTS = ["skin.interrupt", "torch._C"]


@pytest.mark.slow
@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize(
    "command", [["emulate"], ["train"], ["record", "out=x.csv"], ["evaluate"]], ids=lambda c: c[0]
)
def test_ctrl_c_among_imports(tmp_path, command, moment):
    script, *rest = command
    line = [sys.executable, "-X", "importtime", "-m", "skin", script, *rest]
    with subprocess.Popen(line, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        assert any(one.split("|")[-1].strip() == moment for one in process.stderr), "it never got there"
        process.send_signal(signal.SIGINT)
        said = process.stderr.read()
    assert "Traceback" not in said, said[-2000:]
    assert process.returncode == -signal.SIGINT
    assert not list(tmp_path.glob("x.csv*"))


def test_other_errors_keep_their_traceback():
    done = subprocess.run(
        [sys.executable, "-c", "import skin.config; raise ValueError('ours')"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert (done.returncode, "Traceback" in done.stderr) == (1, True)
