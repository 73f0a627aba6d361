"""Where a server can listen."""

from __future__ import annotations

import errno
import socket

from glassplat.data.errors import InputError

LOCAL = "127.0.0.1"
FIRST_PORT, MOST_PORTS = 8080, 100


def vacant_port(host: str) -> int:
    """The first port from 8080 on that can be used.

    Raises:
        InputError: none of a hundred can.
    """
    for port in range(FIRST_PORT, FIRST_PORT + MOST_PORTS):
        try:
            check_port(host, port)
        except InputError:
            continue
        return port
    raise InputError(f"no port from {FIRST_PORT} on can be used; end what serves there")


def check_port(host: str, port: int) -> None:
    """Refuses a port that is taken, or an address that is not this machine's, before anything is served.

    Raises:
        InputError: nothing can listen there.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            reason = "in use by another program" if error.errno == errno.EADDRINUSE else (error.strerror or str(error))
            raise InputError(f"port {port} of {host} cannot be used ({reason}); choose another --port") from error
