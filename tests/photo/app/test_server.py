"""The editor's server: its addresses, and what it answers."""

import gc
import socket
import sys
import weakref
from pathlib import Path

import pytest
from nicegui import Client, background_tasks

from nlfilter_torch.__main__ import main
from nlfilter_torch.photo.app import server
from nlfilter_torch.photo.app.library import Library
from nlfilter_torch.photo.app.page import EDITORS, Pages


@pytest.fixture
def pages(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pages:
    monkeypatch.setattr(background_tasks, "create", lambda work: work.close())
    return Pages(Library(tmp_path), ())


def test_pictures_are_for_those_who_know_their_address(pages: Pages) -> None:
    pages.build()
    answer_of = pages.picture
    ((token, editor),) = EDITORS.items()
    try:
        assert answer_of(token, "after").status_code == 404  # there is none
        assert answer_of(token, "original", "0,0,10,10").status_code == 404
        editor._canvas.pictures.update(after=b"JPEG", mask=b"PNG")
        answer = answer_of(token, "mask")
        assert (answer.status_code, answer.body, answer.media_type) == (200, b"PNG", "image/png")
        answer = answer_of(token, "after")
        assert (answer.media_type, answer.headers["Cache-Control"]) == ("image/jpeg", "no-store")
        assert answer_of("another", "after").status_code == 404
    finally:
        EDITORS.clear()


def test_a_free_port() -> None:
    port = server._check_address("127.0.0.1", 0)
    assert port > 0
    assert server._check_address("127.0.0.1", port) == port


def test_the_address_is_printed_once_the_server_answers(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        server._tell_when_ready("0.0.0.0", port, "abc")
    assert capsys.readouterr().out == f"Editor at http://0.0.0.0:{port}/?token=abc - Ctrl+C ends it\n"


def test_app_says_what_it_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["app", "--out", str(tmp_path / "gone"), "--no-open"]) == 2
    assert "does not exist; create the folder first" in capsys.readouterr().err
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["app", "--out", str(tmp_path), "--port", port, "--no-open"]) == 2
    assert f"cannot listen on --host 127.0.0.1 --port {port}" in capsys.readouterr().err
    monkeypatch.delitem(sys.modules, "nlfilter_torch.photo.app.server")
    monkeypatch.setitem(sys.modules, "nicegui", None)
    assert main(["app", "--out", str(tmp_path), "--no-open"]) == 2
    assert "the editor needs nicegui, which is not installed" in capsys.readouterr().err


class Page:
    """A page that refers to itself."""

    def __init__(self) -> None:
        self.itself = self


def test_closed_pages_are_freed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands look for circles seldom; the editor runs for days."""
    usual = gc.get_threshold()
    monkeypatch.setattr(gc, "freeze", gc.collect)  # for the other tests
    gc.set_threshold(20_000, 20, 100)
    try:
        server.free_closed_pages()
        closed = weakref.ref(Page())
        kept = [[number] for number in range(2000)]
        assert closed() is None
        assert len(kept) == 2000
    finally:
        gc.set_threshold(*usual)
