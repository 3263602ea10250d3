"""Who may drive the page of `rps view`, and with what: the page itself, within its own bounds.

viser accepts a connection from any page that a browser shows, and whatever number or text it sends.
Here a connection must carry the page's own host and origin, so that neither another site nor one
whose name was pointed at this machine (DNS rebinding) gets in; and a message must be one that the
page's own controls can send.
"""

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
from typing import Any

from rps_jax.errors import InputError

_SIZES = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3}  # of a message's tuples
_GREATEST = 1e6  # [1] of a number of a message
_LONGEST = 200  # characters of a text
_SUBSTITUTING = threading.Lock()

Rule = Callable[[Any], bool]  # whether a message is one that the page's controls can send


class Gate:
    """Keeps connections to a page's own host and origin, and messages to what it can send."""

    def __init__(self, host: str) -> None:
        """A gate for a page that is served on `host`; it lets no message through yet."""
        self._host = host.strip("[]").lower()
        self._rules: Mapping[str, Rule] = {}
        self.telling = False  # whether what was not let in is said
        self._log = logging.Logger("rps view")
        self._log.addHandler(_OneLine(logging.ERROR))

    def admit(self, rules: Mapping[str, Rule]) -> None:
        """Let messages of these types through, if their rules find them right."""
        self._rules = rules

    @contextlib.contextmanager
    def guarding(self) -> Iterator[None]:
        """Guard the servers of viser that are made meanwhile.

        viser hands no option for it to the server that it makes, so it is handed another function
        to make one by, in its own module alone.
        """
        import viser.infra._infra as module
        from websockets.asyncio.server import serve

        _infra: Any = module
        guarded = functools.partial(self._serve, serve)
        server = types.SimpleNamespace(serve=guarded)
        names = {"asyncio": types.SimpleNamespace(server=server)}
        with _SUBSTITUTING:
            usual: Any = _infra.websockets
            others = {name: getattr(usual, name) for name in ("exceptions", "datastructures")}
            _infra.websockets = types.SimpleNamespace(**names, **others)
            try:
                yield
            finally:
                _infra.websockets = usual

    def _serve(self, serve: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """What makes the server, with a look at every request and every message."""
        from websockets.asyncio.server import ServerConnection

        gate, answer = self, options["process_request"]

        class Connection(ServerConnection):
            """A connection that hands on only what the page can have sent."""

            told = False

            async def recv(self, *arguments: Any, **options: Any) -> Any:
                while True:
                    raw = await super().recv(*arguments, **options)
                    if gate.lets_through(raw):
                        return raw
                    if not self.told:
                        self.told = True
                        gate.tell("a message that the page does not send was dropped")

        def process_request(connection: ServerConnection, request: Any) -> Any:
            if self.refuses(request.headers):
                self.tell("a request that is not the page's own was refused")
                return connection.respond(http.HTTPStatus.FORBIDDEN, "This page is served alone.\n")
            return answer(connection, request)

        own = {"process_request": process_request, "create_connection": Connection}
        return serve(*arguments, **options | own, logger=self._log)

    def refuses(self, headers: Any) -> bool:
        """Whether a request is not addressed to this page, or comes from another one."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._mine(hosts[0]):
            return True
        same = [origin.lower() for origin in origins] == [f"http://{hosts[0].lower()}"]
        upgrade = any("websocket" in value.lower() for value in headers.get_all("Upgrade"))
        return (upgrade or bool(origins)) and not same

    def _mine(self, host: str) -> bool:
        """Whether a Host header names this machine, by an address or a name of its own.

        An address can't be pointed elsewhere; a name must be one by which the page is served.
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

    def lets_through(self, raw: Any) -> bool:
        """Whether a message is one that the page's own controls can send."""
        from viser._messages import Message

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # viser warns of fields of other types
                message = Message.deserialize(raw)
        except Exception:  # whatever malformed bytes, or a text, make viser raise
            return False
        rule = self._rules.get(type(message).__name__)
        return rule is not None and _plain(message.__dict__) and rule(message)

    def tell(self, what: str) -> None:
        """Say on the error stream, in one line, what was not let in."""
        if self.telling:
            self._log.error(what)


class _OneLine(logging.Handler):
    """Prints what is logged as one line, without a traceback."""

    def emit(self, record: logging.LogRecord) -> None:
        print(f"rps view: {record.getMessage().splitlines()[0]}.", file=sys.stderr, flush=True)


def _loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _plain(values: Mapping[str, Any]) -> bool:
    """Whether a message's fields are short texts and bounded finite numbers, of the right count."""
    for name, value in values.items():
        if name in _SIZES and not (isinstance(value, tuple | list) and len(value) == _SIZES[name]):
            return False
        if not _bounded(value, 3):
            return False
    return True


def _bounded(value: Any, depth: int) -> bool:
    if isinstance(value, str):
        return len(value) <= _LONGEST
    if isinstance(value, bool | None):
        return True
    if isinstance(value, int | float):
        return math.isfinite(value) and abs(value) <= _GREATEST
    if isinstance(value, dict):
        value = [*value.keys(), *value.values()]
    if isinstance(value, tuple | list):
        return depth > 0 and len(value) <= 64 and all(_bounded(one, depth - 1) for one in value)
    return False


def updates_of(handle: Any, updates: Any) -> bool:
    """Whether a control can be set so: one that is offered, or a number within its bounds."""
    if not isinstance(updates, dict) or set(updates) != {"value"}:
        return False
    value, props = updates["value"], handle._impl.props
    options = getattr(props, "options", None)
    if options is not None:
        return value in options
    usual = handle.value
    if isinstance(usual, bool) or isinstance(value, bool):
        return isinstance(usual, bool) and isinstance(value, bool)
    if isinstance(usual, str):
        return isinstance(value, str)
    if isinstance(usual, tuple):
        numbers = list(value) if isinstance(value, tuple | list) else []
        return len(numbers) == len(usual) and all(_within(one, props) for one in numbers)
    return _within(value, props)


def _within(value: Any, props: Any) -> bool:
    """Whether a number is within the bounds of a control; a text box has none, or tuples."""
    ends = getattr(props, "min", None), getattr(props, "max", None)
    low, high = (end if isinstance(end, int | float) else None for end in ends)
    low, high = -_GREATEST if low is None else low, _GREATEST if high is None else high
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and low <= value <= high


def check_guarded(gate: Gate, host: str, port: int) -> None:
    """Try the gate as a stranger would; InputError if this viser makes its server otherwise."""
    address = "127.0.0.1" if host in ("0.0.0.0", "", "::") else host
    for name in ("Host: rebound.example\r\n", f"Host: {address}\r\nOrigin: http://a.example\r\n"):
        with socket.create_connection((address, port), timeout=5) as stranger:
            stranger.sendall(f"GET / HTTP/1.1\r\n{name}Connection: close\r\n\r\n".encode())
            if b" 403 " not in stranger.recv(64):
                raise InputError(
                    "this version of viser cannot be kept to its own page: install the version "
                    "that constraints.txt names."
                )
    gate.telling = True
