"""Files that the browser sends: what the user is told about those it does not send."""

from nicegui import Client

from nlfilter_torch.photo.app.dialogs import Upload

REFUSED = [
    (
        "image/*",
        1_000_000_000,
        "max-file-size",
        "a.png must be at most 1 GB; make it smaller, or use the command line",
    ),
    (
        ".json,.cube",
        20_000_000,
        "max-file-size",
        "a.png must be at most 20 MB; make it smaller, or use the command line",
    ),
    ("image/*", 1, "accept", "a.png must be a PNG, JPEG, TIFF, WebP, AVIF or HEIC file; choose another"),
    (".json,.cube,application/json", 1, "accept", "a.png must be a .json or .cube file; choose another"),
    ("image/*", 1, "dialog", "a.png is not opened while a dialog is; close it, and drop the file again"),
]


def test_a_file_that_is_refused(client: Client) -> None:
    for accept, largest, reason, sentence in REFUSED:
        errors: list[str] = []

        async def take(event: object) -> None:
            raise AssertionError(event)

        upload = Upload(take, accept, largest, errors.append)
        upload._refuse(reason, "a.png")
        assert errors == [sentence]
        assert "pickFiles()" in upload.choosing
        assert upload.dropping.startswith("page.takeDropped(")
