"""Colour tables of other programs as looks, and looks as colour tables."""

from pathlib import Path

import hypothesis
import hypothesis.strategies as some
import imagecodecs
import numpy as np
import pytest
import torch

from nlfilter_torch.photo.declared.colour_tables import cube_of, hald_of, lattice_of_cube, lattice_of_hald, table_rows
from nlfilter_torch.photo.declared.presets import Recipe, find_recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from tests.looks import CAT
from tests.pairwise import each_value

HEAD = "LUT_3D_SIZE 2\n"
ROWS = "0 0 0\n1 0 0\n0 1 0\n1 1 0\n0 0 1\n1 0 1\n0 1 1\n1 1 1\n"


def test_red_changes_first() -> None:
    swapped = HEAD + "".join(f"{row[4]} {row[2]} {row[0]}\n" for row in ROWS.splitlines())  # red and blue
    result = apply_step(Step("look", lattice=lattice_of_cube(swapped, "it")), CAT)
    torch.testing.assert_close(result, CAT.flip(1), atol=1e-6, rtol=0)


def test_comments_titles_and_ranges_from_zero_to_one_are_read() -> None:
    text = f'# by hand\nTITLE "a b"\n\n{HEAD}DOMAIN_MIN 0 0 0\nDOMAIN_MAX 1.0 1 1\nLUT_3D_INPUT_RANGE 0.0 1.0\n'
    step = Step("look", lattice=lattice_of_cube(text + ROWS.replace("1 1 1\n", "1 1 1 # white\n"), "it"))
    torch.testing.assert_close(apply_step(step, CAT), CAT, atol=1e-6, rtol=0)
    assert step["lattice"] == (0.0,) * 24


WRONG_TABLES = [
    (ROWS, "it must have a line LUT_3D_SIZE, got none; export"),
    (HEAD + ROWS + "0 0 0\n", r"it must hold 2\^3 = 8 colours, got 9; export it again"),
    (HEAD + "0 0 0\n", r"it must hold 2\^3 = 8 colours, got 1; export it again"),
    ("LUT_1D_SIZE 4\n" + HEAD + ROWS, r"it must hold 4 \+ 2\^3 colours, got 8; export it again"),
    ("LUT_1D_SIZE 1\n", "LUT_1D_SIZE of it must be a whole number from 2 to 65536, got 1; export"),
    ("LUT_3D_SIZE 2.5\n", "LUT_3D_SIZE of it must be a whole number from 2 to 65, got 2.5; export"),
    (f"DOMAIN_MAX 1 0 1\n{HEAD}{ROWS}", r"it must be for colours from a least .*, got .* to \[1.0, 0.0, 1.0\]; export"),
    (f"LUT_3D_INPUT_RANGE 2 2\n{HEAD}{ROWS}", "it must be for colours from a least to a greater one, got .*; export"),
    (f"LUT_3D_INPUT_RANGE 2\n{HEAD}{ROWS}", "LUT_3D_INPUT_RANGE of it must hold 2 numbers, got 2; export"),
    (f"DOMAIN_MIN 0\n{HEAD}{ROWS}", "DOMAIN_MIN of it must hold 3 numbers, got 0; export"),
    ("LUT_3D_SIZE 200\n", "LUT_3D_SIZE of it must be a whole number from 2 to 65, got 200; export"),
    ("LUT_3D_SIZE x\n", "LUT_3D_SIZE of it must be a whole number from 2 to 65, got x; export"),
    (HEAD + ROWS.replace("1 1 1", "1 1"), "line 9 of it must hold 3 numbers, got 1 1; export"),
    (HEAD + ROWS.replace("1 1 1", "1 nan 1"), "line 9 of it must hold 3 numbers, got 1 nan 1; export"),
    (HEAD + ROWS.replace("1 1 1", "nan 1 1"), "line 9 of it must hold 3 numbers, got nan 1 1; export"),
    (HEAD + ROWS.replace("1 1 1", "1_0 1 1"), "line 9 of it must hold 3 numbers, got 1_0 1 1; export"),
    (HEAD + ROWS.replace(" ", ","), "line 2 of it must hold 3 numbers, got 0,0,0; export"),
    ("\0\1\n", r"line 1 of it must hold 3 numbers, got \?\?; export"),
    ("LUT_IN_VIDEO_RANGE\n", "it must be a table for colours of full range, got a line LUT_IN_VIDEO_RANGE; export"),
    ("hello\n", "it must have a line LUT_3D_SIZE, got none; export"),
    ("", "it must have a line LUT_3D_SIZE, got none; export"),
]


def test_other_tables_are_refused_in_a_sentence() -> None:
    for text, message in WRONG_TABLES:
        with pytest.raises(ValueError, match=message) as error:
            lattice_of_cube(text, "it")
        assert "\n" not in str(error.value)


def colours_after(text: str, colours: torch.Tensor) -> torch.Tensor:
    """Colours (n, 3) after a table."""
    step = Step("look", lattice=lattice_of_cube(text, "it"))
    return apply_step(step, colours.T[None, :, None])[0, :, 0].T


SAMPLES = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))


def squares(size: int, least: float = 0, most: float = 1) -> str:
    """Rows of a table of squares for colours in a range."""
    nodes = np.linspace(least, most, size) ** 2
    return "".join(f"{r:.8f} {g:.8f} {b:.8f}\n" for b in nodes for g in nodes for r in nodes)


@pytest.mark.parametrize("domain", ["DOMAIN_MIN -1 -1 -1\nDOMAIN_MAX 3 3 3\n", "LUT_3D_INPUT_RANGE -1 3\n"])
def test_tables_for_other_ranges_of_colours(domain: str) -> None:
    """Nodes are 1/4 apart, where a square differs from chords by a quarter of the squared distance."""
    result = colours_after(f"LUT_3D_SIZE 17\n{domain}{squares(17, -1, 3)}", SAMPLES)
    torch.testing.assert_close(result, SAMPLES**2, atol=1 / 4**2 / 4 + 1e-5, rtol=0)
    nodes = torch.linspace(0, 1, 5)[:, None].expand(5, 3)
    exact = colours_after(f"LUT_3D_SIZE 17\n{domain}{squares(17, -1, 3)}", nodes)
    torch.testing.assert_close(exact, nodes**2, atol=1e-5, rtol=0)
    narrow = colours_after(f"{HEAD}DOMAIN_MAX 0.5 0.5 0.5\n{ROWS}", SAMPLES)  # twice as bright, and clipped
    inside = (SAMPLES - 0.5).abs() > 1 / 64
    torch.testing.assert_close(narrow[inside], (2 * SAMPLES).clamp(max=1)[inside], atol=1e-5, rtol=0)


def test_curves_come_before_colours_and_may_come_alone() -> None:
    """A curve over -1 to 3 that doubles, then a table over 0 to 2 that swaps red and blue and halves."""
    curve = "".join(f"{value} {value} {value}\n" for value in np.linspace(-2, 6, 9))
    table = HEAD + "LUT_3D_INPUT_RANGE 0 2\n"
    swapped = "".join(f"{row[4]} {row[2]} {row[0]}\n" for row in ROWS.splitlines())
    head = "LUT_1D_SIZE 9\nLUT_1D_INPUT_RANGE -1 3\n"
    torch.testing.assert_close(
        colours_after(head + table + curve + swapped, SAMPLES), SAMPLES.flip(1), atol=1e-5, rtol=0
    )
    halved = head + curve.replace("2.0", "1.0")  # at a colour of 1
    torch.testing.assert_close(colours_after(halved, SAMPLES / 2), SAMPLES.clamp(max=1), atol=1e-5, rtol=0)


LOOSE = [
    "LUT_1D_INPUT_RANGE 0 1\n",
    'TITLE "a\x0cb\u2028c\u2029d\x85e"\n',
    "// by a program\n",
    "# https://example.org/a\n",
    "VENDOR_KEYWORD 1 2\n",
    "\x0c\n",
    "\n",
]


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(
    between=some.lists(some.tuples(some.integers(0, 9), some.sampled_from(LOOSE)), max_size=4),
    end=some.sampled_from(["", "\x1a", "\0\0\0", "\n\x1a\0", " "]),
    size=some.sampled_from(["2", "2.0", "2."]),
    ending=some.sampled_from(["\n", "\r\n", "\r"]),
    numbers=some.lists(some.integers(0, 1000), min_size=24, max_size=24),
)
def test_what_programs_add_to_a_table_changes_nothing(
    between: list[tuple[int, str]], end: str, size: str, ending: str, numbers: list[int]
) -> None:
    rows = [" ".join(str(value / 1000) for value in numbers[3 * i : 3 * i + 3]) + "\n" for i in range(8)]
    lines = [f"LUT_3D_SIZE {size}\n", *rows]
    wanted = lattice_of_cube("".join([HEAD, *rows]), "it")
    for place, line in between:
        lines.insert(place, line)
    assert lattice_of_cube("".join(lines).replace("\n", ending) + end, "it") == wanted


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_halds_of_all_depths(dtype: str) -> None:
    levels = {"uint8": 255, "uint16": 65535}.get(dtype, 1)
    colours = np.stack(np.meshgrid(*[np.arange(16) / 15] * 3, indexing="ij"))
    picture = table_rows(1 - colours).reshape(64, 64, 3) * levels
    stored = (np.rint(picture) if levels > 1 else picture).astype(dtype)
    step = Step("look", lattice=lattice_of_hald(stored, "it"))
    torch.testing.assert_close(apply_step(step, CAT), 1 - CAT, atol=1e-5 if levels != 255 else 1e-3, rtol=0)


NO_HALDS = [
    ((64, 65, 3), "must be a Hald, a square picture in colour of 8, 27, 64, .* got 65x64; edit"),
    ((63, 63, 3), "must be a Hald"),
    ((64, 64, 1), "must be a Hald"),
    ((1, 1, 3), "must be a Hald"),
    ((729, 729, 3), "must be a Hald of level 8 at most, got 9; make a smaller one"),
]


def test_pictures_that_are_no_halds_are_refused() -> None:
    for shape, message in NO_HALDS:
        with pytest.raises(ValueError, match=message):
            lattice_of_hald(np.zeros(shape, np.uint8), "it")


@pytest.mark.parametrize(
    ("encoding", "ending"), each_value(["utf-8", "utf-8-sig", "utf-16", "latin-1"], ["\n", "\r\n", "\r"])
)
def test_text_of_any_encoding_and_line_ending(encoding: str, ending: str) -> None:
    text = ('TITLE "\u00e9t\u00e9"\n' + HEAD.lower() + ROWS.replace(" ", "\t")).replace("\n", ending)
    assert Recipe.from_file(text.encode(encoding), "it.cube").steps[0]["lattice"] == (0.0,) * 24


@pytest.mark.parametrize("content", [b"BM and more", b"RIFF....WEBP", b"P6\n64 64\n255\n"])
def test_pictures_of_other_kinds_are_told(content: bytes) -> None:
    with pytest.raises(ValueError, match=r"it must be a preset, a \.cube file or a Hald, got a file of another kind"):
        Recipe.from_file(content, "it")


def test_files_are_recipes(tmp_path: Path) -> None:
    colours = np.stack(np.meshgrid(*[np.arange(16) / 15] * 3, indexing="ij"))
    table = colours**1.5
    cube, hald, grey = tmp_path / "a.CUBE", tmp_path / "b.png", tmp_path / "c.png"
    cube.write_text(cube_of(table, "a"))
    hald.write_bytes(imagecodecs.png_encode(hald_of(table)))
    grey.write_bytes(imagecodecs.png_encode(np.zeros((64, 64), np.uint8)))
    first, second = (apply_step(find_recipe(str(path)).steps[0], CAT) for path in (cube, hald))
    torch.testing.assert_close(first, second, atol=2e-5, rtol=0)
    assert float((first - CAT**1.5).abs().max()) < 0.5 / 255 * 3
    with pytest.raises(ValueError, match="must be a Hald"):
        find_recipe(str(grey))
    lossy = tmp_path / "d.jpg"
    lossy.write_bytes(imagecodecs.jpeg_encode((hald_of(table) >> 8).astype(np.uint8), level=95))
    with pytest.warns(UserWarning, match=r"d\.jpg is a Hald in a JPEG file, .*; save it as PNG") as told:
        recipes = [find_recipe(str(lossy)) for _ in range(2)]
    assert len(told) == 1
    assert 1 / 255 < float((apply_step(recipes[0].steps[0], CAT) - first).abs().mean()) < 10 / 255
    with pytest.raises(ValueError, match="must be a Hald, got a picture that cannot be read"):
        Recipe.from_file(b"\x89PNG and nothing", "it.png")
