"""Ports of the emulator: who listens, what they hear, and what they see when one vanishes."""

import os
from functools import partial

import pytest

pytest.importorskip("termios", reason="pseudo-terminals need a POSIX system")

from skin.errors import InputError
from skin.wire.emulator import PtyPort, TcpPort
from skin.wire.reader import PortStream, check_port
from tests.wire.memory import wait_for


@pytest.mark.parametrize("kind", ["pty", "tcp"])
def test_it_knows_who_listens_and_is_heard_and_is_plugged_in_at_the_same_address(kind, tmp_path):
    link = str(tmp_path / "skin")
    make = partial(PtyPort, link) if kind == "pty" else partial(TcpPort, 0)
    port = make()
    assert not port.connected()
    stream, address, data = PortStream(port.address, 115200), port.address, bytes(range(256)) * 8
    try:
        wait_for(port.connected)
        assert port.write(data) == len(data)
        heard = bytearray()
        wait_for(lambda: heard.extend(stream.read()) or len(heard) == len(data))
        assert heard == data
        port.unplug()
        with pytest.raises(OSError, match=r"disconnected|Input/output"):
            list(iter(stream.read, None))
        with pytest.raises(InputError, match=r"cannot reach|no port"):
            PortStream(address, 115200)
        port.plug()
        assert port.address == address == (link if kind == "pty" else address)
        match = r"cannot make link=.* another name|cannot listen .* give port=0"
        with pytest.raises(InputError, match=match):
            make() if kind == "pty" else TcpPort(int(address.rpartition(":")[2]))
        PortStream(address, 115200).close()
    finally:
        stream.close()
        port.unplug()
    assert not os.path.lexists(link)


@pytest.mark.parametrize("port", ["/dev/none", "./skin-port"])
def test_a_port_that_does_not_exist_is_refused_before_a_run_is_loaded(port):
    with pytest.raises(InputError, match=f"no port {port}"):
        check_port(port)


@pytest.mark.parametrize("port", ["COM3", "rfc2217://host:1", "socket://192.0.2.1:7", "null"])
def test_ports_that_cannot_be_checked_are_left_to_the_device(port):
    check_port(port)


def test_a_file_is_left_alone_and_a_link_that_leads_nowhere_is_taken_over(tmp_path):
    link = tmp_path / "skin"
    link.write_text("keep")
    with pytest.raises(InputError, match="cannot make link"):
        PtyPort(str(link))
    assert link.read_text() == "keep"
    link.unlink()
    link.symlink_to("/dev/pts/nothing")
    PtyPort(str(link)).unplug()
    assert not link.is_symlink()
