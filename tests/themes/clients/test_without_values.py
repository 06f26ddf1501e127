"""Every public function on tensors whose values cannot be read: on a GPU each read would synchronise.

Forward runs on fake tensors on "cuda", which also detect mixed devices; forward and backward run on "meta", as
autograd does not start on a device that does not exist. Functions that have to read values are listed in
docs/training.md with the reasons.
"""

import re
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch._subclasses import FakeTensorMode
from torch._subclasses.fake_tensor import DataDependentOutputException, DynamicOutputShapeException

import nlfilter_torch as nlf
from nlfilter_torch import photo
from tests.pages import ROOT
from tests.problems import IMAGE_FUNCTIONS
from tests.themes.clients import fake_cuda

LANDMARKS = 20
Case = Callable[["Inputs"], Any]


class Inputs:
    """Arguments without values on a device."""

    def __init__(self, device: str) -> None:
        self.device = device

    def zeros(self, *shape: int) -> Tensor:
        return torch.zeros(shape, device=self.device, requires_grad=True)

    def image(self, channels: int = 3) -> Tensor:
        return self.zeros(1, channels, 24, 26)

    def mask(self, regions: int = 1) -> Tensor:
        return torch.zeros(1, regions, 24, 26, device=self.device)

    def operator(self, **options: Any) -> nlf.NonlocalOperator:
        return nlf.nonlocal_operator(self.image(), **({"num_landmarks": LANDMARKS} | options))

    def spectrum(self) -> nlf.Spectrum:
        return self.operator().spectrum()

    def points(self, **options: Any) -> Tensor:
        return nlf.operator_from_features(self.zeros(1, 3, 50), size=(50,), num_landmarks=9, **options).factor


def response(eigenvalues: Tensor) -> Tensor:
    return eigenvalues.sqrt()


def block_on(device: str) -> nlf.NonlocalBlock:
    with torch.device(device):
        return nlf.NonlocalBlock(3)


def layer_on(device: str) -> nlf.NonlocalFilter:
    with torch.device(device):
        return nlf.NonlocalFilter((1.0, 1.0), num_landmarks=9)


CASES: dict[str, Case] = {
    "nonlocal_operator": lambda x: x.operator() @ x.image(),
    "nonlocal_operator uniform": lambda x: x.operator(landmarks="uniform").scaling,
    "nonlocal_operator paper": lambda x: x.operator(completion="none").scaling,
    "nonlocal_operator many": lambda x: x.operator(num_landmarks=300, spatial_bandwidth=5.0).scaling,
    "operator_from_features": lambda x: x.points(),
    "estimate_bandwidth": lambda x: nlf.estimate_bandwidth(x.image()),
    "eigenvalues": lambda x: x.spectrum().eigenvalues,
    "eigenvectors": lambda x: x.spectrum().eigenvectors,
    "polynomial_filter": lambda x: nlf.polynomial_filter(x.operator(), x.image(), x.zeros(4), residual=0.5),
    "detail_layers": lambda x: nlf.detail_layers(x.operator(), x.image()),
    "spectral_filter": lambda x: nlf.spectral_filter(x.spectrum(), x.image(), response, residual=0.3),
    "spectral_filter of the operator": lambda x: nlf.spectral_filter(x.operator(), x.image(), response),
    "apply_function": lambda x: nlf.apply_function(x.operator(), x.image(), response).image,
    "captured_energy": lambda x: nlf.captured_energy(x.spectrum(), x.image()),
    "compose_alpha": lambda x: nlf.compose_alpha(x.mask(2), x.zeros(2, 4)),
    "filter_regions": lambda x: nlf.filter_regions(x.operator(), x.image(), x.mask(2), x.zeros(2, 4)),
    "polynomial_response": lambda x: nlf.polynomial_response(x.zeros(1, 4), x.zeros(4)),
    "fit_alpha": lambda x: nlf.fit_alpha(x.operator(), x.image(), x.image(), mask=x.mask(), rounding=0.0),
    "NonlocalPrior": lambda x: nlf.NonlocalPrior(x.operator()).prox(x.image(), 0.5),
    "sure": lambda x: nlf.sure(x.operator(), x.image(), 0.1),
    "standard_error": lambda x: nlf.standard_error(lambda y: 0.5 * y, x.image(), 0.1),
    "neighbour_distances": lambda x: nlf.neighbour_distances(x.zeros(1, 3, 50), k=4),
    "bandwidth_of_points": lambda x: nlf.bandwidth_of_points(x.zeros(1, 3, 50)),
    "fit_filter": lambda x: nlf.fit_filter(x.operator(), x.image())(x.image(), x.zeros(4)),
    "FittedFilter": lambda x: nlf.fit_filter(x.operator(), x.image()).layers(x.image()),
    "diffusion_map": lambda x: nlf.diffusion_map(x.spectrum(), time=1.0),
    "diffusion_mask": lambda x: nlf.diffusion_mask(x.spectrum(), x.mask(2), negative=x.mask()),
    "segment_mask": lambda x: nlf.segment_mask(x.spectrum(), x.mask(2)),
    "refine": lambda x: nlf.refine(x.image(4), x.image(), confidence=x.mask(), num_landmarks=20),
    "refine trimap": lambda x: nlf.refine(x.mask(), x.image(), kind="trimap", num_landmarks=20),
    "enhance": lambda x: photo.enhance(x.image(), x.zeros(4), num_landmarks=LANDMARKS),
    "sharpen": lambda x: photo.sharpen(x.image(), num_landmarks=LANDMARKS),
    "adjust_tone": lambda x: photo.adjust_tone(x.image(), num_landmarks=LANDMARKS),
    "denoise": lambda x: photo.denoise(x.image()),
    "estimate_noise": lambda x: nlf.estimate_noise(x.image()),
    "noise_profile": lambda x: nlf.noise_profile(x.image()).levels,
    "profile_of_difference": lambda x: nlf.profile_of_difference(x.image(), x.image()).levels,
    "abstract": lambda x: photo.abstract(x.image()),
    "filter_frames": lambda x: next(photo.filter_frames([x.image()], x.zeros(4), references=[x.image()])),
    "DiffusionMask": lambda x: nlf.DiffusionMask()(x.spectrum(), x.mask()),
    "Refine": lambda x: nlf.Refine(learn=(), num_landmarks=20)(x.image(4), x.image()),
    "SegmentMask": lambda x: nlf.SegmentMask()(x.spectrum(), x.mask()),
    "NonlocalFilter": lambda x: nlf.NonlocalFilter(learn=(), num_landmarks=20)(x.image(), alpha=x.zeros(4)),
    "NonlocalAffinity": lambda x: nlf.NonlocalAffinity(num_landmarks=20)(x.image()).factor,
    "NonlocalBlock": lambda x: block_on(x.device)(x.image()),
    "NonlocalDenoiser": lambda x: nlf.NonlocalDenoiser.trained(device=x.device)(x.image(), 0.1),
    "pad_images": lambda x: nlf.pad_images([x.image()[0], x.image()[0, :, 1:]])[0],
    "collate": lambda x: nlf.collate([(x.operator(), x.image()[0])] * 2)[0][1] @ x.image(),
    "Portable": lambda x: nlf.Portable(nlf.NonlocalFilter(learn=(), num_landmarks=20))(x.image(), alpha=x.zeros(4)),
    "PolynomialSliders": lambda x: nlf.PolynomialSliders(learn=())(x.operator(), x.image(), x.zeros(4)),
}
# The functions that read values, in the order of the table in docs/training.md.
READS: dict[str, Case] = {
    "certify": lambda x: x.operator().certify(),
    "diagnostics": lambda x: x.operator().diagnostics(),
    "nonlocal_operator": lambda x: nlf.nonlocal_operator(
        x.image(), num_landmarks=9, weights=torch.ones_like(x.image()[:, :1])
    ),
    "operator_from_features": lambda x: x.points(weights=torch.ones(50, device=x.device)),
    "fit_alpha": lambda x: nlf.fit_alpha(x.operator(), x.image(), x.image()),
    "apply_look": lambda x: photo.apply_look(x.image(), alpha=x.zeros(4), num_landmarks=LANDMARKS),
    "Look": lambda x: photo.Look(learn=(), num_landmarks=LANDMARKS)(x.image(), alpha=x.zeros(4)),
    "fit_look": lambda x: photo.fit_look([(x.image(), x.image())]),
    "propagate_strokes": lambda x: nlf.propagate_strokes(x.spectrum(), x.mask(3), x.mask()),
    "recolor": lambda x: photo.recolor(x.image(), x.mask(3), x.mask()),
    "colorize": lambda x: photo.colorize(x.image(1), x.mask(3), x.mask()),
    "adjust_light": lambda x: photo.adjust_light(x.image(), x.mask(), exposure=1.0, shadows=0.5),
    "heal": lambda x: photo.heal(x.image(), x.mask()),
    "defocus": lambda x: photo.defocus(x.image(), x.mask()),
    "region_mask": lambda x: photo.region_mask(x.image(), x.mask()),
    "enhance": lambda x: photo.enhance(x.image(), x.zeros(2, 4), x.mask(2), num_landmarks=LANDMARKS),
    "propagate_labels": lambda x: nlf.propagate_labels(
        x.operator(), torch.zeros(1, 624, dtype=torch.long, device=x.device)
    ),
    "restore": lambda x: (
        nlf.restore(x.image(), torch.clone, torch.clone, nlf.NonlocalPrior(x.operator()), strength=1.0, steps=2).image
    ),
    "fit_layer": lambda x: nlf.fit_layer(layer_on(x.device), x.image(), x.image(), evaluations=60).error,
}
CLASSES = {
    "Certificate",
    "Contraction",
    "Diagnostics",
    "FunctionProduct",
    "LayerFit",
    "NoiseProfile",
    "NonlocalOperator",
    "Restoration",
    "Spectrum",
}  # results of functions


@pytest.fixture
def anywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace kornia's blur, which reads its width from a tensor on the CPU; in fake mode that tensor is fake too."""
    monkeypatch.setattr("kornia.filters.gaussian_blur2d", lambda image, *_: F.avg_pool2d(image, 3, 1, 1))


def cuda() -> AbstractContextManager[object]:
    if reason := fake_cuda.missing():
        pytest.skip(reason)
    return FakeTensorMode()


def test_every_public_name_is_tried() -> None:
    assert {name.split()[0] for name in (*CASES, *READS)} | CLASSES >= {*nlf.__all__, *IMAGE_FUNCTIONS}


@pytest.mark.client("GPUs, without one", "no public function reads values but those [listed](training.md)")
@pytest.mark.slow
@pytest.mark.usefixtures("anywhere")
@pytest.mark.parametrize("case", list(CASES))
def test_forward_on_a_gpu_reads_no_value_and_mixes_no_devices(case: str) -> None:
    with cuda(), torch.no_grad():
        assert CASES[case](Inputs("cuda")).device.type == "cuda"


@pytest.mark.client("GPUs, without one", "no public function reads values but those [listed](training.md)")
@pytest.mark.slow
@pytest.mark.usefixtures("anywhere")
@pytest.mark.parametrize("case", list(CASES))
def test_backward_reads_no_value(case: str) -> None:
    result = CASES[case](Inputs("meta"))
    assert result.device.type == "meta"
    if result.requires_grad:
        result.sum().backward()
    else:
        assert case in (
            "bandwidth_of_points",
            "estimate_bandwidth",
            "estimate_noise",
            "noise_profile",
            "profile_of_difference",
            "segment_mask",
            "SegmentMask",
            "standard_error",
        )


@pytest.mark.slow
@pytest.mark.usefixtures("anywhere")
@pytest.mark.parametrize(
    ("case", "device"),
    # torch returns the truth value of a tensor on "meta" without an error.
    [
        (case, device)
        for case in READS
        for device in ("cuda", "meta")
        if case not in ("apply_look", "Look") or device == "cuda"
    ],
)
def test_what_reads_values_is_known(case: str, device: str) -> None:
    errors = (DataDependentOutputException, DynamicOutputShapeException, NotImplementedError, RuntimeError)
    with cuda() if device == "cuda" else nullcontext(), torch.no_grad(), pytest.raises(errors) as caught:
        READS[case](Inputs(device))
    told = f"{type(caught.value).__name__} {caught.value}"
    assert re.search(r"local_scalar_dense|nonzero|meta tensor", told), told


def test_the_page_lists_what_reads_values() -> None:
    table = (ROOT / "docs" / "training.md").read_text(encoding="utf-8").split("| reads values | why |\n|---|---|\n")[1]
    rows = table.split("\n\n")[0].splitlines()
    assert {name for row in rows for name in re.findall(r"`(\w+)[`(]", row.split("|")[1])} == READS.keys()
