"""Whether a tracking server is there; found out before anything heavy is imported."""

import socket
from urllib.parse import urlsplit

from skin.errors import InputError

PATIENCE = 5.0
"""Seconds until a server that accepts no connection counts as away."""


def answers(uri: str) -> bool:
    """Return whether the server at an address accepts connections."""
    place = urlsplit(uri)
    port = place.port or (443 if place.scheme == "https" else 80)
    try:
        socket.create_connection((place.hostname or "", port), timeout=PATIENCE).close()
    except OSError:
        return False
    return True


def is_server(uri: str | None) -> bool:
    """Return whether a tracking URI is the address of a server, not of a database."""
    return uri is not None and uri.startswith(("http://", "https://"))


def check_server(uri: str | None) -> None:
    """Check that the server of a tracking URI answers, if the URI is that of a server.

    Raises:
        InputError: it does not.
    """
    if uri is not None and is_server(uri) and not answers(uri):
        raise InputError(
            f"the tracking server {uri} does not answer: start it, open the tunnel to it, or correct "
            "tracking.uri; without it, finished runs are not known, and nothing begins"
        )
