"""What the parts of a look do to pixels."""

import numpy as np
import pytest
import skimage.color
import skimage.data
import skimage.exposure
import torch
from torch import Tensor

from nlfilter_torch.core.kernels.lattice import corners
from nlfilter_torch.photo import Look, apply_look, enhance
from nlfilter_torch.photo.looks.look_filter import blur_bands, colours_of_nodes, lattice_change, resampled, tone_curve
from tests.looks import ALPHA, BENT, CAT, CUP, SEPIA, VIVID


def test_bands_add_up_to_the_image() -> None:
    bands = list(blur_bands(CAT.double()))
    assert len(bands) == 7
    assert torch.allclose(sum(bands[1:], bands[0]), CAT.double(), atol=1e-12)
    assert all(bands[i].square().mean() > 0 for i in range(7))


def test_the_parts_are_what_they_say() -> None:
    points = torch.tensor(BENT)
    by_hand = torch.from_numpy(np.interp(CAT.numpy(), [i / 16 for i in range(17)], BENT)).float()
    assert torch.allclose(tone_curve(CAT, points.expand(3, -1)), by_hand, atol=1e-6)
    sepia = torch.tensor(SEPIA).view(3, 3)
    assert torch.allclose(apply_look(CAT, matrix=SEPIA), torch.einsum("cd,bdhw->bchw", sepia, CAT), atol=1e-6)
    contrast = apply_look(CAT, bands=(1.4,) * 7)
    mean = (CAT * torch.tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)).sum(1).mean()
    assert torch.allclose(contrast, mean + 1.4 * (CAT - mean), atol=1e-5)
    sliders = apply_look(CAT, alpha=ALPHA, num_landmarks=40)
    detail = enhance(CAT, torch.tensor(ALPHA), limits="none", threshold=0.0, num_landmarks=40)
    assert torch.allclose(sliders, detail, atol=1e-5)
    hsv = skimage.color.rgb2hsv(CAT[0].permute(1, 2, 0).double().numpy())
    hsv[..., 1] *= np.interp(hsv[..., 1], [0, 0.25, 0.5, 0.75, 1], VIVID)
    by_hand = torch.from_numpy(skimage.color.hsv2rgb(hsv)).permute(2, 0, 1)[None].float()
    assert torch.allclose(apply_look(CAT, saturation=VIVID), by_hand, atol=1e-5)
    assert torch.allclose(
        apply_look(CAT, matrix=SEPIA, amount=0.5), (CAT + apply_look(CAT, matrix=SEPIA)) / 2, atol=1e-6
    )


def test_texture_is_the_fine_band_where_luminance_varies_little() -> None:
    image = CAT.double()
    light = (image * torch.tensor([0.299, 0.587, 0.114], dtype=torch.float64).view(3, 1, 1)).sum(1)[0].numpy()
    weights = np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1]) / 256

    def blurred(row: int, column: int, values: np.ndarray) -> float:
        return float((values[row - 2 : row + 3, column - 2 : column + 3] * weights).sum())

    added = apply_look(image, texture=(2.0, 1.0, 1.0, 1.0, 1.0, 1.0)) - image
    for row, column in ((2, 2), (30, 41), (60, 80)):
        mean = blurred(row, column, light)
        variance = blurred(row, column, light**2) - mean**2
        change = (light[row, column] - mean) * 0.15**2 / (0.15**2 + variance)
        assert added[0, :, row, column].tolist() == pytest.approx([change] * 3, abs=1e-9)


def by_hand(colour: list[float], lattice: Tensor) -> Tensor:
    """The change of a colour: along the axes of its largest, middle and least coordinate within the cell."""
    nodes = lattice.shape[-1]
    places = [min(max(value, 0.0), 1.0) * (nodes - 1) for value in colour]
    node = [min(int(place), nodes - 2) for place in places]
    parts = [place - low for place, low in zip(places, node, strict=True)]
    value = lattice[(slice(None), *node)]
    for axis in sorted(range(3), key=lambda axis: -parts[axis]):
        before = lattice[(slice(None), *node)]
        node[axis] += 1
        value = value + parts[axis] * (lattice[(slice(None), *node)] - before)
    return value


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_colours_are_interpolated_in_tetrahedra(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    lattice = torch.rand(3, 5, 5, 5, generator=generator, dtype=torch.float64).to(dtype)
    image = (1.4 * torch.rand(2, 3, 6, 7, generator=generator, dtype=torch.float64) - 0.2).to(dtype)
    image[0, :, 0] = image[0, :1, 0]  # greys, on the edges of tetrahedra
    image[0, :, 1, :3] = torch.eye(3)  # nodes
    change = lattice_change(image, lattice)
    for colour, result in zip(image.movedim(1, 3).flatten(0, 2), change.movedim(1, 3).flatten(0, 2), strict=True):
        torch.testing.assert_close(result, by_hand(colour.tolist(), lattice), rtol=0, atol=1e-6)


def test_linear_changes_are_exact_and_sampled_again_without_loss() -> None:
    matrix = torch.tensor([[0.3, -0.2, 0.1], [0.0, 0.1, 0.4], [-0.3, 0.2, 0.2]], dtype=torch.float64)
    lattice = torch.einsum("cd,dxyz->cxyz", matrix, colours_of_nodes(4))
    image = CAT.double()
    torch.testing.assert_close(lattice_change(image, lattice), torch.einsum("cd,bdhw->bchw", matrix, image))
    torch.testing.assert_close(resampled(lattice, 7), torch.einsum("cd,dxyz->cxyz", matrix, colours_of_nodes(7)))
    finer = resampled(torch.rand(3, 3, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), 5)
    torch.testing.assert_close(resampled(resampled(finer, 9), 5), finer)


def test_greys_depend_on_grey_nodes_alone() -> None:
    places, weights = corners(torch.linspace(0, 1, 50).expand(3, -1), 9)
    used = places[weights > 0]
    assert bool((used % (81 + 9 + 1) == 0).all())


def test_gradients_reach_image_and_lattice() -> None:
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(2, 3, 3, 4, dtype=torch.float64, generator=generator, requires_grad=True)
    lattice = torch.rand(2, 3, 3, 3, 3, dtype=torch.float64, generator=generator, requires_grad=True)
    assert torch.autograd.gradcheck(lattice_change, (image, lattice))
    assert torch.autograd.gradcheck(lambda image, lattice: apply_look(image, lattice=lattice), (image, lattice))
    layer = Look(learn="lattice")
    layer(CAT).square().mean().backward()
    assert layer.lattice.grad is not None
    assert float(layer.lattice.grad.abs().max()) > 0


def test_lattices_are_arguments_as_tensors_and_as_numbers() -> None:
    generator = torch.Generator().manual_seed(2)
    lattice = 0.1 * torch.rand(2, 3, 4, 4, 4, generator=generator)
    images = torch.cat([CAT, CUP])
    both = apply_look(images, lattice=lattice)
    torch.testing.assert_close(both, images + lattice_change(images, lattice))
    torch.testing.assert_close(both[1:], apply_look(CUP, lattice=lattice[1].flatten().tolist()))
    torch.testing.assert_close(both[:1], Look({"lattice": lattice[0]})(CAT))
    with_curve = apply_look(CAT, lattice=lattice[0], red=BENT, amount=0.5) - CAT
    torch.testing.assert_close(
        with_curve, 0.5 * (apply_look(CAT, red=BENT) + lattice_change(CAT, lattice[0]) - CAT), atol=1e-6, rtol=0
    )
    grey = apply_look(CAT[:, :1], lattice=lattice[0])
    weights = torch.tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)
    wanted = (weights * lattice_change(CAT[:, :1].expand(-1, 3, -1, -1), lattice[0])).sum(1, keepdim=True)
    torch.testing.assert_close(grey - CAT[:, :1], wanted, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("lattice", "message"),
    [
        (torch.zeros(3, 4, 4, 5), r"lattice must have the shape \(3, n, n, n\)"),
        (torch.zeros(3, 1, 1, 1), r"lattice must have the shape \(3, n, n, n\)"),
        ((0.0, 1.0), "or be as many numbers, got 2; add or drop some"),
        (torch.full((3, 2, 2, 2), torch.nan), "lattice must be finite"),
    ],
)
def test_bad_lattices_are_refused(lattice: Tensor | tuple[float, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        apply_look(CAT, lattice=lattice)
