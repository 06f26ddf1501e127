"""The program ``nlfilter-torch``, or ``python -m nlfilter_torch``: the command line, with a command for the editor."""

import sys
from collections.abc import Callable

from nlfilter_torch.photo import cli


def main(arguments: list[str] | None = None) -> int:
    """Run the program on ``arguments`` (``sys.argv`` without its first entry) and return its exit status."""
    return cli.main(arguments, _editor)


def _editor() -> list[Callable[..., None]]:
    from nlfilter_torch.photo.app.command import app

    return [app]


if __name__ == "__main__":
    sys.exit(main())
