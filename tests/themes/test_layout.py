"""The layout of the package: its rooms, imports in their order only, no cycles, and the depth of imports."""

import ast
from pathlib import Path

import pytest

import nlfilter_torch

PACKAGE = "nlfilter_torch"
ROOMS = ("version", "core", "operator", "filtering", "nn", "deepinv", "sklearn", "photo")
PHOTO_ROOMS = (
    "declared",
    "files",
    "picture",
    "selections",
    "looks",
    "edits",
    "plotting",
    "app",
    "cli",
)
LONG = 60  # lines of a module that must have a test file of its name
DEEPEST = 16  # levels of imports
Imports = dict[str, set[str]]


def imports_of(sources: dict[str, str]) -> Imports:
    """Modules of the package that each module imports anywhere in its source."""
    imports: Imports = {}
    for module, text in sources.items():
        targets: set[str] = set()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and node.level:  # of a stub, relative to its package
                targets.add(f"{module}.{node.module}")
            elif isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == PACKAGE:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
                targets |= {name if name in sources else node.module for name in names}
            elif isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names if alias.name in sources}
        imports[module] = targets - {module}
    return imports


def package() -> Imports:
    root = Path(nlfilter_torch.__file__).parent
    sources = {}
    for path in sorted(root.rglob("*.py")):
        parts = (PACKAGE, *path.relative_to(root).with_suffix("").parts)
        stub = path.with_suffix(".pyi")  # lists the names that a package imports when they are used
        text = path.read_text(encoding="utf-8") + (stub.read_text(encoding="utf-8") if stub.exists() else "")
        sources[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = text
    return imports_of(sources)


def room(module: str, level: int = 1) -> str:
    """The room of a module at a level: 1 is that of the package, 2 that of the application."""
    parts = module.split(".")
    return parts[level] if len(parts) > level else ""


def upward(imports: Imports, rooms: tuple[str, ...] = ROOMS, level: int = 1) -> list[str]:
    """Imports of a room that comes later in the list; the package itself comes last."""
    places = {name: place for place, name in enumerate(rooms)}
    inside = ".".join((PACKAGE, "photo")[:level])
    return [
        f"{module} imports {other}"
        for module, others in imports.items()
        if module.startswith(inside)
        for other in sorted(others)
        if other.startswith(inside)
        and places.get(room(other, level), len(rooms)) > places.get(room(module, level), len(rooms))
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


def test_the_package_has_its_rooms_and_no_others() -> None:
    root = Path(nlfilter_torch.__file__).parent
    for folder, rooms in ((root, ROOMS), (root / "photo", PHOTO_ROOMS)):
        names = {path.stem for path in folder.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
        assert names - {"__init__", "__main__"} == set(rooms)


def test_imports_only_go_down() -> None:
    assert not upward(package())
    assert not upward(package(), PHOTO_ROOMS, level=2)


def test_the_library_does_not_import_the_application() -> None:
    outside = (PACKAGE, f"{PACKAGE}.__main__", f"{PACKAGE}.photo")
    for module, others in package().items():
        if module not in outside and not module.startswith(f"{PACKAGE}.photo."):
            assert not any(other.startswith(f"{PACKAGE}.photo") for other in others), module


def test_imports_have_no_cycles_and_are_not_deep() -> None:
    assert depth(package()) <= DEEPEST


def without_a_test(root: Path, tests: Path) -> list[str]:
    """Modules of :data:`LONG` lines and more without ``test_MODULE.py`` at the same place in the tree of the tests."""
    return [
        str(path)
        for path in (path.relative_to(root) for path in sorted(root.rglob("*.py")))
        if path.name not in ("__init__.py", "__main__.py")
        and len((root / path).read_text(encoding="utf-8").splitlines()) >= LONG
        and not (tests / path.parent / f"test_{path.name}").exists()
    ]


def test_every_module_has_tests_of_its_name_beside_it() -> None:
    assert not without_a_test(Path(nlfilter_torch.__file__).parent, Path(__file__).parents[1])


def test_a_module_without_tests_is_noticed(tmp_path: Path) -> None:
    for name, lines in (("core/long.py", 60), ("core/short.py", 59), ("core/tested.py", 60), ("core/__init__.py", 99)):
        path = tmp_path / "package" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("pass\n" * lines)
    (tmp_path / "tests" / "core").mkdir(parents=True)
    (tmp_path / "tests" / "core" / "test_tested.py").touch()
    (tmp_path / "tests" / "test_long.py").touch()  # not beside it
    assert without_a_test(tmp_path / "package", tmp_path / "tests") == ["core/long.py"]


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
