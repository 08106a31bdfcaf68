"""Ports of the emulator: who listens, what they hear, and what they see when it vanishes."""

import os
import time

import pytest

pytest.importorskip("termios", reason="pseudo-terminals need a POSIX system")

from skin.emulator.outlet import outlet
from skin.errors import InputError
from skin.port.wire import open_wire


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
    port = outlet(request.param, None)
    yield port
    port.unplug()


def test_it_knows_who_listens_and_is_heard(plugged):
    assert not plugged.connected()
    plugged.write(b"nobody hears this")
    stream = open_wire(plugged.address, 115200)
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


def test_a_link_leads_to_it_and_is_followed_again(tmp_path):
    link = tmp_path / "skin"
    port = outlet("pty", str(link))
    first = os.readlink(link)
    assert port.address == str(link)
    open_wire(str(link), 115200).close()
    port.unplug()
    assert not link.is_symlink()
    port.plug()
    assert os.readlink(link).startswith(os.path.dirname(first))
    port.unplug()


@pytest.mark.parametrize("name", ["usb", "tcp:", "tcp:70000", "tcp:x"])
def test_other_ports_are_refused(name):
    with pytest.raises(InputError, match="pty or tcp"):
        outlet(name, None)


def test_a_file_is_not_replaced_by_a_link(tmp_path):
    path = tmp_path / "notes"
    path.write_text("keep")
    with pytest.raises(InputError, match="would replace"):
        outlet("pty", str(path))
    assert path.read_text() == "keep"
