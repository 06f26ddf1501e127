"""``nlfilter-torch app``: the editor in the browser."""

from pathlib import Path
from typing import Annotated

import typer

Image = Annotated[
    Path | None, typer.Argument(metavar="[IMAGE]", help="A photograph to begin with: PNG, JPEG, TIFF, WebP or AVIF.")
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="FOLDER",
        help="Where the editor saves, and nowhere else. Left out: where IMAGE is, or the folder you are in.",
    ),
]
Host = Annotated[
    str,
    typer.Option(
        metavar="ADDRESS",
        help="Address to listen on. 127.0.0.1 is this machine only; with any other, whoever reaches it can open the "
        "editor and save into the folder.",
    ),
]
Port = Annotated[int, typer.Option(min=0, max=65535, metavar="N", help="Port to listen on; 0 takes a free one.")]
Open = Annotated[
    bool, typer.Option("--open/--no-open", help="Open the page in the browser, or only print its address.")
]


def app(image: Image = None, out: Out = None, host: Host = "127.0.0.1", port: Port = 0, open: Open = True) -> None:
    """Edit a photograph in the browser, with sliders and a brush, and compare before and after.

    The page is served locally; nothing is sent to or fetched from other machines. Ctrl+C ends the editor.

    Example: `nlfilter-torch app photo.jpg`
    """
    from nlfilter_torch.io.photographs import check_folder

    folder = out if out is not None else image.parent if image is not None else Path.cwd()
    check_folder(folder)
    if not folder.is_dir():
        raise ValueError(f"--out {folder} does not exist; make the folder first")
    try:
        from nlfilter_torch.app.server import serve
    except ModuleNotFoundError as error:
        raise ValueError(
            f"the editor needs {error.name}, which is not installed; install it with: pip install 'nlfilter-torch[app]'"
        ) from error
    serve(image, folder, host=host, port=port, open_page=open)
