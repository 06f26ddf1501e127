"""Writes the parameters of all edits as a page of the documentation, and counts where each is declared.

    python -m docs.parameters docs/parameters.md

Without a file only the declarations are printed; the exit status is 1 if a parameter is declared more than once.
"""

import argparse
import ast
from functools import cache
from pathlib import Path

import nlfilter_torch
from nlfilter_torch.photo.declared.declaration import UNIT_NAMES, Edit, Parameter
from nlfilter_torch.photo.declared.development import DEVELOP
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.shared_parameters import FILTER_ARGUMENTS

PACKAGE = Path(nlfilter_torch.__file__).parent
INTERFACES = ("cli", "app")  # folders whose files could declare parameters of any edit
FILES = (
    "photo/declared/presets.py",
    "photo/declared/steps.py",
    "photo/edits/applying.py",
    "photo/edits/recipe.py",
)
HEAD = """# Parameters

Every edit's parameters, with the names, units, ranges and defaults that its command, files for `apply` and the editor
share. An option is the name with dashes. Functions take images in [0, 1]: there, grey levels are divided by 255, units
of CIE Lab by 100, and hundredths of the short side are pixels. This page is made by
`python -m docs.parameters docs/parameters.md`.
"""


def page() -> str:
    """The text of the page."""
    return HEAD + "".join(f"\n## {edit.name}\n\n{table(edit)}" for edit in (DEVELOP, *EDITS.values()))


def table(edit: Edit) -> str:
    """A table with one row per parameter of an edit."""
    head = "| name | default | range | unit | in Python | what it does |\n|---|---|---|---|---|---|\n"
    return head + "".join(f"| {' | '.join(cells(edit, parameter))} |\n" for parameter in edit)


def cells(edit: Edit, parameter: Parameter) -> tuple[str, ...]:
    """The cells of a parameter's row."""
    value = parameter.default
    if value is None and parameter.share:
        shown = f"{100 * parameter.share:g} % of the short side"
    elif value is None:
        shown = ""
    else:
        shown = ", ".join(f"{slider:g}" for slider in value) if isinstance(value, tuple) else f"{value}"
    each = f"{parameter.low:g} to {parameter.high:g}, each"
    spans = {"choice": ", ".join(parameter.choices), "sliders": each, "lattice": each}
    span = spans.get(parameter.kind, f"{parameter.low:g} to {parameter.high:g}")
    unit = UNIT_NAMES[parameter.unit][0] or {"gain": "times"}.get(parameter.unit, "")
    words = " or ".join(parameter.words)
    name = f"`{parameter.keyword}`" if parameter.is_argument else "`alpha` of a region"
    return f"`{parameter.name}`", shown, f"{span}{', or ' + words if words else ''}", unit, name, parameter.help


def places(edit: Edit, parameter: Parameter) -> list[str]:
    """Find the declarations of a parameter of an edit that have literal values: ``file:line`` of each."""
    names = {parameter.name, parameter.keyword}
    lines = []
    for path in sorted(PACKAGE.rglob("*.py")):
        file = path.relative_to(PACKAGE).as_posix()
        own = file in FILES or path.stem == edit.name or path.parent.name in INTERFACES
        if path.stem.endswith("parameters") and path.parent.name == "declared":
            scopes = [
                n for n in parsed(path).body if isinstance(n, ast.Assign) and named(n.targets[0]) in used(edit.name)
            ]
            nodes = [node for scope in scopes for node in ast.walk(scope)]
            lines += [f"{file}:{n.lineno}" for n in nodes if declares(n, parameter.name)]
        elif own:
            lines += [f"{file}:{line}" for line, name in written_in(path) if name in names]
    return lines


@cache
def parsed(path: Path) -> ast.Module:
    """The syntax tree of a file of the package."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def written_in(path: Path) -> list[tuple[int, str]]:
    """:func:`literals` of a file of the package."""
    return literals(parsed(path))


@cache
def used(edit: str) -> set[str]:
    """Names used in the declaration of an edit, including its own."""
    bodies = [parsed(path).body for path in (PACKAGE / "photo" / "declared").glob("*parameters.py")]
    assigned = [node for body in bodies for node in body if isinstance(node, ast.Assign)]
    scope = next(node for node in assigned if named(node.targets[0]) == edit.upper())
    return {edit.upper()} | {node.id for node in ast.walk(scope.value) if isinstance(node, ast.Name)}


def named(node: ast.expr) -> str:
    """The identifier of a name node, or an empty string for other nodes."""
    return node.id if isinstance(node, ast.Name) else ""


def declares(node: ast.AST, name: str) -> bool:
    """Whether a node is ``Parameter("name", ...)``, or a call of a function that creates a parameter."""
    return (
        isinstance(node, ast.Call)
        and named(node.func) in ("Parameter", "_curve", "number", "gain", "sliders", "choice", "part")
        and isinstance(node.args[0], ast.Constant)
        and node.args[0].value == name
    )


def literals(tree: ast.Module) -> list[tuple[int, str]]:
    """Lines and names of arguments and fields whose default is a literal other than None."""
    fields = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            positional = node.args.args[len(node.args.args) - len(node.args.defaults) :]
            pairs = [*zip(positional, node.args.defaults, strict=True)]
            pairs += [(a, d) for a, d in zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True) if d is not None]
            fields += [(default.lineno, argument.arg) for argument, default in pairs if written_out(default)]
        elif isinstance(node, ast.AnnAssign) and node.value is not None and written_out(node.value):
            fields.append((node.lineno, named(node.target)))
    return fields


def written_out(node: ast.expr) -> bool:
    """Whether a value consists of literals only, and is not None."""
    constants = [n for n in ast.walk(node) if isinstance(n, ast.Constant)]
    others = [n for n in ast.walk(node) if isinstance(n, ast.Name | ast.Attribute | ast.Subscript | ast.Call)]
    return bool(constants) and not others and any(n.value is not None for n in constants)


def main(arguments: list[str] | None = None) -> int:
    """Print the declarations, write the page, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?", type=Path, help="page to write")
    file = parser.parse_args(arguments).file
    worst = 0
    for edit in EDITS.values():
        for parameter in edit:
            if parameter.keyword in FILTER_ARGUMENTS and parameter.name != "tolerance":
                continue  # declared once for all edits, in filter_parameters, with the edit's defaults
            where = places(edit, parameter)
            worst = max(worst, len(where))
            print(f"{edit.name} {parameter.name}: {len(where)} ({', '.join(where)})")
    if file is not None:
        file.write_text(page(), encoding="utf-8")
    return int(worst != 1)


if __name__ == "__main__":
    raise SystemExit(main())
