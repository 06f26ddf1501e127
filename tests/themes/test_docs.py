"""The pages of docs/ build without warnings and without network access; their code runs, and their claims hold."""

import inspect
import re
import subprocess
import sys
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path

import pytest
import skimage.data
import torch
from PIL import Image

import nlfilter_torch
from benchmarks import accuracy
from docs import clients, guide_pictures
from nlfilter_torch import photo
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.presets import PRESETS, PURPOSES
from tests.pages import DOCS, ROOT, Page

CLIENTS = (
    "onnxruntime",
    "onnxscript",
    "pytorch_lightning",
    "huggingface_hub",
)  # imported by the page of that name, and not part of every installation
PAGES = {page.path.stem: page for page in DOCS}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, containing the photograph that the pages use."""
    Image.fromarray(skimage.data.coffee()[::4, ::4]).save(tmp_path / "photo.jpg")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_there_are_pages() -> None:
    assert {"index", "presets", "choosing", "how-it-works", "training", "paper"} <= PAGES.keys()


# Warnings of torch itself, and advice of Lightning.
@pytest.mark.filterwarnings("ignore:`isinstance.treespec, LeafSpec.` is deprecated:FutureWarning")
@pytest.mark.filterwarnings("ignore:The 'train_dataloader' does not have many workers")
@pytest.mark.filterwarnings("ignore:The number of training batches")
@pytest.mark.parametrize("page", DOCS, ids=lambda page: page.path.stem)
def test_code_and_commands_run(page: Page, folder: Path) -> None:
    for name in {"clients": CLIENTS, "points": ("nilearn", "sklearn")}.get(page.path.stem, ()):
        pytest.importorskip(name)
    assert {kind for kind, _ in page.blocks()} <= {"python", "sh", "text", "{toctree}"}
    with torch.random.fork_rng():
        torch.manual_seed(0)
        page.run_python(without="import deepinv")  # which tests/themes/clients/test_deepinv.py runs
    for arguments in page.commands("nlfilter-torch"):
        assert main(arguments) == 0


def test_training_begins_with_a_path_for_newcomers() -> None:
    """From installation to a trained layer in 20 lines, which :func:`test_code_and_commands_run` runs."""
    (shell, install), (language, code), *_ = PAGES["training"].blocks()
    assert (shell, language) == ("sh", "python")
    assert install.startswith("pip install")
    lines = [line for line in (install + code).splitlines() if line.strip()]
    assert len(lines) <= 20
    assert "optimizer.step()" in code
    assert PAGES["training"].text.index(install) < 200


@pytest.mark.parametrize("page", DOCS, ids=lambda page: page.path.stem)
def test_links_modules_and_targets_are_there(page: Page) -> None:
    for target in page.targets():
        assert target.startswith("https://") or (page.path.parent / target).exists(), target
    for module in re.findall(r"python -m ([\w.]+)", page.text):
        assert find_spec(module), module
    for target in re.findall(r"`make ([\w-]+)`", page.text):
        assert subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, check=False).returncode == 0


class Loaded(HTMLParser):
    """Addresses that a page loads when it is opened."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        wanted = {"script": "src", "img": "src", "link": "href", "iframe": "src"}.get(tag)
        self.addresses += [value for name, value in attributes if name == wanted and value]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "-d", str(out / "trees")]
    done = subprocess.run([*build, "docs", str(out / "html")], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return out / "html"


def test_the_site_loads_nothing_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > len(DOCS)
    for page in pages:
        loaded = Loaded()
        loaded.feed(page.read_text(encoding="utf-8"))
        assert loaded.addresses
        for address in loaded.addresses:
            assert "//" not in address, (page, address)
            if not address.startswith("data:"):
                assert (page.parent / address.split("?")[0].split("#")[0]).exists(), (page.name, address)


def test_the_reference_has_every_public_name(site: Path) -> None:
    """Each name is on the page of its topic, to which the first page of the reference links."""
    first = (site / "reference.html").read_text(encoding="utf-8")
    pages = {page.stem: page.read_text(encoding="utf-8") for page in (site / "reference").glob("*.html")}
    assert not set(photo.__all__) & set(nlfilter_torch.__all__)
    for name in {*nlfilter_torch.__all__, *photo.__all__}:
        full = f"nlfilter_torch.photo.{name}" if name in photo.__all__ else f"nlfilter_torch.{name}"
        topics = [topic for topic, text in pages.items() if f'id="{full}"' in text]
        assert len(topics) == 1, name
        assert f'href="reference/{topics[0]}.html#{full}"' in first, name


def test_the_start_page_leads_to_every_page(site: Path) -> None:
    start = (site / "index.html").read_text(encoding="utf-8")
    for name in [*PAGES, "reference"]:
        assert f'href="{name}.html' in start or name == "index", name


def test_pictures_are_small() -> None:
    pictures = [*(ROOT / "docs").rglob("*.png"), *(ROOT / "docs").rglob("*.jpg")]
    assert {path.stem for path in pictures} >= guide_pictures.PICTURES.keys()
    for picture in pictures:
        assert picture.stat().st_size < 600_000, picture


# --- claims of the pages


def test_every_equation_and_figure_of_the_paper_has_a_line() -> None:
    equations, _, figures = PAGES["paper"].text.split("\n## ")[1:]
    rows = re.findall(r"^\| \((\d+)\) \|.*\|(.*)\|$", equations, flags=re.MULTILINE)
    assert [int(number) for number, _ in rows] == list(range(1, 21))
    shown = [
        number for row in re.findall(r"^\| ([\d, ]+) \|", figures, flags=re.MULTILINE) for number in row.split(",")
    ]
    assert sorted(int(number) for number in shown) == list(range(1, 21))
    assert "| Table I |" in figures
    from docs.figures import FIGURES

    for names in re.findall(r"--only ([\w,-]+)`", figures):
        assert set(names.split(",")) <= FIGURES.keys(), names


def test_the_tables_of_the_start_page_hold_public_names() -> None:
    parts = PAGES["index"].text.split("\nIn `")[1:]
    packages = {"nlfilter_torch": nlfilter_torch, "nlfilter_torch.photo": photo}
    assert [part.split("`")[0] for part in parts] == list(packages)
    for part, package in zip(parts, packages.values(), strict=True):
        rows = [line for line in part.splitlines() if line.startswith("| `")]
        names = re.findall(r"`(\w+)`", "".join(row.split("|")[1] for row in rows))
        assert len(names) > 10
        for name in names:
            assert name in package.__all__, name


def test_names_on_the_page_of_the_paper_exist() -> None:
    classes = [getattr(nlfilter_torch, name) for name in ("NonlocalOperator", "Spectrum")]
    known = {
        *nlfilter_torch.__all__,
        *photo.__all__,
        *(name for c in classes for name in dir(c)),
        "plot_response",
        "show_layers",
    }
    for function in (nlfilter_torch.nonlocal_operator, nlfilter_torch.polynomial_filter):
        known.update(inspect.signature(function).parameters)
    for name in re.findall(r"`(?:\w+\.)?([A-Za-z]\w+)`", PAGES["paper"].text):
        assert name in known, name


def test_the_table_of_presets_is_theirs() -> None:
    rows = re.findall(r"^\| ([a-z ]+) \| ([\d., ]+) \| (\w+) \| (.*) \|$", PAGES["presets"].text, flags=re.MULTILINE)
    assert [name for name, *_ in rows] == list(PRESETS)
    for name, sliders, bandwidth, purpose in rows:
        step = PRESETS[name].steps[0]
        assert tuple(map(float, sliders.split(","))) == step["alpha"]
        assert bandwidth == (step["bandwidth"] if isinstance(step["bandwidth"], str) else f"{step['bandwidth']:g}")
        assert purpose == PURPOSES[name]


def test_the_table_of_clients_is_made_from_their_tests() -> None:
    assert f"\n\n{clients.table()}\n" in PAGES["clients"].text
    assert len(clients.table().splitlines()) > 15


def test_every_claim_about_training_has_its_test() -> None:
    table = PAGES["training"].text.split("| test |\n|---|---|---|\n")[1].split("\n\n")[0]
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    for row in table.splitlines():
        tests = re.findall(r"`(test_\w+)`", row.split("|")[3])
        assert tests, row
        for name in tests:
            assert f"\ndef {name}(" in sources, name


@pytest.mark.slow
def test_the_table_of_errors_is_what_the_benchmark_prints() -> None:
    pattern = r"^\| (\w+) \| (\d+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$"
    rows = re.findall(pattern, PAGES["how-it-works"].text, flags=re.MULTILINE)
    assert [(name, int(h)) for name, h, *_ in rows] == [(p, h) for p in accuracy.PICTURES for h in accuracy.LIMITS]
    for name, bandwidth, *printed in rows:
        if (name, bandwidth) == ("chelsea", "20"):
            measured = accuracy.measure(name, int(bandwidth))
            for text, value in zip(printed, (measured.paper, measured.uniform, measured.default), strict=True):
                assert abs(float(text) - value) <= 0.02, (name, bandwidth)


@pytest.mark.slow
def test_numbers_on_the_page_about_choosing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    guide_pictures.main([str(tmp_path), "--only", "bandwidth"])
    printed = capsys.readouterr().out
    assert "bandwidth 4.0: beta 0.8296" in printed
    assert "bandwidth 16.8: beta 0.9996" in printed
    assert [path.name for path in tmp_path.iterdir()] == ["bandwidth.jpg"]


def test_an_unknown_picture_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        guide_pictures.main(["--only", "bandwith"])
    assert "--only must name pictures among presets-portrait" in capsys.readouterr().err
