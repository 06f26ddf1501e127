"""The command line ``nlfilter-torch``. Options shared by several commands are in ``options``.

Invalid input of any kind is reported in one sentence on standard error, with exit status 2.
"""

import sys
from collections.abc import Callable, Iterable

from nlfilter_torch.photo.cli import process

Commands = Callable[[], Iterable[Callable[..., None]]]


def main(arguments: list[str] | None = None, others: Commands = tuple) -> int:
    """Run the command line on ``arguments`` (``sys.argv`` without its first entry) and return its exit status.

    ``others`` imports and returns commands besides those of this package.
    """
    process.sleep_while_waiting()
    process.collect_seldom()
    try:
        with process.handled():
            from nlfilter_torch.photo.cli.application import run_program

            return run_program(arguments, others())
    except KeyboardInterrupt:
        return process.tell()
    except process.Ended as ended:
        return ended.status
    except ModuleNotFoundError as error:
        sys.stderr.write(
            f"nlfilter-torch: the command line needs {error.name}, which is not installed; "
            "install it with: pip install 'nlfilter-torch[cli]'\n"
        )
        return 2
