"""Writing files that appear complete or not at all."""

import os
import tempfile
from pathlib import Path


def write(path: Path, content: bytes) -> None:
    """Write beside the place, then move there; folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, beside = tempfile.mkstemp(dir=path.parent, suffix=path.suffix)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(content)
        os.chmod(beside, 0o644)  # made for its owner alone
        os.replace(beside, path)
    except BaseException:
        os.unlink(beside)
        raise
