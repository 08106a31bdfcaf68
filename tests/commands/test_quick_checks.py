"""A port that does not exist is refused before a run is loaded."""

import socket

import pytest

from skin.errors import InputError
from skin.wire.reader import check_port


@pytest.mark.parametrize(
    ("port", "message"),
    [
        ("/dev/none", "no port /dev/none"),
        ("./skin-port", "no port ./skin-port"),
        ("socket://x", "is not an address"),
    ],
)
def test_a_wrong_port_is_refused(port, message):
    with pytest.raises(InputError, match=message):
        check_port(port)


def test_a_port_of_this_machine_needs_a_listener():
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"socket://127.0.0.1:{server.getsockname()[1]}"
        check_port(address)
        server.settimeout(0.1)
        with pytest.raises(TimeoutError):
            server.accept()  # the check did not connect
    with pytest.raises(InputError, match=f"cannot reach {address}: nothing listens there"):
        check_port(address)


@pytest.mark.parametrize("port", ["COM3", "rfc2217://host:1", "socket://192.0.2.1:7"])
def test_ports_that_cannot_be_checked_are_left_to_the_device(port):
    check_port(port)
