"""Edits that answer for themselves: settings, channels, notes, scribbles and the options of their filters."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import EDIT_OF, edit_of
from nlfilter_torch.photo.edits.tone import Tone
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit, Rows
from nlfilter_torch.photo.picture.in_memory import InMemory
from tests.problems import box, colour, noise

SIZE = (20, 30)


def rows_of(image: Tensor) -> Rows:
    return Rows("in.png", (image.shape[2], image.shape[3]), image.shape[1], lambda rows: image[:, :, rows])


def test_an_edit_is_made_of_the_arguments_of_its_step() -> None:
    step = Step("tone", clarity=2.0, landmarks=30)
    edit = Tone.of(step.arguments(SIZE))
    assert isinstance(edit, Tone)
    assert (edit.clarity, edit.contrast, edit.options.num_landmarks, edit.order) == (2.0, 1.2, 30, 3)
    assert edit.declared is step.declared
    detail = edit_of(Step("detail", alpha=(2.0, 1.0)), SIZE)
    assert torch.equal(vars(detail)["alpha"], torch.tensor([2.0, 1.0]))


def test_only_recolouring_needs_a_photograph_in_colour() -> None:
    for name in EDIT_OF:
        edit = edit_of(Step(name), SIZE)
        edit.check_channels(3)
        if name == "recolor":
            with pytest.raises(ValueError, match="recolor needs a colour photograph, got a grey one"):
                edit.check_channels(1)
        else:
            edit.check_channels(1)


def test_only_colouring_notes_that_a_photograph_is_in_colour() -> None:
    image = colour("coffee", 40, 60)
    grey = image[:, :1].expand(-1, 3, -1, -1)
    for name in ("denoise", "detail", "tone", "recolor", "defocus", "abstract"):
        assert list(edit_of(Step(name), SIZE).notes(rows_of(image))) == []
    (note,) = edit_of(Step("colorize"), SIZE).notes(rows_of(image))
    assert note.startswith("in.png is in colour: colorize replaces its colours everywhere")
    assert list(edit_of(Step("colorize"), SIZE).notes(rows_of(grey))) == []


def test_scribbles_are_marks_of_the_selection_by_their_role() -> None:
    inside, outside = box(2, 2, size=SIZE), box(10, 20, size=SIZE)
    for name, arguments in (
        ("detail", ("regions", "negative")),
        ("recolor", ("stroke_mask", "keep")),
        ("defocus", ("focus_region", "background")),
    ):
        edit = edit_of(Step(name), SIZE)
        marks = edit.marks(Drawn(dict(zip(arguments, (inside, outside), strict=True))))
        assert marks.masks == {"scribbles": inside, "background": outside}
        assert edit.marks(Drawn({arguments[0]: inside})).masks == {"scribbles": inside}
        selection = edit.selection()
        assert selection is not None
        assert selection.declared.name == "mask"
    assert edit_of(Step("tone"), SIZE).marks(Drawn()).masks == {}
    assert edit_of(Step("tone"), SIZE).selection() is None


def test_a_command_prints_how_much_pixels_changed() -> None:
    edit = edit_of(Step("tone"), SIZE)
    assert edit.summary(1.234) == "pixels changed by 1.23 grey levels (RMS)"
    assert [name for name, kind in EDIT_OF.items() if kind.reports_change] == ["denoise"]


def test_only_declared_maps_are_drawn() -> None:
    image = noise(1, 1, *SIZE, dtype=torch.float32)
    with pytest.raises(NotImplementedError, match="tone draws no map"):
        edit_of(Step("tone"), SIZE).map_of(image)
    assert [name for name, kind in EDIT_OF.items() if kind.map_of is not PhotoEdit.map_of] == [
        name for name, kind in EDIT_OF.items() if kind.declared.map_help
    ]


def test_only_declared_errors_are_estimated() -> None:
    with pytest.raises(NotImplementedError, match="tone estimates no errors"):
        edit_of(Step("tone"), SIZE).standard_error(noise(1, 1, *SIZE), None)
    assert [name for name, kind in EDIT_OF.items() if kind.standard_error is not PhotoEdit.standard_error] == [
        name for name, kind in EDIT_OF.items() if kind.declared.error_help
    ]


def test_the_noise_of_a_picture_is_measured_once() -> None:
    image = colour("coffee", 60, 80) + 0.05 * torch.randn(1, 3, 60, 80, generator=torch.Generator().manual_seed(0))
    source = InMemory(image)
    edit = edit_of(Step("denoise"), source.size)
    measured = edit.measured(source)
    assert measured is not edit
    assert measured.measured(source) is measured
    assert "denoise: estimated noise of" in measured.summary(8.0)
    tone = edit_of(Step("tone"), source.size)
    assert tone.measured(source) is tone


class Filtered(PhotoEdit):
    """An edit with a filter, for its options."""

    declared = Edit("example", "", tuple(EDIT_OF["tone"].declared))

    def fit(self, source: object, drawn: object) -> object:
        raise NotImplementedError


def test_options_of_the_filter_fit_the_picture() -> None:
    edit = Filtered(options=FilterOptions(patch_size=3))
    options = edit.filter_options((24, 36))
    assert (options.photometric_bandwidth, options.spatial_bandwidth) == ("auto", 2.0)  # a twelfth of the short side
    assert (options.patch_size, options.num_landmarks, options.guide_channels) == (3, 100, "luminance")
    assert edit.filter_options((5, 6)).num_landmarks == 100
    assert edit.filter_options((5, 6), fewer_landmarks=True).num_landmarks == 30
    assert edit.filter_options((24, 36), fewer_landmarks=True).num_landmarks == 100
    far = Filtered(options=FilterOptions(spatial_bandwidth="none"))
    assert far.filter_options((24, 36)).spatial_bandwidth is None
