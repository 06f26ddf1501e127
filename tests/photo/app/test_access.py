"""Access to the editor: it accepts requests and websockets of its own page only, and files up to a size limit."""

import socket

import pytest
from starlette.datastructures import Headers

from nlfilter_torch.photo.app.access import LARGEST, names_of, refusal

OWN = "127.0.0.1:8080"


def status(headers: dict[str, str], host: str = "127.0.0.1", *, websocket: bool = False) -> int | None:
    refused = refusal(Headers({"host": OWN} | headers), websocket=websocket, host=host, names=names_of(host))
    return None if refused is None else refused[0]


@pytest.mark.parametrize("websocket", [False, True])
@pytest.mark.parametrize(
    ("headers", "wanted"),
    [
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
    ],
)
def test_only_the_page_itself(headers: dict[str, str], wanted: int | None, websocket: bool) -> None:
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
    assert status({"content-length": str(LARGEST)}) is None
    assert status({"content-length": str(2 * LARGEST)}) == 413
    assert status({"content-length": "many"}) == 413
    assert status({"transfer-encoding": "chunked"}) == 411
