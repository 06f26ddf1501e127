"""``nlfilter-torch app``: the editor in the browser."""

from pathlib import Path
from typing import Annotated

import typer

Images = Annotated[
    list[Path] | None,
    typer.Argument(metavar="[IMAGE]...", help="Photographs to open: PNG, JPEG, TIFF, WebP or AVIF."),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="FOLDER",
        help="The only folder in which the editor saves. Default: that of the first IMAGE, or the current folder.",
    ),
]
Host = Annotated[
    str,
    typer.Option(
        metavar="ADDRESS",
        help="Address to listen on. 127.0.0.1 accepts this machine only; with any other, everyone who can reach it and "
        "has its address with the token can use the editor and save to the folder.",
    ),
]
Port = Annotated[int, typer.Option(min=0, max=65535, metavar="N", help="Port to listen on; 0 selects a free one.")]
Open = Annotated[
    bool, typer.Option("--open/--no-open", help="Open the page in the browser, or only print its address.")
]


def app(images: Images = None, out: Out = None, host: Host = "127.0.0.1", port: Port = 0, open: Open = True) -> None:
    """Edit a photograph in the browser, with sliders and a brush, and compare before and after.

    The page is served locally; nothing is sent to or fetched from other machines. Ctrl+C ends the editor.

    Example: `nlfilter-torch app photo.jpg`

    Several, in a strip: `nlfilter-torch app *.jpg`
    """
    from nlfilter_torch.photo.files.formats import first_bytes
    from nlfilter_torch.photo.files.writing import check_folder

    images = images or []
    for image in images:
        first_bytes(image)
    folder = out if out is not None else images[0].parent if images else Path.cwd()
    check_folder(folder)
    if not folder.is_dir():
        raise ValueError(f"--out {folder} does not exist; create the folder first")
    try:
        from nlfilter_torch.photo.app.library import Library

        photographs = Library.opening(folder, images)  # while the rest is imported
        from nlfilter_torch.photo.app.page import Pages
        from nlfilter_torch.photo.app.server import serve
    except ModuleNotFoundError as error:
        raise ValueError(
            f"the editor needs {error.name}, which is not installed; install it with: pip install 'nlfilter-torch[app]'"
        ) from error
    pages = Pages(photographs, images)
    serve(pages.build, pages.picture, host=host, port=port, open_page=open)
