"""Operators and spectra as values: indexing, moving, detaching, collating, joining."""

import copy
import pickle
from collections import namedtuple
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader

from nlfilter_torch import (
    NonlocalFilter,
    NonlocalOperator,
    Spectrum,
    collate,
    nonlocal_operator,
    operator_from_features,
    spectral_filter,
)
from tests.problems import noise

GUIDES = noise(3, 1, 10, 12, dtype=torch.float32)
IMAGES = noise(3, 2, 10, 12, seed=1, dtype=torch.float32)
OPTIONS: dict[str, Any] = {"num_landmarks": 8, "spatial_bandwidth": 6.0}
BANDWIDTHS = torch.tensor([0.1, 0.2, 0.3])
BATCH = nonlocal_operator(GUIDES, photometric_bandwidth=BANDWIDTHS, **OPTIONS)
SINGLE = [
    nonlocal_operator(guide[None], photometric_bandwidth=float(h), **OPTIONS)
    for guide, h in zip(GUIDES, BANDWIDTHS, strict=True)
]
Pair = namedtuple("Pair", "operator image")


@pytest.mark.parametrize("weighted", [False, True])
def test_an_image_of_an_operator_is_the_operator_of_the_image(weighted: bool) -> None:
    batch = BATCH
    if weighted:
        batch = NonlocalOperator.cat([SINGLE[0], *BATCH[1:]])
    for number, single in enumerate(SINGLE):
        chosen = batch[number]
        torch.testing.assert_close(chosen @ GUIDES, single @ GUIDES)
        torch.testing.assert_close(chosen.kernel.recipe(GUIDES[:1]), single.kernel.recipe(GUIDES[:1]))
        factor, diagonal = single.kernel.columns(GUIDES[:1])
        for ours, theirs in zip(chosen.balancing(factor, diagonal), single.balancing(factor, diagonal), strict=True):
            torch.testing.assert_close(ours, theirs)
        root = torch.sqrt
        torch.testing.assert_close(
            spectral_filter(batch.spectrum()[number], GUIDES, root), spectral_filter(single.spectrum(), GUIDES, root)
        )


INDICES = [
    (1, [1]),
    (-1, [2]),
    (slice(1, None), [1, 2]),
    (slice(None, None, -1), [2, 1, 0]),
    (slice(0, 0), []),
    ([0, 2], [0, 2]),
    ([True, False, True], [0, 2]),
    ([], []),
    (torch.tensor([2, -2]), [2, 1]),
    (torch.tensor(2), [2]),
    (torch.tensor([False, True, True]), [1, 2]),
]


def test_every_kind_of_index() -> None:
    for index, images in INDICES:
        for batch in (BATCH, BATCH.spectrum()):
            assert torch.equal(batch[index].factor, batch.factor[images])
            assert len(batch[index]) == len(images)


def test_iteration_gives_each_image() -> None:
    assert [len(operator) for operator in BATCH] == [1, 1, 1]
    assert torch.equal(torch.cat([operator @ GUIDES[:1] for operator in BATCH]), BATCH @ GUIDES[:1])


def test_gradients_reach_the_guide_through_the_image_that_was_chosen() -> None:
    guide = GUIDES.clone().requires_grad_()
    operator = nonlocal_operator(guide, photometric_bandwidth=BANDWIDTHS, **OPTIONS)
    gradient = torch.autograd.grad((operator[1] @ GUIDES[:1]).square().sum(), guide)[0]
    assert bool((gradient[1] != 0).any())
    assert not bool(gradient[[0, 2]].any())
    detached = operator.detach()
    assert operator.factor.requires_grad
    assert not (detached @ GUIDES).requires_grad
    assert detached.factor.data_ptr() == operator.factor.data_ptr()
    assert not operator.spectrum().detach().eigenvalues.requires_grad


def test_description() -> None:
    assert BATCH.shape == BATCH.to_dense().shape == (3, 120, 120)
    assert (BATCH.device, BATCH.dtype, BATCH.to(torch.float64).dtype) == (
        torch.device("cpu"),
        torch.float32,
        torch.float64,
    )
    assert repr(BATCH) == "NonlocalOperator(3 images of 10x12, 8 landmarks, torch.float32, cpu)"
    assert repr(BATCH[0].spectrum(5)) == "Spectrum(1 image of 10x12, 5 eigenvalues, torch.float32, cpu)"
    assert BATCH.to("meta").device.type == "meta"


def test_a_loader_collates_operators_and_spectra_in_any_structure() -> None:
    samples = [(guide, single) for guide, single in zip(GUIDES, SINGLE, strict=True)]
    images, operators = next(iter(DataLoader(samples, batch_size=3, collate_fn=collate)))
    torch.testing.assert_close(operators @ images, BATCH @ GUIDES)
    nested = collate([{"a": [Pair(single, 1)], "b": single.spectrum()} for single in SINGLE])
    assert isinstance(nested["a"][0], Pair)
    assert nested["a"][0].image.tolist() == [1, 1, 1]
    assert isinstance(nested["a"][0].operator, NonlocalOperator)
    assert isinstance(nested["b"], Spectrum)
    again = pickle.loads(pickle.dumps(operators))  # as from a worker of the loader
    assert torch.equal(again @ images, operators @ images)


def test_samples_of_different_structure_are_refused() -> None:
    with pytest.raises(TypeError, match=r"each of the batches must be a NonlocalOperator, got int"):
        collate([SINGLE[0], 3])
    with pytest.raises(ValueError, match=r"samples must have the same length, got \[1, 2\]"):
        collate([(SINGLE[0],), (SINGLE[0], 3)])
    for samples in ([], 5):
        with pytest.raises(TypeError, match="samples must be a list of at least one sample"):
            collate(samples)  # type: ignore[arg-type]


def test_an_operator_in_place_of_a_guide_is_told_what_to_call() -> None:
    layer = NonlocalFilter(num_landmarks=8)
    with pytest.raises(TypeError, match=r"guide must be .*, got a NonlocalOperator; call layer\.sliders\(operator, im"):
        layer(GUIDES, BATCH)
    with pytest.raises(TypeError, match=r"guide must be .*, got a NonlocalOperator, which is built already"):
        layer.affinity(BATCH)
    torch.testing.assert_close(layer.sliders(BATCH, GUIDES), GUIDES)


# --- joining


def build(guide: torch.Tensor, **options: Any) -> NonlocalOperator:
    return nonlocal_operator(guide, **({"num_landmarks": 8, "photometric_bandwidth": 0.2} | options))


@pytest.mark.parametrize(
    "options",
    [
        [{"photometric_bandwidth": 0.1}, {"photometric_bandwidth": 0.3}],
        [{"photometric_bandwidth": torch.tensor([0.1])}, {"photometric_bandwidth": 0.3}],
        [{"photometric_bandwidth": torch.tensor(0.1)}] * 2,
        [{"spatial_bandwidth": 5.0}, {"spatial_bandwidth": (5.0, 7)}],
        [{"landmarks": "uniform", "photometric_bandwidth": 0.05}, {}],  # the first has a limiter or rounds of balancing
        [{"patch_weights": torch.ones(3, 3)}] * 2,
    ],
)
def test_a_joint_operator_is_those_of_its_images(options: list[dict[str, Any]]) -> None:
    if any("spatial_bandwidth" in entry for entry in options):
        options = [{"spatial_bandwidth": (5.0, 5.0)}, options[1]]
    parts = [build(GUIDES[i : i + 1], **entry) for i, entry in enumerate(options)]
    joint = NonlocalOperator.cat(parts)
    for i, part in enumerate(parts):
        torch.testing.assert_close((joint @ IMAGES[:2])[i : i + 1], part @ IMAGES[i : i + 1], atol=2e-6, rtol=0)
        features = part.kernel.recipe(GUIDES[i : i + 1])
        torch.testing.assert_close(joint[i].kernel.recipe(GUIDES[i : i + 1]), features)
        for ours, theirs in zip(vars(joint[i].at(features)).values(), vars(part.at(features)).values(), strict=True):
            torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-5)
    certificate, diagnostics = joint.certify(), joint.diagnostics()
    assert max(certificate.row_sums) < 1e-4
    assert len(diagnostics.photometric_bandwidth) == 2


def test_points_without_weights_count_once_beside_weighted_ones() -> None:
    features = noise(2, 3, 40, dtype=torch.float32) * 3
    weights = 1 + noise(40, seed=2, dtype=torch.float32)
    first = operator_from_features(features[:1], size=(40,), num_landmarks=8, weights=weights)
    second = operator_from_features(features[1:], size=(40,), num_landmarks=8)
    joint = NonlocalOperator.cat([first, second])
    values = noise(2, 1, 1, 40, seed=3, dtype=torch.float32)
    torch.testing.assert_close(joint @ values, torch.cat([first @ values[:1], second @ values[1:]]))
    spectrum = Spectrum.cat([first.spectrum(3), second.spectrum()])
    torch.testing.assert_close(spectrum.eigenvalues[:, :3], joint.spectrum().eigenvalues[:, :3])
    assert not bool(spectrum.eigenvalues[0, 3:].any())
    torch.testing.assert_close(spectrum[1].eigenvectors.square(), second.spectrum().eigenvectors.square())


def test_gradients_reach_all_guides() -> None:
    guides = [guide[None].clone().requires_grad_() for guide in GUIDES]
    joint = NonlocalOperator.cat([build(guide) for guide in guides])
    gradients = torch.autograd.grad((joint @ IMAGES).square().sum(), guides)
    for guide, image, gradient in zip(guides, IMAGES, gradients, strict=True):
        expected = torch.autograd.grad((build(guide) @ image[None]).square().sum(), guide)[0]
        torch.testing.assert_close(gradient, expected, atol=1e-5, rtol=1e-4)


def test_batches_of_several_images_and_of_none() -> None:
    batch = build(GUIDES, photometric_bandwidth=torch.tensor([0.1, 0.2, 0.3]))
    joint = NonlocalOperator.cat([batch[2:], batch[:0], batch[:2]])
    torch.testing.assert_close(joint @ IMAGES, batch[[2, 0, 1]] @ IMAGES)
    assert len(NonlocalOperator.cat([batch[:0], batch[:0]])) == 0


FIRST = build(GUIDES[:1])


def test_deep_copies_are_other_tensors_and_stay_in_the_graph() -> None:
    copied = copy.deepcopy(BATCH)
    assert copied.factor.data_ptr() != BATCH.factor.data_ptr()
    torch.testing.assert_close(copied @ IMAGES, BATCH @ IMAGES, atol=0, rtol=0)
    guide = GUIDES.clone().requires_grad_()
    operator = nonlocal_operator(guide, photometric_bandwidth=BANDWIDTHS, **OPTIONS)
    for built in (operator, operator.spectrum()):
        slopes = [
            torch.autograd.grad(value.factor.square().sum(), guide, retain_graph=True)[0]
            for value in (built, copy.deepcopy(built))
        ]
        assert slopes[0].abs().max() > 0
        torch.testing.assert_close(*slopes, atol=0, rtol=0)
