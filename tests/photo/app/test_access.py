"""Access to the editor: its own page only, for those who know its token, and files up to a size limit."""

import asyncio
import socket
import sys
from pathlib import Path

import pytest
from starlette.datastructures import Headers
from starlette.types import Message, Receive, Scope, Send

from nlfilter_torch.photo.app.access import LARGEST_UPLOAD, PROTECTION, Guard, forget_token, names_of, refusal, token_in

OWN = "127.0.0.1:8080"


def status(headers: dict[str, str], host: str = "127.0.0.1", *, websocket: bool = False) -> int | None:
    refused = refusal(Headers({"host": OWN} | headers), websocket=websocket, host=host, names=names_of(host))
    return None if refused is None else refused[0]


REQUESTS = [
    ({}, None),
    ({"origin": f"http://{OWN}"}, None),
    ({"host": "localhost:8080", "origin": "http://localhost:8080"}, None),
    ({"host": "[::1]:8080", "origin": "http://[::1]:8080"}, None),
    ({"host": "localhost", "origin": "https://localhost"}, None),  # behind a proxy
    ({"origin": "http://evil.example"}, 403),
    ({"origin": "http://127.0.0.1:9090"}, 403),  # another program on this machine
    ({"origin": "http://localhost:8080"}, 403),
    ({"origin": "null"}, 403),  # a sandboxed page
    ({"origin": ""}, 403),
    ({"host": "evil.example:8080", "origin": "http://evil.example:8080"}, 400),  # DNS rebinding
    ({"host": ""}, 400),
    ({"host": "192.168.1.9:8080"}, 400),
    ({"host": "127.0.0.1:99999999"}, 400),
]


@pytest.mark.parametrize("websocket", [False, True])
def test_only_the_page_itself(websocket: bool) -> None:
    for headers, wanted in REQUESTS:
        assert status(headers, websocket=websocket) == wanted


def test_scripts_of_other_sites_send_no_origin() -> None:
    assert status({"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}) == 403
    assert status({"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}) is None  # a link
    assert status({"sec-fetch-site": "same-origin", "sec-fetch-mode": "cors"}) is None


def test_addresses_of_an_editor_for_others() -> None:
    """Numeric addresses, the name of the machine and the name given are accepted, other names are not."""
    own = socket.gethostname()
    for host in ("192.168.1.9:8080", "[fe80::1]:8080", f"{own}:8080", "studio:8080", "127.0.0.1:8080"):
        assert status({"host": host, "origin": f"http://{host}"}, "studio") is None, host
    assert status({"host": "192.168.1.9:8080"}, "0.0.0.0") is None
    assert status({"host": "evil.example:8080"}, "0.0.0.0") == 400


def test_uploads_have_a_limit() -> None:
    assert status({"content-length": str(LARGEST_UPLOAD)}) is None
    assert status({"content-length": str(2 * LARGEST_UPLOAD)}) == 413
    assert status({"content-length": "many"}) == 413
    assert status({"transfer-encoding": "chunked"}) == 411


async def page(scope: Scope, receive: Receive, send: Send) -> None:
    """An application that answers everything."""
    start = "http.response.start" if scope["type"] == "http" else "websocket.accept"
    await send({"type": start, "status": 200, "headers": []})
    if scope["type"] == "http":
        await send({"type": "http.response.body", "body": b"the page"})


def answers(query: str = "", cookie: str = "", kind: str = "http") -> list[Message]:
    """What the guard of a page sends for a request with a query and a cookie."""
    sent: list[Message] = []

    async def receive() -> Message:
        return {"type": f"{kind}.request"}

    async def send(message: Message) -> None:
        sent.append(message)

    headers = [(b"host", OWN.encode()), (b"cookie", cookie.encode())]
    scope = {"type": kind, "method": "GET", "path": "/", "query_string": query.encode(), "headers": headers}
    asyncio.run(Guard(page, "127.0.0.1", "secret", "cookie")(scope, receive, send))
    return sent


def test_the_token_is_needed_and_becomes_a_cookie() -> None:
    for query, cookie in (
        ("", ""),
        ("token=wrong", ""),
        ("", "cookie=wrong"),
        ("", "other=secret"),
        ("token=", ";;\x7f="),
    ):
        refused = answers(query, cookie)
        assert refused[0]["status"] == 403
        assert refused[1]["body"] == b"open the address that the editor printed at its start, which holds its token"
        assert answers(query, cookie, "websocket") == [{"type": "websocket.close", "code": 1008}]
    exchanged = Headers(raw=answers("photo=a%20b.jpg&token=secret")[0]["headers"])
    assert exchanged["location"] == "/?photo=a+b.jpg"
    assert exchanged["set-cookie"].startswith("cookie=secret; HttpOnly;")
    assert "SameSite=strict" in exchanged["set-cookie"]
    assert answers(cookie="a=b; cookie=secret")[1]["body"] == b"the page"
    assert answers(cookie="cookie=secret", kind="websocket")[0]["type"] == "websocket.accept"


def test_no_page_can_frame_it() -> None:
    for sent in (answers(), answers("token=secret"), answers(cookie="cookie=secret")):
        headers = Headers(raw=sent[0]["headers"])
        assert {name: headers[name] for name in PROTECTION} == PROTECTION
        assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"


@pytest.mark.skipif(sys.platform == "win32", reason="modes of files are those of POSIX")
def test_a_token_is_random_and_that_of_a_crashed_editor_on_the_same_port(tmp_path: Path) -> None:
    file = tmp_path / "state" / "token-8080"
    token = token_in(file, crashed=True)
    assert token == token_in(file, crashed=True) == file.read_text()
    assert file.stat().st_mode & 0o077 == 0
    assert token_in(file, crashed=False) != token
    file.chmod(0o644)  # others may have read it
    token = file.read_text()
    assert token_in(file, crashed=True) not in ("", token)
    assert file.stat().st_mode & 0o077 == 0
    forget_token(file)
    forget_token(file)
    assert not file.exists()
    (tmp_path / "file").write_text("")
    assert len(token_in(tmp_path / "file" / "token", crashed=True)) == len(token)  # cannot be kept
