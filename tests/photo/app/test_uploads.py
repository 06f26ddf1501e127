"""Files that the browser sends: what the user is told about those it does not send."""

import pytest
from nicegui import Client

from nlfilter_torch.photo.app.uploads import Upload


@pytest.mark.parametrize(
    ("largest", "reason", "sentence"),
    [
        (1_000_000_000, "max-file-size", "a.png must be at most 1 GB; make it smaller, or use the command line"),
        (20_000_000, "max-file-size", "a.png must be at most 20 MB; make it smaller, or use the command line"),
        (20_000_000, "accept", "a.png is not a file of the kind that is opened here; choose another"),
    ],
)
def test_a_file_that_is_refused(client: Client, largest: int, reason: str, sentence: str) -> None:
    errors: list[str] = []

    async def take(event: object) -> None:
        raise AssertionError(event)

    upload = Upload(take, "image/*", largest, errors.append)
    upload._refuse(reason, "a.png")
    assert errors == [sentence]
    assert "pickFiles()" in upload.choosing
    assert upload.dropping.startswith("page.takeDropped(")
