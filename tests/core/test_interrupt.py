"""Ctrl-C while a command is still importing: no traceback, and the exit code of a signal."""

import signal
import subprocess
import sys
from time import monotonic, sleep

import pytest

from skin.core.files import ROOT

# As early as the first import of ours, and in the middle of a heavy one.
MOMENTS = ["skin.core.interrupt", "torch._C"]


@pytest.mark.slow("imports anew up to every moment")
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
        [sys.executable, "-c", "import skin.runs.configuration; raise ValueError('ours')"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert (done.returncode, "Traceback" in done.stderr) == (1, True)


BUSY = """
import hashlib
from skin.core.interrupt import ends_on_signal
try:
    with ends_on_signal(lambda: print("last", flush=True)):
        print("busy", flush=True)
        {}
finally:
    print("closed", flush=True)
"""


@pytest.mark.parametrize(
    ("step", "lines"),
    [
        # A library in the middle of its work, which Python cannot interrupt.
        ("hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1)", ["busy", "last"]),
        ("__import__('time').sleep(60)", ["busy", "closed"]),
    ],
    ids=["native", "python"],
)
def test_sigterm_is_answered_within_seconds_whatever_the_process_does(step, lines):
    line = [sys.executable, "-c", BUSY.format(step)]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout.readline() == "busy\n"
        sleep(0.5)  # until it is in the middle of it
        start = monotonic()
        process.terminate()
        said = process.stdout.read().split()
        process.wait()
    assert process.returncode == 128 + signal.SIGTERM
    assert ["busy", *said] == lines
    assert monotonic() - start < 10
