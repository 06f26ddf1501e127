"""The layout of the package: top-level modules, imports in their order only, no cycles, and the depth of imports."""

import ast
from pathlib import Path

import pytest

import nlfilter_torch

PACKAGE = "nlfilter_torch"
ROOMS = (
    "core",
    "operator",
    "filtering",
    "nn",
    "edits",
    "tiled",
    "io",
    "plotting",
    "app",
    "cli",
)
INTERFACES = ("app", "cli")  # each counts as one module for the depth
DEEPEST = 9  # levels of imports
Imports = dict[str, set[str]]


def imports_of(sources: dict[str, str]) -> Imports:
    """Modules of the package that each module imports anywhere in its source."""
    imports: Imports = {}
    for module, text in sources.items():
        found: set[str] = set()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == PACKAGE:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
                found |= {name if name in sources else node.module for name in names}
            elif isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names if alias.name in sources}
        imports[module] = found - {module, PACKAGE}
    return imports


def package() -> Imports:
    root = Path(nlfilter_torch.__file__).parent
    sources = {}
    for path in sorted(root.rglob("*.py")):
        parts = (PACKAGE, *path.relative_to(root).with_suffix("").parts)
        sources[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path.read_text(encoding="utf-8")
    return imports_of(sources)


def room(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def upward(imports: Imports) -> list[str]:
    """Imports of a room that comes later in the list."""
    places = {name: place for place, name in enumerate(ROOMS)}
    return [
        f"{module} imports {other}"
        for module, others in imports.items()
        for other in sorted(others)
        if places.get(room(other), -1) > places.get(room(module), len(ROOMS))
    ]


def depth(imports: Imports) -> int:
    """Length of the longest chain of imports.

    Raises:
        ValueError: if there is a cycle.
    """
    known: dict[str, int] = {}

    def levels(module: str, chain: tuple[str, ...]) -> int:
        if module in chain:
            raise ValueError(" imports ".join([*chain[chain.index(module) :], module]))
        if module not in known:
            known[module] = 1 + max((levels(other, (*chain, module)) for other in imports.get(module, ())), default=0)
        return known[module]

    return max(levels(module, ()) for module in imports)


def folded(imports: Imports) -> Imports:
    """Return the imports with each interface as one module, and without the top-level module of public names."""
    whole: Imports = {}
    for module, others in imports.items():
        if room(module) not in ("", "__main__"):
            targets = {f"{PACKAGE}.{room(m)}" if room(m) in INTERFACES else m for m in (module, *others)}
            name = f"{PACKAGE}.{room(module)}" if room(module) in INTERFACES else module
            whole.setdefault(name, set()).update(targets - {name})
    return whole


def test_the_package_has_its_rooms_and_no_others() -> None:
    root = Path(nlfilter_torch.__file__).parent
    found = {path.stem for path in root.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert found == {*ROOMS, "__init__", "__main__"}


def test_imports_only_go_down() -> None:
    assert not upward(package())


def test_imports_have_no_cycles_and_are_not_deep() -> None:
    depth(package())
    assert depth(folded(package())) <= DEEPEST


def test_an_upward_import_is_noticed() -> None:
    sources = {
        "nlfilter_torch.core.blocks": "from nlfilter_torch.operator import build",
        "nlfilter_torch.operator.build": "",
    }
    assert upward(imports_of(sources)) == ["nlfilter_torch.core.blocks imports nlfilter_torch.operator.build"]
    assert depth(imports_of(sources)) == 2


def test_a_cycle_is_noticed() -> None:
    sources = {
        "nlfilter_torch.core.a": "import nlfilter_torch.core.b",
        "nlfilter_torch.core.b": "def f():\n    from nlfilter_torch.core.a import g",
    }
    with pytest.raises(ValueError, match=r"core\.a imports .*core\.b imports .*core\.a"):
        depth(imports_of(sources))
