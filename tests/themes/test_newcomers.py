"""Command lines as newcomers type them: each works, or is answered by one sentence with the remedy."""

import shlex
from pathlib import Path

import pytest
import skimage.data
import torch

from nlfilter_torch.photo.app.command import app
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph

WORKING = """\
-h
detail -h
presets list
apply in.png vivid.png vivid
apply in.png crisp.png soft-skin
apply in.png film.png film.cube
recolor in.png blue.png --from brown --to blue
recolor in.png blue.png --from '#a06d3b' --colour blue --extent object
detail in.png small.webp --quality 80
detail in.png small.avif --quality 80
detail in.png more.jpeg --landmarks 20
develop in.png light.png --exposure +1
develop in.png crop.png --crop 10,10,20,20
develop in.png crop.png --crop 10%,10%,80%,80%
develop in.png turned.png --rotate 90 --crop 0,40,30,30
develop in.png warm.png --temperature 5500
develop in.png balanced.png --temperature auto
develop in.png strong.png --saturation 0.2
heal in.png spotless.png --region 20,20,6,6
light in.png darker.png --exposure -1 --linear 0,0,0,50%
recolor in.png blue.png --radial 30%,30%,20%,20%,100%:blue
mask in.png mask.png --region 20,20
mask in.png mask.png --region 50%,50% --cutout alone.png
"""
#: Command lines, and a part of the sentence.
ANSWERED = {
    "detail in.png out.png --preset vivd": "did you mean vivid?",
    "batch . out --preset crsip": "did you mean crisp?",
    "presets vivd": "did you mean vivid?",
    "look in.png out.png vivid": "nlfilter-torch apply IN OUT vivid applies it",
    "look in.png out.png --preset vivid": "nlfilter-torch apply IN OUT NAME takes presets",
    "vivid in.png out.png": "here it is nlfilter-torch apply IN OUT vivid",
    "apply in.png out.png": "nlfilter-torch presets lists the names",
    "apply in.png out.png vivd": "did you mean vivid?",
    "recolor in.png out.png --from red": "--from red must come with --colour, such as --colour red, got none; add it",
    "recolor in.png out.png --from lime --to blue": "must be a colour of the photograph, which has none like it",
    "recolor in.png out.png --from ruby --to blue": "must end in a colour, such as red",
    "recolor in.png out.png --color blue": "--region X,Y,W,H:COLOUR",
    "recolor in.png out.png --region 20,20:blu": "must end in a colour",
    "colorize in.png out.png": "--region 40,60,20,20:red",
    "colorize in.png out.png --auto": "regions are marked by hand",
    "sharpen in.png out.png --radius 2": "here it is --amount",
    "sharpen in.png out.png --amount 150%": "--amount must be a number, got '150%' (strength: 1 leaves",
    "sharpen in.png out.png --strength high": "here it is --amount (strength: 1 leaves the photograph unchanged",
    "detail in.png out.png --sharpness 2": "nlfilter-torch sharpen IN OUT",
    "denoise in.png out.png --strength 50%": "--strength must be a number",
    "denoise in.png out.png --noise-level auto": "--noise-level must be a number",
    "develop in.png out.png --exposure 1 --linear 0,0,0,9": "nlfilter-torch light changes a part of a photograph",
    "light in.png out.png --exposure 1": "give --linear X,Y,X,Y, --radial X,Y,W,H, --region X,Y,W,H",
    "light in.png out.png --exposure 1 --gradient 0,0,9,9": "here it is --linear or --radial",
    "light in.png out.png --linear 5,5,5,5": "--linear must be X,Y,X,Y, two different points",
    "vignette in.png out.png": "here it is nlfilter-torch light",
    "detail in.png out.png --landmarks many": "--landmarks must be an integer",
    "tone in.png out.png --contrast 20%": "(contrast of the smooth shading: 1 leaves it unchanged",
    "develop in.png out.png --exposure 1EV": "(brightness in stops: 1 doubles the light",
    "develop in.png out.png --white-balance auto": "here it is --temperature (white balance in kelvin",
    "develop in.png out.png --kelvin 5500": "here it is --temperature",
    "develop in.png out.png --rotate 45": "see straighten for others",
    "develop in.png out.png --temperature 0.2": "--temperature must be",
    "develop in.png out.png --ev 0.5": "here it is --exposure",
    "develop in.png out.png --crop 0.1,0.1,0.9,0.9": "such as 10%,0%,80%,100%",
    "develop in.png out.png --aspect 16/9": "such as 3:2",
    "defocus in.png out.png --subject 20,20,9,9": "here it is --region or --box",
    "recolor in.png out.png --cutout a.png": "nlfilter-torch mask IN OUT --region X,Y,W,H --cutout FILE",
    "mask in.png out.png --region 20,20 --extent objects": "did you mean object?",
    "mask in.png out.png --subject": "here it is --region or --box",
    "mask in.png out.png": "--region",
    "bw in.png out.png": "here it is nlfilter-torch apply IN OUT mono",
    "resize in.png out.png --width 500": "photographs keep their size",
    "detail in.png out.png --width 500": "photographs keep their size",
    "enhance in.png out.png": "here it is nlfilter-torch detail IN OUT --preset crisp",
    "shapen in.png out.png": "did you mean sharpen?",
    "rotate in.png out.png": "here it is nlfilter-torch develop IN OUT",
    "help": "nlfilter-torch COMMAND --help explains one",
    "version": "nlfilter-torch --version",
    "-V": "nlfilter-torch --version",
    "detail https://example.org/a.jpg out.png": "https://example.org/a.jpg is an address, not a file; download it",
    "detail gone.png out.png": "check the name and the folder",
    "detail in.png in.png": "choose another name",
    "detail in.png out": "must end in .png, .jpg, .webp, .avif or .tif",
    "detail in.png out.gif": "must end in .png, .jpg, .webp, .avif or .tif",
    "detail in.png out.png --quality 80": "--quality must be used with a JPEG, WebP or AVIF file",
    "detail in.png out.png --alpha 2 2 2 1": "--alpha 2,2,2,1",
    "detail in.png out.png --alhpa 2,2,2,1": "Possible options: --alpha",
    "detail in.png light.png more.png": "nlfilter-torch batch IN_DIR OUT_DIR",
    "denoise in.png --output out.png": "the output is the second argument",
    "denoise in.png": "Missing argument 'OUT'; nlfilter-torch denoise --help",
    "in.png out.png": "the command comes first",
    "batch in.png out": "give the one that contains the photographs",
    "frames in.png out.mp4": "must be a film (.mp4, .m4v or .mov) or a folder",
    "app gone.png": "check the name and the folder",
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a photograph of a cat and a colour table."""
    monkeypatch.chdir(tmp_path)
    pixels = torch.from_numpy(skimage.data.chelsea()[::6, ::6]).movedim(-1, 0)[None] / 255
    write_photograph(Photograph(pixels), "in.png")
    corners = [f"{red} {green} {blue}" for blue in (0, 1) for green in (0, 1) for red in (0, 1)]
    (tmp_path / "film.cube").write_text("\n".join(["LUT_3D_SIZE 2", *corners]))
    return tmp_path


def test_lines_that_work(folder: Path) -> None:
    for line in WORKING.splitlines():
        arguments = shlex.split(line)
        assert main(arguments, lambda: [app]) == 0, line
        written = {"mask": "mask.png"}.get(arguments[0], arguments[2] if len(arguments) > 2 else "in.png")
        assert (folder / written).stat().st_size > 0, line


def test_lines_that_are_answered(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert len(ANSWERED) + len(WORKING.splitlines()) >= 60
    for line, part in ANSWERED.items():
        assert main(shlex.split(line), lambda: [app]) == 2, line
        told = capsys.readouterr().err
        assert part in told, (line, told)
        assert len(told.splitlines()) == 1, (line, told)
    assert sorted(path.name for path in folder.iterdir()) == ["film.cube", "in.png"]


def test_a_colour_range_marks_what_has_its_hue(folder: Path) -> None:
    colours = torch.tensor([[0.8, 0.1, 0.1], [0.1, 0.6, 0.2], [0.5, 0.5, 0.5], [0.45, 0.05, 0.08]])
    write_photograph(
        Photograph(colours.mT[None, :, None].expand(-1, -1, 20, -1).repeat_interleave(12, dim=3)), "in.png"
    )
    assert main(shlex.split("recolor in.png out.png --from red --to blue --brightness 0")) == 0
    before, after = (read_photograph(folder / name).pixels[0, :, 10, 6::12] for name in ("in.png", "out.png"))
    assert torch.equal(before[:, 1:3], after[:, 1:3])
    assert (after[2, [0, 3]] > 2 * after[0, [0, 3]]).all()
