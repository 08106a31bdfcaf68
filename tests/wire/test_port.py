"""Ports of the emulator: who listens, what they hear, and what they see when it vanishes."""

import os
import select
import socket
import time
from threading import Thread

import pytest

pytest.importorskip("termios", reason="pseudo-terminals need a POSIX system")

from skin.errors import InputError
from skin.wire.emulator import _Tcp, open_port
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


def test_unplugging_while_the_other_thread_looks_who_listens(monkeypatch):
    """The reader has left, and just then somebody unplugs the port: that waits until the look is over."""
    port = open_port("tcp:0", None)
    with socket.create_connection(("127.0.0.1", int(port.address.rpartition(":")[2]))):
        deadline = time.monotonic() + 20
        while not port.connected():
            assert time.monotonic() < deadline
    unplugging = Thread(target=port.unplug)
    left = _Tcp._left

    def slowly(client):
        select.select([client], [], [], 20)  # the end of the stream may still be on its way
        unplugging.start()
        unplugging.join(0.1)
        return left(client)

    monkeypatch.setattr(_Tcp, "_left", staticmethod(slowly))
    assert not port.connected()
    unplugging.join(20)
    assert not unplugging.is_alive()
    assert not port.connected()


def test_writing_while_it_is_unplugged_and_plugged_in(plugged):
    """One thread writes, with a full buffer most of the time; another unplugs and plugs in."""
    failures = []

    def write():
        try:
            while not done:
                plugged.write(bytes(1 << 16))
        except BaseException as error:
            failures.append(error)

    done = []
    writing = Thread(target=write)
    writing.start()
    try:
        for _ in range(100):
            stream = open_stream(plugged.address, 115200)
            hear(stream, 1)
            plugged.unplug()
            stream.close()
            plugged.plug()
    finally:
        done.append(True)
        plugged.unplug()
        writing.join(20)
    assert not failures
    assert not writing.is_alive()


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


def test_a_link_in_use_is_left_alone(link):
    first = open_port("pty", str(link))
    target = os.readlink(link)
    used = rf"link=\S+ leads to {target}, which is in use: end .* another name"
    with pytest.raises(InputError, match=used):
        open_port("pty", str(link))
    assert os.readlink(link) == target
    first.unplug()
    second = open_port("pty", str(link))  # while the first is away
    with pytest.raises(InputError, match="in use"):
        first.plug()
    first.unplug()
    assert link.exists()
    second.unplug()
    assert not link.is_symlink()


def test_a_link_that_leads_nowhere_is_taken_over_and_another_ones_is_not_removed(link):
    link.symlink_to("/dev/pts/nothing")
    port = open_port("pty", str(link))
    assert link.exists()
    link.unlink()
    link.symlink_to("/dev/pts/other")
    port.unplug()
    assert os.readlink(link) == "/dev/pts/other"


def test_a_file_is_not_replaced_by_a_link(link):
    link.write_text("keep")
    with pytest.raises(InputError, match="would replace"):
        open_port("pty", str(link))
    assert link.read_text() == "keep"


@pytest.mark.parametrize("name", ["usb", "tcp:", "tcp:70000", "tcp:x"])
def test_other_ports_are_refused(name):
    with pytest.raises(InputError, match="pty or tcp"):
        open_port(name, None)
