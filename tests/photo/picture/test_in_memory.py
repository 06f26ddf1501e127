"""An image in memory as the source of an edit."""

import pytest
import torch

from nlfilter_torch.filtering.filters import detail_layers
from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit
from nlfilter_torch.photo.picture.in_memory import (
    Cache,
    InMemory,
    edit_image,
    in_blocks,
    kept_in,
    tensors_in,
    without_tensors,
)
from nlfilter_torch.photo.picture.measuring import reduced
from nlfilter_torch.photo.picture.pixels import Fitted, M, WorkingRange, whole_image
from nlfilter_torch.photo.picture.source import Guide, Source
from tests.problems import box, noise


def test_the_last_operator_with_the_same_options_is_cached() -> None:
    source = InMemory(torch.rand(1, 1, 12, 13), {})
    learned, written = torch.tensor([3.0], requires_grad=True), torch.tensor([3.0])

    def operator(*bandwidths: float | torch.Tensor) -> object:
        return source.operator(Guide(FilterOptions(spatial_bandwidth=bandwidths, num_landmarks=20)))

    def tensors(*bandwidths: float) -> object:
        return operator(*(torch.tensor([bandwidth]) for bandwidth in bandwidths))

    assert tensors(3.0, 5.0) is tensors(3.0, 5.0)
    assert tensors(3.0, 5.0) is not tensors(5.0, 3.0)
    assert operator(3.0, 5.0) is operator(3.0, 5.0)
    assert operator(written, 5.0) is not operator(written, 3.0)
    assert operator(learned, learned) is not operator(learned, learned)
    before = operator(written, written)
    written += 1
    assert operator(written, written) is not before
    assert len(source.cache or {}) == 4


def test_results_are_kept_as_long_as_what_they_depend_on() -> None:
    cache: Cache = {}
    calls: list[int] = []

    def compute() -> int:
        calls.append(len(calls))
        return calls[-1]

    first, other = torch.ones(2), torch.zeros(2)
    assert kept_in(cache, "a", [first], compute) == 0
    assert kept_in(cache, "a", [first.clone()], compute) == 0
    assert kept_in(cache, "b", [first], compute) == 1
    assert kept_in(cache, "a", [other], compute) == 2
    assert kept_in(cache, "a", [first], compute) == 3  # only the last is kept
    assert kept_in(None, "a", [first], compute) == 4


def test_tensors_are_replaced_by_their_type_in_the_name_of_an_operator() -> None:
    tensor = torch.ones(1)
    assert tensors_in((1.0, tensor)) == [tensor]
    assert tensors_in("auto") == []
    assert without_tensors((1.0, tensor, "auto")) == (1.0, torch.Tensor, "auto")
    assert without_tensors(tensor) is torch.Tensor


def test_smaller_pictures() -> None:
    image = noise(1, 3, 12, 15)
    source = InMemory(image, {})
    assert source.resized((12, 15)) is source
    assert source.resized((4, 5)).size == (4, 5)
    assert in_blocks(source, 1, 1) is source
    assert in_blocks(source, 3, 1).size == (4, 5)
    assert in_blocks(source, 3, 1) is in_blocks(source, 3, 1)  # kept
    torch.testing.assert_close(in_blocks(source, 3, 1).image, reduced(source, whole_image, 3))


def test_scribbles_are_read_from_masks() -> None:
    image = noise(2, 3, 12, 15)
    source, mask = InMemory(image), box(2, 3, size=(12, 15)).double()
    scribbles = source.scribbles(mask, None, "mask")
    assert scribbles.weights.shape == (2, 1, 16)
    assert scribbles.colours is None
    learned = (0.5 * mask).requires_grad_()
    assert len(source.scribbles(learned, None, "mask").places) == 12 * 15  # also where the weight is 0
    assert len(source.scribbles(0 * mask, None, "mask", needed=False).places) == 0
    for wrong, kind, sentence in (
        (None, TypeError, "mask must be a torch.Tensor, got NoneType"),
        (0 * mask, ValueError, "mask must hold a painted pixel"),
        (2 * mask, ValueError, r"mask must be in \[0, 1\]"),
        (mask[..., :9], ValueError, "mask must have the height and width of the image"),
    ):
        with pytest.raises(kind, match=sentence):
            source.scribbles(wrong, None, "mask")


def test_an_operator_in_memory_computes_planes_of_the_whole_picture() -> None:
    image = noise(1, 2, 12, 13)
    source = InMemory(image, {})
    fitted = source.operator(Guide(FilterOptions(num_landmarks=20)))
    operator = nonlocal_operator(image, num_landmarks=20)
    layers = fitted.layers(whole_image, 2)(source)
    torch.testing.assert_close(layers, detail_layers(operator, image, order=2))
    coefficients = fitted.coefficients(whole_image)
    torch.testing.assert_close(coefficients.abs(), operator.spectrum().coefficients(image).abs())
    torch.testing.assert_close(fitted.mean(whole_image), image.mean((2, 3)))
    places = torch.tensor([0, 7, 100])
    (columns,) = fitted.at(places)()
    assert torch.equal(columns, operator.factor[:, :, places])
    shares = fitted.of_columns(lambda columns: columns.remainder.unsqueeze(1))(source)
    assert torch.equal(shares, operator.remainder.reshape(1, 1, 12, 13))


class Halved(PhotoEdit):
    """An edit that halves all values."""

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        return Fitted(lambda pixels: pixels.image / 2)


def test_images_are_edited_in_a_working_precision_and_keep_their_dtype() -> None:
    for dtype in (torch.float16, torch.bfloat16, torch.float32, torch.float64):
        image = noise(1, 3, 8, 9).to(dtype)
        edited = edit_image(Halved(options=FilterOptions()), image)
        assert edited.dtype == dtype
        assert torch.equal(edited, image / 2)
    with pytest.raises(ValueError, match=r"grey must have 1 channel\(s\), got 3"):
        edit_image(Halved(options=FilterOptions()), noise(1, 3, 8, 9), name="grey", channels=1)


def test_the_image_in_a_range_is_kept_with_its_operators() -> None:
    image = noise(1, 3, 12, 15)
    source, working = InMemory(image, {}), working_range(0.25, 0.5)
    seen = source.in_range(working)
    assert source.in_range(None) is source
    torch.testing.assert_close(seen.image, (4 * image - 1).clamp(-1, 2))
    assert source.in_range(working_range(0.25, 0.5)) is seen
    assert source.in_range(working_range(0.0, 0.5)) is not seen


def test_an_edit_in_a_range_changes_the_image_in_its_own_units() -> None:
    image, working = noise(1, 3, 12, 15), working_range(0.25, 0.5)
    doubled = Fitted(lambda pixels: 2 * pixels.image, working=working)
    seen = working.seen(image)
    torch.testing.assert_close(InMemory(image).all(doubled), image + seen / 4)
    mixed = Fitted(lambda pixels: 2 * pixels.image, working=working, opacity=0.5)
    torch.testing.assert_close(InMemory(image).all(mixed), image + seen / 8)
    mask = Fitted(lambda pixels: 2 * pixels.image, working=working, gives_picture=False)
    torch.testing.assert_close(InMemory(image).all(mask), 2 * seen)


def working_range(low: float, high: float) -> WorkingRange:
    low_end, high_end = (torch.tensor(end).double().view(1, 1, 1, 1) for end in (low, high))
    return WorkingRange(low_end, high_end, torch.ones(1, 1, 1, 1, dtype=torch.bool))
