"""Access to the page of `rps view`: the page alone, within the bounds of its controls.

viser accepts a connection from any page that a browser shows, and any number or text it sends.
Here a connection must carry the page's own host and origin. Other sites are refused, also those
whose name was pointed at this machine (DNS rebinding). A message must be one that the controls of
the page can send.
"""

from __future__ import annotations

import contextlib
import functools
import http
import ipaddress
import logging
import math
import socket
import sys
import threading
import types
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from rps_jax.errors import InputError

if TYPE_CHECKING:
    from viser import GuiInputHandle

_SIZES = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3}  # of a message's tuples
_MAX_NUMBER = 1e6  # [1] in a message
_MAX_LENGTH = 200  # characters of a text
_SUBSTITUTING = threading.Lock()

Rule = Callable[[Any], bool]  # whether the controls of the page can send a message


class Gate:
    """Filter of connections by host and origin, and of messages by the controls of the page."""

    def __init__(self, host: str) -> None:
        """Create a gate for a page on `host` that accepts no messages yet."""
        self._host = host.strip("[]").lower()
        self._rules: Mapping[str, Rule] = {}
        self.verbose = False  # whether refusals are printed
        self._log = logging.Logger("rps view")
        self._log.addHandler(_OneLine(logging.ERROR))

    def allow(self, rules: Mapping[str, Rule]) -> None:
        """Accept messages of these types if their rules return true."""
        self._rules = rules

    @contextlib.contextmanager
    def guarding(self) -> Iterator[None]:
        """Filter the traffic of viser servers that are created in this context.

        viser has no option for this, so the function that creates its server is replaced, in its
        module alone.
        """
        import viser.infra._infra as module
        from websockets.asyncio.server import serve

        _infra: Any = module
        guarded = functools.partial(self._serve, serve)
        server = types.SimpleNamespace(serve=guarded)
        names = {"asyncio": types.SimpleNamespace(server=server)}
        with _SUBSTITUTING:
            original: Any = _infra.websockets
            unchanged = {n: getattr(original, n) for n in ("exceptions", "datastructures")}
            _infra.websockets = types.SimpleNamespace(**names, **unchanged)
            try:
                yield
            finally:
                _infra.websockets = original

    def _serve(self, serve: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Create a server that checks every request and every message."""
        from websockets.asyncio.server import ServerConnection

        gate, answer = self, options["process_request"]

        class Connection(ServerConnection):
            """A connection that drops messages which the page cannot send."""

            reported = False

            async def recv(self, *arguments: Any, **options: Any) -> Any:
                while True:
                    raw = await super().recv(*arguments, **options)
                    if gate.accepts(raw):
                        return raw
                    if not self.reported:
                        self.reported = True
                        gate.report("a message that the page does not send was dropped")

        def process_request(connection: ServerConnection, request: Any) -> Any:
            if self.refuses(request.headers):
                self.report("a request that is not the page's own was refused")
                return connection.respond(http.HTTPStatus.FORBIDDEN, "This page is served alone.\n")
            return answer(connection, request)

        options |= {"process_request": process_request, "create_connection": Connection}
        return serve(*arguments, **options, logger=self._log)

    def refuses(self, headers: Any) -> bool:
        """Return whether a request has another host, or comes from another page."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_host(hosts[0]):
            return True
        same = [origin.lower() for origin in origins] == [f"http://{hosts[0].lower()}"]
        upgrade = any("websocket" in value.lower() for value in headers.get_all("Upgrade"))
        return (upgrade or bool(origins)) and not same

    def _is_host(self, host: str) -> bool:
        """Return whether a Host header names this machine.

        An address cannot be pointed elsewhere; a name must be one by which the page is served.
        """
        name = host.rpartition(":")[0] if host.rpartition(":")[2].isdecimal() else host
        name = name.strip("[]").lower()
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            known = {"localhost", self._host}
            if not _loopback(self._host):
                known |= {socket.gethostname().lower(), socket.getfqdn().lower()}
            return name in known
        return address.is_loopback or not _loopback(self._host)

    def accepts(self, raw: Any) -> bool:
        """Return whether the controls of the page can send a message."""
        from viser._messages import Message

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # viser warns of fields of other types
                message = Message.deserialize(raw)
        except Exception:  # of any kind, by viser on malformed messages
            return False
        rule = self._rules.get(type(message).__name__)
        return rule is not None and _has_valid_fields(message.__dict__) and rule(message)

    def report(self, refusal: str) -> None:
        """Print a refusal on the error stream, in one line."""
        if self.verbose:
            self._log.error(refusal)


class _OneLine(logging.Handler):
    """A handler that prints the first line of a record, without a traceback."""

    def emit(self, record: logging.LogRecord) -> None:
        print(f"rps view: {record.getMessage().splitlines()[0]}.", file=sys.stderr, flush=True)


def _loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _has_valid_fields(values: Mapping[str, Any]) -> bool:
    """Return whether fields are short texts and bounded finite numbers, of the right length."""
    for name, value in values.items():
        if name in _SIZES and not (isinstance(value, tuple | list) and len(value) == _SIZES[name]):
            return False
        if not _bounded(value, 3):
            return False
    return True


def _bounded(value: Any, depth: int) -> bool:
    if isinstance(value, str):
        return len(value) <= _MAX_LENGTH
    if isinstance(value, bool | None):
        return True
    if isinstance(value, int | float):
        return math.isfinite(value) and abs(value) <= _MAX_NUMBER
    if isinstance(value, dict):
        value = [*value.keys(), *value.values()]
    if isinstance(value, tuple | list):
        return depth > 0 and len(value) <= 64 and all(_bounded(item, depth - 1) for item in value)
    return False


def accepts_update(control: GuiInputHandle[Any], updates: object) -> bool:
    """Return whether a control can have this update: an offered value, or a number in bounds."""
    if not isinstance(updates, dict) or set(updates) != {"value"}:
        return False
    new, current, properties = updates["value"], control.value, control._impl.props
    if (choices := getattr(properties, "options", None)) is not None:
        return new in choices
    if isinstance(current, bool | str) or isinstance(new, bool):
        return type(new) is type(current)
    if isinstance(current, tuple):
        values = list(new) if isinstance(new, tuple | list) else []
        return len(values) == len(current) and all(_in_bounds(x, properties) for x in values)
    return _in_bounds(new, properties)


def _in_bounds(value: object, properties: object) -> bool:
    """Return whether a value is a number within the bounds of a control, if it has any."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    low, high = getattr(properties, "min", None), getattr(properties, "max", None)
    is_above = value >= (low if isinstance(low, int | float) else -_MAX_NUMBER)
    return is_above and value <= (high if isinstance(high, int | float) else _MAX_NUMBER)


def check_guarded(gate: Gate, host: str, port: int) -> None:
    """Send requests of strangers; InputError if this version of viser answers them."""
    address = "127.0.0.1" if host in ("0.0.0.0", "", "::") else host
    for name in ("Host: rebound.example\r\n", f"Host: {address}\r\nOrigin: http://a.example\r\n"):
        with socket.create_connection((address, port), timeout=5) as stranger:
            stranger.sendall(f"GET / HTTP/1.1\r\n{name}Connection: close\r\n\r\n".encode())
            if b" 403 " not in stranger.recv(64):
                raise InputError(
                    "this version of viser answers other pages: install the version in "
                    "constraints.txt."
                )
    gate.verbose = True
