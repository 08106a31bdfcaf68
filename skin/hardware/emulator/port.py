"""Ports of an emulated skin: a pseudo-terminal or a TCP server."""

import os
import select
import socket
from abc import ABC, abstractmethod
from contextlib import suppress
from pathlib import Path
from threading import RLock
from time import monotonic, sleep

from skin.errors import InputError

_PATIENCE = 1.0  # s that a reader may be late before bytes are lost, as in a device without flow control
_PAUSE = 0.002  # s until a full buffer is tried again


class AbstractPort(ABC):
    """Base class of ports; one thread may write while another unplugs the port.

    Attributes:
        address: value for ``device.port``.
    """

    address: str

    def __init__(self) -> None:
        # Held by every method that uses or replaces what is open.
        self._lock = RLock()

    @abstractmethod
    def connected(self) -> bool:
        """Return whether a reader is connected."""

    @abstractmethod
    def unplug(self) -> None:
        """Close the port."""

    @abstractmethod
    def plug(self) -> None:
        """Open the port again at the same address."""

    @abstractmethod
    def _send(self, data: bytes) -> int:
        """Write part of ``data`` without waiting and return its length; the lock is held."""

    def write(self, data: bytes) -> None:
        """Write; bytes that are not read within a second are lost."""
        deadline = monotonic() + _PATIENCE
        while data and monotonic() < deadline:
            with self._lock:
                if not self.connected():
                    return
                try:
                    data = data[self._send(data) :]
                    continue
                except BlockingIOError:
                    pass
                except OSError:
                    return
            sleep(_PAUSE)


def open_port(port: str, link: str | None) -> AbstractPort:
    """Open a port: ``pty``, or ``tcp:NUMBER`` (0: any free number).

    Args:
        port: as above.
        link: symbolic link to the pseudo-terminal, which stays the same after unplugging.

    Raises:
        InputError: an unknown port, a number in use, or a link that cannot be created.
    """
    kind, _, number = port.partition(":")
    if kind == "pty" and not number:
        return _Pty(link)
    if kind == "tcp" and number.isascii() and number.isdigit() and int(number) < 65536:
        if link is not None:
            raise InputError("a TCP port needs no link: leave out link=, or give port=pty")
        return _Tcp(int(number))
    raise InputError(f"port is pty or tcp:NUMBER, got {port}: as in port=tcp:5555")


class _Pty(AbstractPort):
    def __init__(self, link: str | None) -> None:
        super().__init__()
        self._link = None if link is None else Path(link).expanduser().absolute()
        if self._link and self._link.exists() and not self._link.is_symlink():
            raise InputError(f"link={link} would replace a file: give another name")
        self.plug()

    def plug(self) -> None:
        try:
            import tty
        except ImportError as error:  # Windows
            raise InputError(
                "this system has no pseudo-terminals: add port=tcp:5555, and read it with "
                "device.port=socket://127.0.0.1:5555"
            ) from error
        with self._lock:
            self._master, slave = os.openpty()
            tty.setraw(slave)
            os.set_blocking(self._master, False)
            name = os.ttyname(slave)
            # Opened and closed once, it signals when a reader opens it.
            os.close(slave)
        self.address = name if self._link is None else str(self._link)
        if self._link is not None:
            partial = self._link.with_name(self._link.name + ".part")
            try:
                partial.unlink(missing_ok=True)
                partial.symlink_to(name)
                partial.replace(self._link)
            except OSError as error:
                raise InputError(f"cannot make link={self._link}: {error}") from error

    def connected(self) -> bool:
        with self._lock:
            if self._master < 0:
                return False
            watch = select.poll()
            watch.register(self._master, 0)
            return not any(event & select.POLLHUP for _, event in watch.poll(0))

    def unplug(self) -> None:
        with self._lock:
            if self._master >= 0:
                os.close(self._master)
                self._master = -1
        if self._link is not None and self._link.is_symlink():
            self._link.unlink()

    def _send(self, data: bytes) -> int:
        return os.write(self._master, data)


class _Tcp(AbstractPort):
    def __init__(self, number: int) -> None:
        super().__init__()
        self._number = number
        self.plug()

    def plug(self) -> None:
        with self._lock:
            try:
                self._server = socket.create_server(("127.0.0.1", self._number))
            except OSError as error:
                raise InputError(f"cannot listen on tcp:{self._number}: {error}; as in port=tcp:0") from error
            self._server.setblocking(False)
            self._number = self._server.getsockname()[1]
            self.address = f"socket://127.0.0.1:{self._number}"
            self._client: socket.socket | None = None

    def connected(self) -> bool:
        with self._lock:
            if self._client is not None and self._left(self._client):
                self._client.close()
                self._client = None
            if self._client is None:
                with suppress(OSError):  # no reader, or unplugged
                    self._client, _ = self._server.accept()
                    self._client.setblocking(False)
            return self._client is not None

    def unplug(self) -> None:
        with self._lock:
            if self._client is not None:
                self._client.close()
                self._client = None
            self._server.close()

    @staticmethod
    def _left(client: socket.socket) -> bool:
        try:
            return not client.recv(4096)
        except BlockingIOError:
            return False
        except OSError:
            return True

    def _send(self, data: bytes) -> int:
        return self._client.send(data) if self._client else len(data)
