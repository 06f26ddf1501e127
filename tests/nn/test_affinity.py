"""The layer that builds an operator."""

import copy
import io
import math
import pickle

import pytest
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from nlfilter_torch import (
    NonlocalAffinity,
    NonlocalFilter,
    PolynomialSliders,
    detail_layers,
    nonlocal_operator,
)
from nlfilter_torch.nn.affinity import HeldAssignment, HeldFeatures, Hold
from nlfilter_torch.operator.features import patch_window
from tests.layers import ALPHA, OPTIONS, backward, everything, image
from tests.problems import noise, picture, seeded


def test_affinity_and_sliders_are_the_parts_of_the_filter() -> None:
    affinity, sliders = NonlocalAffinity(**OPTIONS), PolynomialSliders(ALPHA)
    operator = affinity(image())
    expected = NonlocalFilter(ALPHA, **OPTIONS)(image())
    torch.testing.assert_close(sliders(operator, image()), expected)
    torch.testing.assert_close(sliders.combine(detail_layers(operator, image())), expected)


def test_patch_weights_that_need_a_gradient_are_constants_of_the_layer() -> None:
    layer = NonlocalFilter(patch_weights=torch.ones(3, 3, requires_grad=True), photometric_bandwidth=0.3)
    image = noise(1, 1, 12, 12, dtype=torch.float32).requires_grad_()
    for _ in range(2):
        copy.deepcopy(layer)(image).sum().backward()
    assert image.grad is not None


def test_a_given_window_is_the_start_of_patch_weights() -> None:
    window = patch_window(3) + 0.01
    layer = NonlocalAffinity(patch_weights=window, learn="patch_weights", **OPTIONS)
    torch.testing.assert_close(layer.patch_weights(), (window / window.sum()).float())
    fixed = NonlocalAffinity(patch_weights=window, **OPTIONS)
    torch.testing.assert_close(fixed(image()) @ image(), layer(image()) @ image(), atol=1e-5, rtol=0)
    assert not list(fixed.parameters())


def test_a_bandwidth_that_left_its_range_is_told() -> None:
    layer = everything()
    with torch.no_grad():
        layer.affinity.log_photometric_bandwidth.fill_(math.nan)
    with pytest.raises(ValueError, match="photometric_bandwidth must be positive and finite"):
        layer(image())


def test_bandwidths_can_be_assigned() -> None:
    affinity = NonlocalAffinity(photometric_bandwidth=0.3)
    affinity.photometric_bandwidth = 0.2
    torch.testing.assert_close(affinity(image()).factor, nonlocal_operator(image(), photometric_bandwidth=0.2).factor)
    learned = everything().affinity
    parameter = learned.log_photometric_bandwidth
    learned.photometric_bandwidth = 0.4
    assert learned.log_photometric_bandwidth is parameter
    assert learned.photometric_bandwidth.item() == pytest.approx(0.4)
    with pytest.raises(ValueError, match="photometric_bandwidth must be positive"):
        learned.photometric_bandwidth = -1.0


HOLDS: tuple[Hold, ...] = ("assignment", "features")


def layer(hold: Hold | None, guide: Tensor | None = None, **options: object) -> NonlocalFilter:
    built = everything(hold=hold, **options)
    if guide is not None:
        built.renew(guide)
    return built


def test_assignment_is_that_of_the_first_call_until_renewed() -> None:
    held, free = layer("assignment"), layer(None)
    first = image()
    torch.testing.assert_close(held(first), free(first), atol=0, rtol=0)
    kept = held.affinity(first).assignment
    assert held.affinity(image(1)).assignment is kept  # images of the same shape
    held.affinity(first[:1])  # of another shape
    assert held.affinity(first).assignment is not kept
    held.renew()
    torch.testing.assert_close(held(image(1)), free(image(1)), atol=0, rtol=0)
    held.renew(first)
    expected = nonlocal_operator(image(1), landmarks=free.affinity(first), photometric_bandwidth=0.2)
    assert held.affinity(image(1)).landmarks.shape == (2, 27, 20)
    assert expected.assignment is not None


def test_features_are_those_of_the_guides_of_renewal_for_all_images() -> None:
    held = layer("features", image())
    for batch in (1, 3):
        landmarks = held.affinity(image(5, batch)).landmarks
        assert landmarks.shape == (batch, 27, 20)
        torch.testing.assert_close(landmarks, held.affinity(image(6, 1)).landmarks.expand(batch, -1, -1))
    assert held.affinity(noise(1, 3, 9, 30, dtype=torch.float32)).row_sums().sub(1).abs().max() < 1e-4
    before = held.affinity(image()).landmarks
    held.renew(image(7))
    assert not torch.equal(held.affinity(image()).landmarks, before)


def test_features_of_one_guide_are_the_landmarks_of_its_operator() -> None:
    guide = picture("coffee", 20, 21)
    held = NonlocalAffinity(photometric_bandwidth=0.1, spatial_bandwidth=7.0, num_landmarks=15, hold="features")
    held.renew(guide)
    free = nonlocal_operator(guide, photometric_bandwidth=0.1, spatial_bandwidth=7.0, num_landmarks=15)
    torch.testing.assert_close(held(guide).landmarks, free.landmarks)
    torch.testing.assert_close(held(guide).factor, free.factor)


@pytest.mark.parametrize("guide_channels", ["luminance", "all"])
def test_features_keep_their_meaning_when_bandwidths_are_learned(guide_channels: str) -> None:
    """Landmarks are kept in units of the guide: features of a landmark scale like those of a pixel."""
    held = layer("features", image(), guide_channels=guide_channels)
    pixels, landmarks = (x.detach() for x in (held.affinity(image()).kernel.recipe(image()), _landmarks(held)))
    with torch.no_grad():
        held.affinity.log_photometric_bandwidth += 0.3
        held.affinity.log_spatial_bandwidth -= 0.2
    scale = held.affinity(image()).kernel.recipe(image())[:, :, 20:21] / pixels[:, :, 20:21]
    torch.testing.assert_close(_landmarks(held), scale * landmarks)


def _landmarks(held: NonlocalFilter) -> Tensor:
    return held.affinity(image()).landmarks


@pytest.mark.parametrize("bandwidth", [0.2, "auto"])
def test_features_with_any_bandwidth(bandwidth: float | str) -> None:
    held = NonlocalFilter(photometric_bandwidth=bandwidth, num_landmarks=20, hold="features")  # type: ignore[arg-type]
    held.renew(image())
    torch.testing.assert_close(held(image()), image())  # ones change nothing


@pytest.mark.parametrize("hold", HOLDS)
def test_gradients_describe_what_the_next_call_does(hold: Hold) -> None:
    guide = picture("camera", 24, 24)
    held = layer(hold, guide, patch_size=3, num_landmarks=40).double()
    exact = backward(held, guide)
    parameters = dict(held.named_parameters())
    for name in ("affinity.log_photometric_bandwidth", "affinity.log_spatial_bandwidth"):
        for step in (1e-4, 1e-2):
            values = []
            for sign in (1, -1):
                with torch.no_grad():
                    parameters[name] += sign * step
                    values.append(held(guide).square().mean())
                    parameters[name] -= sign * step
            difference = (values[0] - values[1]) / (2 * step)
            assert abs(difference / exact[name] - 1).max() < 0.01


@pytest.mark.parametrize("hold", HOLDS)
def test_sliders_and_bandwidth_of_a_target_are_recovered(hold: Hold) -> None:
    guide = picture("camera", 24, 24)
    held = NonlocalFilter(
        (3.0, 1.5, 1.05),
        learn=("alpha", "photometric_bandwidth"),
        photometric_bandwidth=0.12,
        num_landmarks=30,
        hold=hold,
    ).double()
    held.renew(guide)
    truth = [parameter.detach().clone() for parameter in held.parameters()]
    target = held(guide).detach()
    with torch.no_grad():
        held.alpha.fill_(1.0)
        held.affinity.photometric_bandwidth = 0.09
    optimizer = torch.optim.LBFGS(
        held.parameters(), max_iter=200, tolerance_grad=0, tolerance_change=0, line_search_fn="strong_wolfe"
    )

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = (held(guide) - target).square().mean()
        loss.backward()
        return loss

    optimizer.step(closure)  # type: ignore[arg-type]
    for parameter, expected in zip(held.parameters(), truth, strict=True):
        torch.testing.assert_close(parameter.detach(), expected, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("hold", HOLDS)
def test_copies_and_files(hold: Hold) -> None:
    held = layer(hold, image(4))
    for other in (copy.deepcopy(held), pickle.loads(pickle.dumps(held))):
        torch.testing.assert_close(other(image()), held(image()), atol=0, rtol=0)
    stream = io.BytesIO()
    torch.save(held.state_dict(), stream)
    stream.seek(0)
    state = torch.load(stream, weights_only=True)
    assert ("affinity.held.features" in state) == (hold == "features")
    other = layer(hold)
    other.load_state_dict(state)
    if hold == "assignment":  # belongs to the images, not to the layer
        other.renew(image(4))
    torch.testing.assert_close(other(image()), held(image()), atol=0, rtol=0)


def test_state_dicts_with_and_without_landmarks() -> None:
    chosen, other = layer("features", image()), layer("features", noise(2, 1, 9, 9), num_landmarks=11)
    other.load_state_dict(chosen.state_dict())  # of another number
    assert other.affinity(image()).landmarks.shape[2] == 20
    with pytest.raises(RuntimeError, match=r"Missing key.*affinity\.held\.features"):
        chosen.load_state_dict(layer("features").state_dict())
    with pytest.raises(RuntimeError, match=r"Unexpected key.*affinity\.held\.features"):
        layer(None).load_state_dict(chosen.state_dict())


def test_renewal_writes_into_the_buffer_that_others_know() -> None:
    held = layer("features", image())
    buffer = dict(held.named_buffers())["affinity.held.features"]
    held.renew(image(1))
    assert dict(held.named_buffers())["affinity.held.features"] is buffer


@pytest.mark.parametrize("hold", HOLDS)
def test_layers_start_from_an_operator(hold: Hold) -> None:
    guide = image()
    operator = nonlocal_operator(guide[:1], photometric_bandwidth=0.1, num_landmarks=12)
    held = NonlocalAffinity(photometric_bandwidth=0.3, landmarks=operator, hold=hold)
    expected = (
        operator.landmarks / 3
        if hold == "features"
        else nonlocal_operator(guide, photometric_bandwidth=0.3, landmarks=operator).landmarks
    )
    torch.testing.assert_close(held(guide).landmarks, expected.expand(2, -1, -1))
    default = NonlocalAffinity(photometric_bandwidth=0.3, landmarks=operator)
    assert isinstance(default.held, HeldAssignment)


def test_layers_start_from_features() -> None:
    operator = nonlocal_operator(image(), photometric_bandwidth=0.1, num_landmarks=12)
    held = NonlocalAffinity(photometric_bandwidth=0.1, landmarks=operator.landmarks[:1])
    assert isinstance(held.held, HeldFeatures)
    torch.testing.assert_close(held(image()).landmarks[:1], operator.landmarks[:1])
    assert held.num_landmarks == 12


@pytest.mark.parametrize("hold", HOLDS)
@pytest.mark.parametrize("reentrant", [False, True])
def test_gradient_checkpointing(hold: Hold, reentrant: bool) -> None:
    """The first call, which makes the assignment, and the second one save the same tensors."""
    held = layer(hold, image() if hold == "features" else None)
    exact = backward(copy.deepcopy(held), image())
    checkpoint(held, image().requires_grad_(), use_reentrant=reentrant).square().mean().backward()
    for name, parameter in held.named_parameters():
        torch.testing.assert_close(parameter.grad, exact[name], atol=1e-7, rtol=1e-5)


@pytest.mark.filterwarnings("ignore:.*autograd.function.Function.* should not be instantiated:DeprecationWarning")
@pytest.mark.parametrize("hold", HOLDS)
def test_compiled(hold: Hold) -> None:
    held = NonlocalFilter(ALPHA, photometric_bandwidth=0.5, num_landmarks=20, hold=hold)
    held.renew(image())
    torch.compiler.reset()
    fast = torch.compile(held, backend="aot_eager", fullgraph=True)
    for seed in (0, 1):
        torch.testing.assert_close(fast(image(seed)), held(image(seed)), atol=1e-5, rtol=0)


@pytest.mark.filterwarnings("ignore:.*autograd.function.Function.* should not be instantiated:DeprecationWarning")
@pytest.mark.parametrize("hold", HOLDS)
def test_exported(hold: Hold) -> None:
    held = NonlocalFilter(ALPHA, photometric_bandwidth=0.5, num_landmarks=20, hold=hold, learn=())
    held.renew(image())
    program = torch.export.export(held, (image(),))
    torch.testing.assert_close(program.module()(image(1)), held(image(1)), atol=1e-5, rtol=0)


@pytest.mark.parametrize("hold", HOLDS)
def test_a_layer_can_be_moved_to_another_precision(hold: Hold) -> None:
    held = layer(hold, image())
    expected = held(image())
    torch.testing.assert_close(held.double()(image().double()).float(), expected, atol=1e-4, rtol=0)


def test_with_a_generator_each_renewal_draws_other_landmarks() -> None:
    held = layer("assignment", generator=seeded(1))
    first = held(image())
    torch.testing.assert_close(held(image()), first, atol=0, rtol=0)
    held.renew()
    assert not torch.equal(held(image()), first)


@pytest.mark.parametrize("hold", HOLDS)
@pytest.mark.parametrize("bandwidth", [0.2, "auto"])
def test_padding_gives_no_landmarks(hold: Hold, bandwidth: float | str) -> None:
    guide = image()
    padded, weights = torch.zeros(2, 3, 15, 18), torch.zeros(2, 1, 15, 18)
    padded[..., :12, :13], weights[..., :12, :13] = guide, 1
    first, second = (
        NonlocalAffinity(photometric_bandwidth=bandwidth, num_landmarks=156, hold=hold)  # type: ignore[arg-type]
        for _ in range(2)
    )
    first.renew(guide[:1])
    second.renew(padded[:1], weights[:1])
    torch.testing.assert_close(second(padded[:1], weights[:1]).landmarks, first(guide[:1]).landmarks)


def test_landmarks_that_are_held_are_shown() -> None:
    assert "landmarks='kmeans', hold='features'" in repr(layer("features"))
    assert "hold" not in repr(layer(None))


@pytest.mark.parametrize("hold", ["features", "assignment"])
def test_padding_has_no_part_in_renewal(hold: Hold) -> None:
    guide, layers = image(3), []
    padded = torch.nn.functional.pad(guide, (0, 5, 0, 4), value=9.0)
    weights = torch.nn.functional.pad(torch.ones_like(guide[:, :1]), (0, 5, 0, 4))
    for arguments in ((guide,), (padded, weights)):
        built = NonlocalFilter(ALPHA, hold=hold, landmarks="random", **OPTIONS)
        built.renew(*arguments)
        layers.append(built)
    alone, other = layers[0](guide), layers[1](padded, weights=weights)
    torch.testing.assert_close(other[..., : guide.shape[2], : guide.shape[3]], alone, atol=1e-5, rtol=0)


def test_guides_of_other_channels_are_refused() -> None:
    held = layer("features", image(), guide_channels="all")
    with pytest.raises(ValueError, match=r"^landmarks must have shape \(B, 27, M\)"):
        held.affinity(image()[:, :1])
