"""The port of the emulator: who listens, what they hear, and what they see when it vanishes."""

import time

import pytest

from skin.errors import InputError
from skin.wire.emulator import TcpPort
from skin.wire.reader import PortStream


def test_it_knows_who_listens_and_is_heard_and_is_plugged_in_at_the_same_address():
    port = TcpPort(0)
    assert not port.connected()
    port.write(b"nobody hears this")
    stream, address, data = PortStream(port.address, 115200), port.address, bytes(range(256)) * 8
    try:
        deadline = time.monotonic() + 20
        while not port.connected():
            assert time.monotonic() < deadline
        port.write(data)
        heard = b""
        while len(heard) < len(data) and time.monotonic() < deadline:
            heard += stream.read()
        assert heard == data
        port.unplug()
        with pytest.raises(OSError, match="disconnected"):
            list(iter(stream.read, None))
        with pytest.raises(InputError, match="cannot reach"):
            PortStream(address, 115200)
        port.plug()
        assert port.address == address
        with pytest.raises(InputError, match=r"cannot listen on port=\d+: .*; give port=0"):
            TcpPort(int(address.rpartition(":")[2]))
    finally:
        stream.close()
        port.unplug()
