"""The README and the pages of docs/, parsed into their code blocks, commands and links."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent


@dataclass(frozen=True)
class Page:
    """A page of Markdown."""

    path: Path

    @property
    def text(self) -> str:
        return self.path.read_text(encoding="utf-8")

    def blocks(self) -> list[tuple[str, str]]:
        """Language and content of each code block."""
        return re.findall(r"^```(\S+)\n(.*?)^```", self.text, flags=re.MULTILINE | re.DOTALL)

    def commands(self, program: str) -> list[list[str]]:
        """Arguments of each command of a program in the shell blocks."""
        lines = [shlex.split(line) for kind, block in self.blocks() if kind == "sh" for line in block.splitlines()]
        return [words[1:] for words in lines if words[0] == program]

    def targets(self) -> list[str]:
        """Targets of links and pictures, without anchors."""
        return re.findall(r"\]\(([^)#]+)[^)]*\)", self.text)

    def run_python(self, *, without: str | None = None) -> dict[str, object]:
        """Run the Python blocks in order, except those with a certain text; return the names that they define."""
        names: dict[str, object] = {}
        for kind, block in self.blocks():
            if kind == "python" and (without is None or without not in block):
                exec(compile(block, str(self.path), "exec"), names)
        return names


README = Page(ROOT / "README.md")
DOCS = [Page(path) for path in sorted((ROOT / "docs").glob("*.md"))]
