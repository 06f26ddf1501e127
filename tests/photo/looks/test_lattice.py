"""Changes of colours on a grid."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch.core.kernels.lattice import corners
from nlfilter_torch.photo import Look, apply_look
from nlfilter_torch.photo.looks.lattice import colours_of_nodes, lattice_change, resampled
from tests.looks import BENT, CAT, CUP


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
