"""``python -m nlfilter_torch`` is the command line."""

import sys

from nlfilter_torch.cli import main

if __name__ == "__main__":
    sys.exit(main())
