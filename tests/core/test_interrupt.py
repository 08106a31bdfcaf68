"""Ctrl-C while a command is still importing: no traceback, and the exit code of a signal."""

import os
import signal
import subprocess
import sys
from collections import Counter
from time import monotonic, sleep

import pytest

from skin.core.files import ROOT

# As early as the first import of ours, and in the middle of a heavy one.
MOMENTS = ["skin.core.interrupt", "torch._C"]
BUSY = """
import hashlib, time
from skin.core import interrupt
interrupt._CLOSING = 1.5
try:
    with interrupt.ends_on_signal(lambda: print("last", flush=True)):
        print("busy", flush=True)
        {}
finally:
    print("closed", flush=True)
"""


@pytest.mark.slow("imports anew up to every moment")
@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize(
    "command", [["emulate"], ["train"], ["record", "out=x"], ["evaluate"]], ids=lambda c: c[0]
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


@pytest.mark.parametrize(
    ("step", "lines"),
    [
        # A library in the middle of its work, which Python cannot interrupt.
        ("hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1)", ["busy", "last"]),
        ("time.sleep(60)", ["busy", "closed"]),
        ("try: time.sleep(60)\n        finally: time.sleep(60)", ["busy", "last"]),
    ],
    ids=["native", "python", "hangs while it closes"],
)
def test_sigterm_is_answered_within_seconds_whatever_the_process_does(step, lines):
    line = [sys.executable, "-c", BUSY.format(step)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(line, text=True, cwd=ROOT, **pipes) as process:
        assert process.stdout.readline() == "busy\n"
        sleep(0.5)  # until it is in the middle of it
        start = monotonic()
        process.terminate()
        sleep(0.2)
        process.terminate()
        said, complaint = process.communicate()
    assert process.returncode == 128 + signal.SIGTERM
    assert (["busy", *said.split()], complaint) == (lines, "")
    assert monotonic() - start < 10


DOUBLED = """
import os, random, signal, sys, time
from skin.core.interrupt import ends_on_signal

def wait():
    try:
        with ends_on_signal():
            try:
                os.write(sender, b"open")
                while True:
                    time.sleep(0.001)
            finally:
                time.sleep(0.005)  # the second signal arrives
                os.write(sender, b"closed")
    except SystemExit as end:
        os._exit(end.code)
    finally:
        os._exit(1)

pauses = random.Random(0)
for _ in range(int(sys.argv[1])):
    receiver, sender = os.pipe()
    child = os.fork() or wait()
    os.close(sender)
    os.read(receiver, 4)
    os.kill(child, signal.SIGTERM)
    time.sleep(pauses.uniform(0, 3e-4))
    os.kill(child, signal.SIGTERM)
    late = time.monotonic() + 5
    while not (ended := os.waitpid(child, os.WNOHANG))[0] and time.monotonic() < late:
        time.sleep(0.001)
    if not ended[0]:
        os.kill(child, signal.SIGKILL)
    status = ended[1] if ended[0] else os.waitpid(child, 0)[1]
    print(os.waitstatus_to_exitcode(status), os.read(receiver, 6).decode())
    os.close(receiver)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.parametrize("times", [20, pytest.param(1000, marks=pytest.mark.slow("starts 1,000 processes"))])
def test_two_signals_end_a_process_once_everything_is_closed(times):
    """A second one interrupted the first, in its handler, which could hang, or what closes resources."""
    line = [sys.executable, "-c", DOUBLED, str(times)]
    done = subprocess.run(line, capture_output=True, text=True, cwd=ROOT, check=True)
    assert Counter(done.stdout.splitlines()) == {"143 closed": times}
