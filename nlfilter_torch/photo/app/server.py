"""The editor's server: one page, one session per photograph, pictures at an address that only that tab knows.

Why NiceGUI and not Gradio: Gradio 6.31 excludes Pillow 13, its ImageEditor sends whole bitmaps, and in a trial with
headless Chromium its change event took more than three seconds after a stroke. NiceGUI reports the pointer in pixels
of the picture, keeps the moves of a slider in order, and includes every script and font that it uses.
"""

import gc
import socket
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from fastapi import Response
from nicegui import app, binding, ui

from nlfilter_torch.photo.app.access import TOKEN, Guard, forget_token, token_in
from nlfilter_torch.photo.app.sidecar import state_folder

STATIC = Path(__file__).with_name("static")  # the scripts and the style sheet of the page
STATIC_ADDRESS = "/static"  # at which the server offers them
SCRIPTS = "".join(
    f'<script type="module" src="{STATIC_ADDRESS}/{name}"></script>\n' for name in ("page.js", "closeup.js", "crop.js")
)
TITLE = "nlfilter-torch"
STARTING, PAUSE = 30.0, 0.05  # seconds for the server to accept connections, and between two attempts
#: Objects, and multiples, after which Python looks for circles among the youngest, the younger and all: as Python 3.11
#: does by itself.
COLLECTED = (700, 10, 10)


def serve(
    build: Callable[[str, str, str], None],
    picture: Callable[[str, str, str], Response],
    *,
    host: str,
    port: int,
    open_page: bool,
) -> None:
    """Run the editor until it is interrupted.

    ``build`` builds a page, and ``picture`` answers requests for its pictures: see :class:`Pages`.

    Raises:
        ValueError: if it cannot listen on that address; port 0 is a free one.
    """
    port, chosen = _check_address(host, port), port
    file = state_folder() / f"token-{port}"
    token = token_in(file, crashed=chosen != 0)
    app.on_shutdown(partial(forget_token, file))
    binding.MAX_PROPAGATION_TIME = 1.0  # otherwise NiceGUI warns, on standard error, whenever the machine is busy
    app.add_middleware(Guard, host=host, token=token, name=f"nlfilter-torch-{port}")
    app.config.quasar_config["loadingBar"] = {"skipHijack": True}  # the page shows what it is doing itself
    app.add_static_files(STATIC_ADDRESS, STATIC, max_cache_age=0)  # another version must not find old files
    app.get("/picture/{token}/{kind}")(picture)
    ui.page("/", title=TITLE, language="en-US")(build)
    free_closed_pages()
    app.on_startup(threading.Thread(target=_tell_when_ready, args=(host, port, token), daemon=True).start)
    ui.run(
        host=host,
        port=port,
        title=TITLE,
        dark=True,
        reload=False,
        show=f"/?{TOKEN}={token}" if open_page else False,
        tailwind=True,
        binding_refresh_interval=None,
        show_welcome_message=False,
        favicon="\U0001f39a\ufe0f",
        uvicorn_logging_level="warning",
    )


def free_closed_pages() -> None:
    """Look as often as Python 3.11 does by itself, not as seldom as commands do, for objects that refer to each other.

    Pages that were closed are such objects, and hold their photographs. What is loaded by now stays, and is left alone.
    """
    gc.freeze()
    gc.set_threshold(*COLLECTED)


def _tell_when_ready(host: str, port: int, token: str) -> None:
    """Print the address once the server accepts connections, which is a little after the start."""
    reachable = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # some systems cannot connect to these
    for _ in range(round(STARTING / PAUSE)):
        try:
            socket.create_connection((reachable, port), timeout=STARTING).close()
            break
        except OSError:
            time.sleep(PAUSE)
    shown = f"[{host}]" if ":" in host else host
    print(f"Editor at http://{shown}:{port}/?{TOKEN}={token} - Ctrl+C ends it", flush=True)


def _check_address(host: str, port: int) -> int:
    """The port to listen on; raises ValueError if that is not possible."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        if sys.platform != "win32":
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            remedy = "use --port 0 for a free port, or another address" if port else "use another, such as 127.0.0.1"
            raise ValueError(
                f"cannot listen on --host {host} --port {port} ({error.strerror or error}); {remedy}"
            ) from error
        return int(probe.getsockname()[1])
