"""Fixtures of tests of the page without a browser."""

from collections.abc import Iterator

import pytest
from nicegui import Client
from nicegui.page import page


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The JavaScript that a page would run in the browser."""
    scripts: list[str] = []
    monkeypatch.setattr(Client, "run_javascript", lambda client, code, **options: scripts.append(code))
    return scripts


@pytest.fixture
def client(scripts: list[str]) -> Iterator[Client]:
    """A page into which elements are built, and which no browser shows."""
    with Client(page("/")) as client:
        yield client
    if not client.is_deleted:
        client.delete()
