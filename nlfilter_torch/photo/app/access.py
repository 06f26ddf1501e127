"""Access to the editor: its own pages, at an address of this machine, with files of a limited and stated size."""

import ipaddress
import socket
from collections.abc import Iterable
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Receive, Scope, Send

LOCAL = ("127.0.0.1", "localhost", "::1")
LARGEST = 1_000_000_000  # bytes of an uploaded file
FORM = 100_000  # bytes that a form adds to a file, at most


def names_of(host: str) -> frozenset[str]:
    """Names under which an editor that listens on ``host`` may be addressed, beside numeric addresses.

    >>> sorted(names_of("127.0.0.1"))
    ['127.0.0.1', '::1', 'localhost']
    """
    if host in LOCAL:
        return frozenset(LOCAL)
    own = socket.gethostname().lower()
    return frozenset((*LOCAL, host.lower(), own, own.partition(".")[0], f"{own.partition('.')[0]}.local"))


def refusal(headers: Headers, *, websocket: bool, host: str, names: Iterable[str]) -> tuple[int, str] | None:
    """Status and sentence for a request that is refused, or None.

    A page of another site can reach the editor in two ways: through its own domain name pointed at this machine (DNS
    rebinding), which the ``Host`` header reveals, or at the editor's address, which the ``Origin`` header reveals.
    """
    address = _split(f"//{headers.get('host', '')}")
    if address is None or not (address[0] in names or (host not in LOCAL and _is_numeric(address[0]))):
        return 400, "the host must be the address of the editor, as it was printed at its start"
    origin = headers.get("origin")
    if origin is not None and _split(origin) != address:
        return 403, "requests must come from the page of the editor itself"
    foreign = not websocket and headers.get("sec-fetch-site") in ("cross-site", "same-site")
    # Links, which are harmless, send no origin, and neither do scripts and pictures of other sites.
    if origin is None and foreign and headers.get("sec-fetch-mode") != "navigate":
        return 403, "requests must come from the page of the editor itself"
    length = headers.get("content-length", "0")
    if "chunked" in headers.get("transfer-encoding", ""):
        return 411, "the size of a file must be given in Content-Length"
    if not length.isdecimal() or int(length) > LARGEST + FORM:
        return 413, f"a file must be at most {LARGEST / 1e9:g} GB; make the picture smaller, or use the command line"
    return None


def _split(address: str) -> tuple[str, int | None] | None:
    """Host and port of an address, or None if it has none."""
    try:
        parts = urlsplit(address)
        port = parts.port or {"http": 80, "https": 443}.get(parts.scheme)
        return None if parts.hostname is None else (parts.hostname, None if port in (80, 443) else port)
    except ValueError:
        return None


def _is_numeric(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


class Guard:
    """Refuses requests to an application, and websockets, that :func:`refusal` names for the host it listens on."""

    def __init__(self, app: ASGIApp, host: str) -> None:
        self._app, self._host, self._names = app, host, names_of(host)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer or pass on."""
        if scope["type"] in ("http", "websocket"):
            websocket = scope["type"] == "websocket"
            refused = refusal(Headers(scope=scope), websocket=websocket, host=self._host, names=self._names)
            if refused is not None and websocket:
                await send({"type": "websocket.close", "code": 1008})
                return
            if refused is not None:
                await PlainTextResponse(refused[1], status_code=refused[0])(scope, receive, send)
                return
        await self._app(scope, receive, send)
