"""Serial ports and TCP sockets as byte streams."""

import errno
import os
import socket
from typing import Protocol
from urllib.parse import urlsplit

from skin.errors import InputError

try:
    import termios
except ImportError:  # Windows
    _Gone: type[Exception] = OSError
else:
    _Gone = termios.error

_WAIT = 0.1  # s
_CONNECT = 5.0  # s
# A reader does not notice that the other side lost its power; by default the system checks after two hours.
_KEEPALIVE = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3}  # s, s, attempts
_MOST = 65536  # bytes at once


class ByteStream(Protocol):
    """A source of bytes; a custom ``opener`` returns such an object."""

    def read(self) -> bytes:
        """Return the received bytes, possibly none, within 0.1 s; OSError once the stream is closed."""

    def close(self) -> None:
        """Close the port."""


def open_stream(port: str, baudrate: int) -> ByteStream:
    """Open a serial port, or ``socket://host:number``.

    Raises:
        InputError: there is no such port, it cannot be opened, or it is in use.
    """
    return _Socket(port) if port.startswith("socket://") else _Serial(port, baudrate)


def check_port(port: str) -> None:
    """Check that there is something at a port, without opening it: that would restart many boards.

    Args:
        port: as of :func:`open_stream`. Names of Windows and hosts elsewhere cannot be checked.

    Raises:
        InputError: there is no such device, or nothing on this machine listens at the address.
    """
    if port.startswith("socket://"):
        _check_address(*_address(port), port)
    elif os.name == "posix" and "/" in port and "://" not in port and not os.path.exists(port):
        raise InputError(f"no port {port}: {_existing()}")


def _check_address(host: str, number: int, port: str) -> None:
    """Refuse an address of this machine at which nothing listens: one that could be taken."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except OSError:
        return  # something listens, or it is another machine
    raise InputError(f"cannot reach {port}: nothing listens there; start what sends the frames first")


class _Serial:
    def __init__(self, port: str, baudrate: int) -> None:
        import serial

        try:
            # Exclusive, or two readers would get half the bytes each.
            self._port = serial.Serial(port, baudrate, timeout=_WAIT, exclusive=True)
        except (OSError, _Gone, ValueError, OverflowError) as error:
            raise _refused(port, baudrate, error) from error

    def read(self) -> bytes:
        try:
            return self._port.read(max(1, min(self._port.in_waiting, _MOST)))
        except (OSError, _Gone) as error:
            raise OSError(str(error)) from error

    def close(self) -> None:
        self._port.close()


class _Socket:
    def __init__(self, port: str) -> None:
        host, number = _address(port)
        try:
            self._socket = socket.create_connection((host, number), timeout=_CONNECT)
        except OSError as error:
            raise InputError(f"cannot reach {port}: {error}; does anything listen there?") from error
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE.items():
            if hasattr(socket, name):
                self._socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        self._socket.settimeout(_WAIT)

    def read(self) -> bytes:
        try:
            data = self._socket.recv(_MOST)
        except TimeoutError as error:
            if error.errno is not None:  # ETIMEDOUT: no answer to keepalive
                raise
            return b""
        if not data:
            raise ConnectionResetError("the other side closed the connection")
        return data

    def close(self) -> None:
        self._socket.close()


def _address(port: str) -> tuple[str, int]:
    """Return host and number of ``socket://host:number``."""
    try:
        address = urlsplit(port)
        host, number = address.hostname, address.port
    except ValueError:
        host = number = None
    if not host or not number:
        raise InputError(f"{port} is no address: give device.port=socket://HOST:NUMBER")
    return host, number


def _refused(port: str, baudrate: int, error: Exception) -> InputError:
    number, text = getattr(error, "errno", None), str(error)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or "FileNotFoundError" in text:
        return InputError(f"no port {port}: {_existing()}")
    # Windows reports "access is denied" for a port in use.
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "PermissionError" in text:
        return InputError(f"{port} is in use: close the serial monitor or any other program that reads it")
    if number in (errno.EACCES, errno.EPERM):
        return InputError(
            f"{port} may not be opened: add your user to dialout with "
            "sudo usermod -a -G dialout $USER, and log in again"
        )
    if number in (errno.ENOTTY, errno.EINVAL, errno.EISDIR) or "configure port" in text:
        return InputError(f"{port} is no serial port: {_existing()}")
    return InputError(f"cannot open {port} with device.baudrate={baudrate}: {text}")


def _existing() -> str:
    from serial.tools import list_ports

    ports = ", ".join(sorted(entry.device for entry in list_ports.comports()))
    return (
        f"there are {ports}; give device.port=PORT" if ports else "there is no serial port; is it plugged in?"
    )
