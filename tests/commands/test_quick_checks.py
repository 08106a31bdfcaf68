"""A port that does not exist is refused before a run is loaded."""

import pytest

from skin.errors import InputError
from skin.wire.reader import check_port


@pytest.mark.parametrize(
    ("port", "message"), [("/dev/none", "no port /dev/none"), ("./skin-port", "no port ./skin-port")]
)
def test_a_wrong_port_is_refused(port, message):
    with pytest.raises(InputError, match=message):
        check_port(port)


@pytest.mark.parametrize("port", ["COM3", "rfc2217://host:1", "socket://192.0.2.1:7", "null"])
def test_ports_that_cannot_be_checked_are_left_to_the_device(port):
    check_port(port)
