"""Ports of the emulator: who listens, what they hear, and what they see when it vanishes."""

import os
import time

import pytest

pytest.importorskip("termios", reason="pseudo-terminals need a POSIX system")

from skin.errors import InputError
from skin.wire.emulator import open_port
from skin.wire.reader import open_stream


def hear(stream, count):
    data, deadline = b"", time.monotonic() + 20
    while len(data) < count and time.monotonic() < deadline:
        data += stream.read()
    return data


def gone(stream):
    try:
        for _ in range(50):
            stream.read()
    except OSError:
        return True
    return False


@pytest.fixture(params=["pty", "tcp:0"])
def plugged(request):
    port = open_port(request.param, None)
    yield port
    port.unplug()


def test_it_knows_who_listens_and_is_heard(plugged):
    assert not plugged.connected()
    plugged.write(b"nobody hears this")
    stream = open_stream(plugged.address, 115200)
    try:
        deadline = time.monotonic() + 20
        while not plugged.connected():
            assert time.monotonic() < deadline
        data = bytes(range(256)) * 8
        plugged.write(data)
        assert hear(stream, len(data)) == data
        plugged.unplug()
        assert gone(stream)
    finally:
        stream.close()


@pytest.fixture
def link(tmp_path):
    return tmp_path / "skin"


def test_a_link_leads_to_it_and_is_followed_again(link):
    port = open_port("pty", str(link))
    first = os.readlink(link)
    assert port.address == str(link)
    open_stream(str(link), 115200).close()
    port.unplug()
    assert not link.is_symlink()
    port.plug()
    assert os.readlink(link).startswith(os.path.dirname(first))
    port.unplug()


def test_a_link_in_use_and_a_file_are_left_alone(link):
    first = open_port("pty", str(link))
    target = os.readlink(link)
    with pytest.raises(InputError, match=r"cannot make link=\S+, which may be in use: .* another name"):
        open_port("pty", str(link))
    assert os.readlink(link) == target
    first.unplug()
    link.write_text("keep")
    with pytest.raises(InputError, match="cannot make link"):
        open_port("pty", str(link))
    assert link.read_text() == "keep"


def test_a_link_that_leads_nowhere_is_taken_over(link):
    link.symlink_to("/dev/pts/nothing")
    open_port("pty", str(link)).unplug()
    assert not link.is_symlink()


@pytest.mark.parametrize("name", ["usb", "tcp:", "tcp:70000", "tcp:x"])
def test_other_ports_are_refused(name):
    with pytest.raises(InputError, match="pty or tcp"):
        open_port(name, None)
