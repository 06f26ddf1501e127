"""The script and the style sheet of the page, and the address at which the server offers them."""

from pathlib import Path

STATIC = Path(__file__).with_name("static")
STATIC_ADDRESS = "/static"
SCRIPTS = "".join(
    f'<script type="module" src="{STATIC_ADDRESS}/{name}"></script>\n' for name in ("page.js", "closeup.js", "crop.js")
)
