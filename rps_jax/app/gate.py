"""Access to the page of `rps view`: the page alone, within the bounds of its controls.

viser accepts a connection from any page that a browser shows, and any number or text it sends.
Here a connection must carry the page's own host and origin. Other sites are refused, also those
whose name was pointed at this machine (DNS rebinding). A message must be one that the controls of
the page can send.
"""

from __future__ import annotations

import functools
import http
import ipaddress
import logging
import math
import socket
import sys
import warnings
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

import jax
import numpy as np

from rps_jax.errors import InputError

_MAX_NUMBER = 1e6  # [1] in a message
_MAX_LENGTH = 200  # characters of a text
_DROPPED = "rps view: a message that the page does not send was dropped."
HOST = "127.0.0.1"  # of the page, which is served to this machine alone

Rule = Callable[[Any], bool]  # whether the controls of the page can send a message


class Gate:
    """Filter of connections by host and origin, and of messages by the controls of the page."""

    def __init__(self) -> None:
        """Create a gate that accepts no messages yet."""
        self.rules: Mapping[str, Rule] = {}  # of the accepted messages, by type

    def guarding(self) -> AbstractContextManager[object]:
        """Filter the traffic of servers that viser creates in this context.

        viser has no option for this, so the function that creates a server is replaced.
        """
        from websockets.asyncio import server

        return mock.patch.object(server, "serve", functools.partial(self._serve, server.serve))

    def _serve(self, serve: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Create a server that checks every request and every message."""
        from websockets.asyncio.server import ServerConnection

        gate, answer = self, options["process_request"]

        class Connection(ServerConnection):
            """A connection that drops messages which the page cannot send."""

            reported = False

            async def recv(self, *arguments: Any, **options: Any) -> Any:
                while not gate.accepts(raw := await super().recv(*arguments, **options)):
                    if gate.rules and not self.reported:
                        self.reported = True
                        print(_DROPPED, file=sys.stderr, flush=True)
                return raw

        def process_request(connection: ServerConnection, request: Any) -> Any:
            if self.refuses(request.headers):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "This page is served alone.\n")
            return answer(connection, request)

        options |= {"process_request": process_request, "create_connection": Connection}
        silent = logging.Logger("rps view", logging.CRITICAL)  # of malformed requests
        return serve(*arguments, **options, logger=silent)

    def refuses(self, headers: Any) -> bool:
        """Return whether a request has another host, or comes from another page."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not _is_this_machine(hosts[0]):
            return True
        same = [origin.lower() for origin in origins] == [f"http://{hosts[0].lower()}"]
        upgrade = any("websocket" in value.lower() for value in headers.get_all("Upgrade"))
        return (upgrade or bool(origins)) and not same

    def accepts(self, raw: bytes) -> bool:
        """Return whether the controls of the page can send a message."""
        from viser._messages import Message

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # viser warns of fields of other lengths
                message = Message.deserialize(raw)
            is_bounded = all(map(_is_bounded, jax.tree.leaves(vars(message))))
            return is_bounded and self.rules[type(message).__name__](message)
        except Exception:  # of any kind, by viser on malformed messages
            return False


def _is_this_machine(host: str) -> bool:
    """Return whether a Host header is a loopback address, which cannot be pointed elsewhere."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def _is_bounded(leaf: object) -> bool:
    """Return whether a part of a message is a short text or a bounded number."""
    if isinstance(leaf, str):
        return len(leaf) <= _MAX_LENGTH
    return isinstance(leaf, int | float) and math.isfinite(leaf) and abs(leaf) <= _MAX_NUMBER


def accepts_update(control: Any, updates: Mapping[str, Any]) -> bool:
    """Return whether a control can have this update: an offered value, or a number in bounds."""
    if set(updates) != {"value"}:
        return False
    properties = control._impl.props
    if (choices := getattr(properties, "options", None)) is not None:
        return updates["value"] in choices
    new, current = np.asarray(updates["value"]), np.asarray(control.value)
    kinds = {array.dtype.kind.replace("i", "f") for array in (new, current)}
    low, high = (getattr(properties, name, None) for name in ("min", "max"))
    return (
        (len(kinds), new.shape) == (1, current.shape)
        and (low is None or bool(np.all(new >= low)))
        and (high is None or bool(np.all(new <= high)))
    )


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
