"""Access to the editor: its own pages, for those who know its token, with files of a limited and stated size."""

import ipaddress
import os
import secrets
import socket
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOCAL = ("127.0.0.1", "localhost", "::1")
LARGEST_UPLOAD = 1_000_000_000  # bytes of an uploaded file
FORM = 100_000  # bytes that a form adds to a file, at most
TOKEN = "token"  # in the query of the address that is printed
UNKNOWN = "open the address that the editor printed at its start, which holds its token"
#: No other page can show the editor in a frame and have its user click there, and none is told its address.
PROTECTION = {
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
}


def token_in(file: Path, *, crashed: bool) -> str:
    """A random token, which is kept in a file that only the user can read until the editor ends.

    If ``crashed``, it is the token of an earlier editor that did not come to its end, so that its pages find this one.
    """
    token = secrets.token_urlsafe(24)
    with suppress(OSError, ValueError):
        kept = file.read_text(encoding="ascii")
        if crashed and len(kept) == len(token) and file.stat().st_mode & 0o077 == 0:
            return kept
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.unlink(missing_ok=True)
        with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as stream:
            stream.write(token)
    return token


def forget_token(file: Path) -> None:
    """Remove the file of a token, since the editor ends."""
    with suppress(OSError):
        file.unlink()


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
    if not length.isdecimal() or int(length) > LARGEST_UPLOAD + FORM:
        return (
            413,
            f"a file must be at most {LARGEST_UPLOAD / 1e9:g} GB; make the picture smaller, or use the command line",
        )
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


def is_known(token: str, presented: str | None) -> bool:
    """Whether a presented token is the right one."""
    return presented is not None and secrets.compare_digest(token.encode(), presented.encode())


class Guard:
    """Refuses requests to an application, and websockets, that :func:`refusal` names or that lack the token.

    A token in the query of an address is exchanged for a cookie, and disappears from the address. ``name`` is that of
    the cookie, which browsers share between all ports of a machine.
    """

    def __init__(self, app: ASGIApp, host: str, token: str, name: str = TOKEN) -> None:
        self._app, self._host, self._names = app, host, names_of(host)
        self._token, self._name = token, name

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer or pass on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        websocket = scope["type"] == "websocket"
        answer = self._answer(scope, websocket=websocket)
        if answer is None:
            await self._app(scope, receive, send if websocket else Protected(send))
        elif websocket:
            await send({"type": "websocket.close", "code": 1008})
        else:
            await answer(scope, receive, Protected(send))

    def _answer(self, scope: Scope, *, websocket: bool) -> Response | None:
        """What is answered in place of the application, or None."""
        request = HTTPConnection(scope)
        refused = refusal(request.headers, websocket=websocket, host=self._host, names=self._names)
        if refused is not None:
            return PlainTextResponse(refused[1], status_code=refused[0])
        query = request.query_params
        if not websocket and is_known(self._token, query.get(TOKEN)):
            rest = urlencode([(name, value) for name, value in query.multi_items() if name != TOKEN])
            response = RedirectResponse(scope["path"] + (f"?{rest}" if rest else ""), status_code=303)
            response.set_cookie(self._name, self._token, httponly=True, samesite="strict")
            return response
        if is_known(self._token, request.cookies.get(self._name)):
            return None
        return PlainTextResponse(UNKNOWN, status_code=403)


class Protected:
    """Sends an answer with the headers of :data:`PROTECTION`."""

    def __init__(self, send: Send) -> None:
        self._send = send

    async def __call__(self, message: Message) -> None:
        """Send a part of an answer."""
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in PROTECTION.items():
                headers[name] = value
        await self._send(message)
