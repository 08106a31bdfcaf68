"""The first command that a person with a skin types."""

import signal
import subprocess
import sys

import pytest

from skin.core.files import ROOT
from skin.wire.protocol import Header, encode_header, encode_line

LISTEN = "-m", "skin", "listen"


def listen(*arguments):
    command = [sys.executable, *LISTEN, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=ROOT)


@pytest.fixture
def address(played):
    """Return the address of a skin of three sensors at 100 Hz, one line of ten spoilt."""

    def say(reader, stop):
        reader.sendall(b"boot\n" + encode_header(Header(n=3, rate=100.0, bits=10)))
        for number in range(100_000):
            line = encode_line([512, 500 + number % 2, 1023], number, 10_000 * number)
            reader.sendall(line.replace(b"512", b"513") if number % 10 == 9 else line)
            if stop.wait(0.01):
                return

    return played(say)


def test_it_says_what_comes(address):
    done = listen(f"device.port={address}", "seconds=1.5")
    assert done.returncode == 0, done.stderr
    first = done.stdout.splitlines()[0]
    assert "text, checksum crc16, 3 sensors" in first
    assert "1 skipped" in first
    assert "checksum)" in first
    assert "header: proto=1 n=3 rate=100 bits=10" in done.stdout
    assert [line.split()[:4] + line.split()[5:] for line in done.stdout.splitlines()[-3:]] == [
        ["0", "512", "512", "512", "ok"],
        ["1", "500", "500", "501", "ok"],
        ["2", "1023", "1023", "1023", "saturated"],
    ]


def test_ctrl_c_ends_it_well(address):
    command = [sys.executable, *LISTEN, f"device.port={address}", "seconds=null"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, cwd=ROOT, **pipes) as process:
        assert "text" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        out, said = process.communicate(timeout=120)
    assert (process.returncode, "saturated" in out) == (0, True), said


@pytest.fixture
def foreign(played):
    def say(reader, stop):
        for number in range(100_000):
            reader.sendall(b"<%d|%d|%d>\r" % (20_000 + 10 * number, 500 + number % 3, 700 - number % 2))
            if stop.wait(0.01):
                return

    return played(say)


def test_it_proposes_an_adapter_and_reads_with_it(foreign, tmp_path):
    done = listen(f"device.port={foreign}", "adapter=auto", "seconds=1.5")
    assert done.returncode == 0, done.stderr
    path = tmp_path / "board.yaml"
    path.write_text(done.stdout)
    done = listen(f"device.port={foreign}", f"device.adapter={path}", "seconds=1.5")
    assert done.returncode == 0, done.stderr
    assert "text, NO CHECKSUM, 2 sensors" in done.stdout
    assert "the device's clock counts ms" in done.stdout
