"""Public names of both packages are those of their stubs."""

import ast
import pydoc
from pathlib import Path
from types import ModuleType

import pytest

import nlfilter_torch
import nlfilter_torch.photo


@pytest.mark.parametrize("package", [nlfilter_torch, nlfilter_torch.photo], ids=lambda package: package.__name__)
def test_public_names_are_those_of_the_stub(package: ModuleType) -> None:
    stub = ast.parse(Path(package.__file__ or "").with_suffix(".pyi").read_text())
    names = {
        alias.name for statement in stub.body if isinstance(statement, ast.ImportFrom) for alias in statement.names
    }
    assert set(package.__all__) == names <= set(dir(package))
    for name in names:
        assert name == "PRESETS" or getattr(package, name).__name__ == name
    with pytest.raises(AttributeError, match="sharpenn"):
        _ = package.sharpenn


@pytest.mark.parametrize("package", [nlfilter_torch, nlfilter_torch.photo], ids=lambda package: package.__name__)
def test_pydoc_shows_every_public_name(package: ModuleType) -> None:
    for name in set(package.__all__) - {"PRESETS"}:
        text = pydoc.render_doc(f"{package.__name__}.{name}", renderer=pydoc.plaintext)
        documented = getattr(package, name).__doc__
        assert documented, f"{name} has no docstring"
        assert documented.splitlines()[0] in text


def test_names_of_the_application_are_not_at_the_root() -> None:
    assert not set(nlfilter_torch.__all__) & set(nlfilter_torch.photo.__all__)
