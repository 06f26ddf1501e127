"""The work of a page: its results, and what the page shows of it."""

import asyncio
import threading
from collections.abc import Callable

import pytest
from nicegui import Client, background_tasks, ui

from nlfilter_torch.core.progress import Progress
from nlfilter_torch.photo.app import dialogs as module
from nlfilter_torch.photo.app.dialogs import Tasks


@pytest.fixture
def tasks(client: Client, monkeypatch: pytest.MonkeyPatch) -> Tasks:
    monkeypatch.setattr(background_tasks, "create", asyncio.run)
    return Tasks()


def errors(client: Client) -> list[str]:
    """The errors that the page shows."""
    return [element.message for element in client.elements.values() if isinstance(element, ui.notification)]


def texts(client: Client) -> list[str]:
    return [element.text for element in client.elements.values() if isinstance(element, ui.label)]


async def fail_with(error: Exception) -> None:
    raise error


def test_work_runs_in_a_thread(tasks: Tasks) -> None:
    assert asyncio.run(tasks.run("Working", threading.get_ident)) != threading.get_ident()


def test_work_that_takes_long_is_shown_with_its_progress(
    tasks: Tasks, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PATIENCE", 0.01)
    monkeypatch.setattr(module, "BETWEEN_TEXTS", 0.01)
    progress = Progress()

    def wait_for(text: str) -> Callable[[], str]:
        def work() -> str:
            for _ in range(1000):
                if texts(client)[0].startswith(text):
                    break
                progress("Averaging", 1, 4)
                threading.Event().wait(0.01)
            return texts(client)[0]

        return work

    assert asyncio.run(tasks.run("Working", wait_for("Working\u2026"))) == "Working\u2026"
    assert asyncio.run(tasks.run("Saving", wait_for("Saving: "), progress=progress)).startswith("Saving: Averaging, ")
    (sign,) = [element for element in client.elements.values() if "working" in element.classes]
    assert not sign.visible


def test_what_goes_on_is_shown_until_all_of_it_ends(tasks: Tasks, client: Client) -> None:
    tasks.say("page", "Opening\u2026")
    assert tasks.sign.visible
    tasks.say("part", "Full size\u2026")
    assert texts(client) == ["Full size\u2026"]
    tasks.say("part")
    assert texts(client) == ["Opening\u2026"]
    assert tasks.sign.visible
    tasks.say("page")
    assert not tasks.sign.visible


def test_errors_are_shown_until_something_succeeds(tasks: Tasks, client: Client) -> None:
    tasks.start(fail_with(ValueError("the name must be one of a file")))
    assert errors(client) == ["the name must be one of a file"]
    tasks.show_error("another")
    assert "another" in errors(client)
    tasks.clear_error()
    tasks.clear_error()


def test_an_error_of_the_program_goes_to_the_log(tasks: Tasks, client: Client) -> None:
    with pytest.raises(ZeroDivisionError):
        tasks.start(fail_with(ZeroDivisionError()))
    assert len(errors(client)) == 1
    assert "it is not your fault" in errors(client)[0]


def test_a_page_that_is_gone_shows_no_error(tasks: Tasks, client: Client) -> None:
    client.delete()
    tasks.show_error("too late")
    assert errors(client) == []
