"""Access to the page of `rps view`: the page alone.

viser accepts a connection from any page that a browser shows. Here a connection must carry the
page's own host and origin. Other sites are refused, also those whose name was pointed at this
machine (DNS rebinding).
"""

from __future__ import annotations

import functools
import http
import ipaddress
import logging
import socket
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

from rps_jax.errors import InputError

HOST = "127.0.0.1"  # of the page, which is served to this machine alone


def guarding() -> AbstractContextManager[object]:
    """Filter the connections of servers that viser creates in this context.

    viser has no option for this, so the function that creates a server is replaced.
    """
    from websockets.asyncio import server

    return mock.patch.object(server, "serve", functools.partial(_serve, server.serve))


def _serve(serve: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Create a server that checks every request."""
    answer = options["process_request"]

    def process_request(connection: Any, request: Any) -> Any:
        if _is_stranger(request.headers):
            return connection.respond(http.HTTPStatus.FORBIDDEN, "This page is served alone.\n")
        return answer(connection, request)

    silent = logging.Logger("rps view", logging.CRITICAL)  # of malformed requests
    return serve(*arguments, **options | {"process_request": process_request}, logger=silent)


def _is_stranger(headers: Any) -> bool:
    """Return whether a request has another host, or comes from another page."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or not _is_this_machine(hosts[0]):
        return True
    same = [origin.lower() for origin in origins] == [f"http://{hosts[0].lower()}"]
    upgrade = any("websocket" in value.lower() for value in headers.get_all("Upgrade"))
    return (upgrade or bool(origins)) and not same


def _is_this_machine(host: str) -> bool:
    """Return whether a Host header is a loopback address, which cannot be pointed elsewhere."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def check_guarded(port: int) -> None:
    """Send requests of strangers; InputError if this version of viser answers them."""
    for name in ("Host: rebound.example\r\n", f"Host: {HOST}\r\nOrigin: http://a.example\r\n"):
        with socket.create_connection((HOST, port), timeout=5) as stranger:
            stranger.sendall(f"GET / HTTP/1.1\r\n{name}Connection: close\r\n\r\n".encode())
            if b" 403 " not in stranger.recv(64):
                raise InputError(
                    "this version of viser answers other pages: install the version in "
                    "constraints.txt."
                )
