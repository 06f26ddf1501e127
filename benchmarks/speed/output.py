"""Atomic file writes."""

import os
import tempfile
from pathlib import Path


def write(path: Path, content: bytes) -> None:
    """Write a temporary file in the same folder, which is created if missing, then rename the file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, beside = tempfile.mkstemp(dir=path.parent, suffix=path.suffix)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(content)
        os.chmod(beside, 0o644)  # mkstemp grants access to the owner only
        os.replace(beside, path)
    except BaseException:
        os.unlink(beside)
        raise
