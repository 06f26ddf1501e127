"""The filter as a prior and a denoiser of deepinv, with the real package where it is installed."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch import NonlocalPrior, nonlocal_operator
from tests.pages import ROOT, Page
from tests.problems import decibels, noise, noisy, picture

pytestmark = [
    pytest.mark.usefixtures("deepinv"),
    pytest.mark.filterwarnings("ignore"),  # of deepinv
]
IMAGE = picture("camera", 24, 24, torch.float32)


def prior(form: str = "red") -> NonlocalPrior:
    operator = nonlocal_operator(IMAGE, num_landmarks=40, photometric_bandwidth=0.2)
    return NonlocalPrior(operator, form)  # type: ignore[arg-type]


def test_the_prior_follows_the_convention_of_deepinv() -> None:
    import deepinv

    from nlfilter_torch.deepinv import Prior

    own = prior()
    adapted = Prior(own)
    assert isinstance(adapted, deepinv.optim.Prior)
    images = noise(2, 1, 24, 24, dtype=torch.float32)
    torch.testing.assert_close(adapted(images, 0.1), own.energy(images))
    torch.testing.assert_close(adapted.grad(images, 0.1), own.gradient(images))
    torch.testing.assert_close(adapted.prox(images, 0.1, gamma=0.4), own.prox(images, 0.4))
    several = torch.tensor([0.4, 2.0]).view(2, 1, 1, 1)
    torch.testing.assert_close(adapted.prox(images, gamma=several), own.prox(images, several.flatten()))
    # deepinv's own computation of the map, by gradient descent on its definition
    slow = deepinv.optim.Potential.prox(adapted, images, gamma=0.4, stepsize_inter=0.8, max_iter_inter=100, tol_inter=0)
    torch.testing.assert_close(slow, own.prox(images, 0.4), atol=1e-4, rtol=0)
    with pytest.raises(TypeError, match="prior must be"):
        Prior(IMAGE)  # type: ignore[arg-type]


@pytest.mark.client("deepinv's priors", "`nlfilter_torch.deepinv.Prior` in its algorithms")
@pytest.mark.parametrize(("algorithm", "form"), [("PGD", "red"), ("GD", "red"), ("PGD", "plug-and-play")])
def test_algorithms_of_deepinv_reach_the_solution(algorithm: str, form: str) -> None:
    import deepinv

    from nlfilter_torch.deepinv import Prior

    own = prior(form)
    physics = deepinv.physics.Inpainting((1, 24, 24), mask=(noise(1, 24, 24) < 0.6).float())
    observed = physics(IMAGE)
    settings = {"stepsize": 1.0, "lambda": 0.3, "g_param": None}
    model = deepinv.optim.optim_builder(
        algorithm, prior=Prior(own), data_fidelity=deepinv.optim.L2(), max_iter=400, params_algo=settings
    )

    def step(x: Tensor) -> Tensor:
        return own.prox(x - physics.A_adjoint(physics.A(x) - observed), 0.3)

    found = model(observed, physics)
    torch.testing.assert_close(step(found), found, atol=1e-3, rtol=0)  # a fixed point


def test_the_denoiser_follows_the_convention_of_deepinv() -> None:
    import deepinv

    from nlfilter_torch.deepinv import Denoiser

    denoiser = Denoiser(num_landmarks=100)
    assert isinstance(denoiser, deepinv.models.Denoiser)
    noisier = noisy(IMAGE.expand(2, -1, -1, -1), 0.1)
    found = denoiser(noisier, torch.tensor([0.1, 0.0]))
    assert decibels(found[:1], IMAGE) > decibels(noisier[:1], IMAGE) + 3
    torch.testing.assert_close(found[1], noisier[1], atol=0, rtol=0)
    torch.testing.assert_close(denoiser(noisier[:1], 0.1), found[:1], atol=1e-5, rtol=0)
    guided = Denoiser(guide=IMAGE, num_landmarks=100)
    assert decibels(guided(noisier[:1], 0.1), IMAGE) > decibels(noisier[:1], IMAGE) + 3
    model = deepinv.optim.PnP(denoiser)
    torch.testing.assert_close(model.prox(noisier[:1], 0.1), found[:1], atol=1e-5, rtol=0)
    for sigma in (-0.1, float("inf")):
        with pytest.raises(ValueError, match="sigma must be at least 0"):
            denoiser(noisier, sigma)
    with pytest.raises(ValueError, match="strength must be positive"):
        Denoiser(0.0)


def test_the_example_of_the_documentation() -> None:
    (example,) = [block for _, block in Page(ROOT / "docs" / "prior.md").blocks() if "import deepinv" in block]
    names: dict[str, object] = {"image": IMAGE.repeat(1, 3, 1, 1), "prior": prior(), "torch": torch}
    exec(compile(example, "prior.md", "exec"), names)
    assert names["filled"].shape == (1, 3, 24, 24)  # type: ignore[attr-defined]
