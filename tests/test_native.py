"""The kernels in C agree with the definitions in torch for all sizes, threads and instruction sets."""

from itertools import product
from typing import Any

import pytest
import torch
from torch import Tensor

from nlfilter_torch import nonlocal_operator
from nlfilter_torch.core import instruction_sets
from nlfilter_torch.core.communicator import ALONE
from nlfilter_torch.core.kernels import definitions_only, library
from nlfilter_torch.core.kernels.clusters import lloyd
from nlfilter_torch.core.kernels.grams import sum_grams
from nlfilter_torch.core.kernels.tall_skinny import moment, spread
from nlfilter_torch.core.precision import OuterProduct
from nlfilter_torch.operator import landmarks
from nlfilter_torch.operator.nystrom import inverse_cholesky, nystrom_factor
from nlfilter_torch.operator.scaling import KernelMatrix, _sweep, weighted_moment
from tests import reference

LEVELS = [
    pytest.param(level, id=name) for level, name in enumerate(instruction_sets.NAMES) if 0 < level <= library.level
]

pytestmark = pytest.mark.skipif(not library.level, reason="this installation or processor has no kernels in C")


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def sizes(pixels: list[int], marks: list[int], most: int = 8_000_000) -> list[tuple[int, int]]:
    """Return the pairs except those of two large sizes; the others already have full blocks of either kind."""
    return [pair for pair in product(pixels, marks) if pair[0] * pair[1] <= most]


@pytest.fixture(params=LEVELS)
def level(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(library, "level", request.param)
    return int(request.param)


@pytest.fixture
def threads():
    """Sets the number of threads, which is restored after the test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def by_torch(function: Any, *arguments: Any) -> Any:
    with definitions_only():
        return function(*arguments)


@pytest.mark.parametrize("completion", ["diagonal", "none"])
@pytest.mark.parametrize("pixels", [1, 7, 31, 64, 65, 1000, 8256, 20_011])
@pytest.mark.parametrize(("size", "marks"), [(1, 1), (9, 2), (25, 5), (27, 6), (3, 100)])
def test_columns(level: int, completion: Any, pixels: int, size: int, marks: int) -> None:
    z = random(2, size, marks, seed=1)
    x = random(2, size, pixels) * 0.7
    x[:, :, : min(pixels, marks)] = z[:, :, : min(pixels, marks)]  # columns that rounding may make longer than 1
    arguments = (x, z, inverse_cholesky(z), completion)
    found = nystrom_factor(*arguments)
    expected = nystrom_factor(*(part.double() for part in arguments[:3]), completion)
    plain = by_torch(nystrom_factor, *arguments)
    for native_part, torch_part, exact in zip(found, plain, expected, strict=True):
        error, usual = (native_part - exact).abs().max(), (torch_part - exact).abs().max()
        assert error <= 2 * usual + 2e-6, (error, usual)
    assert (found[0].square().sum(1) <= 1 + 1e-5).all() or completion == "none"


def test_columns_of_a_whitening_without_a_triangle(level: int) -> None:
    x, z, whitening = random(1, 4, 500), random(1, 4, 11, seed=1), random(1, 11, 11, seed=2) / 20
    expected = nystrom_factor(x.double(), z.double(), whitening.double(), "none")[0]
    torch.testing.assert_close(nystrom_factor(x, z, whitening, "none")[0], expected.float(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("completion", ["diagonal", "none"])
@pytest.mark.parametrize("pixels", [1, 65, 2100])
@pytest.mark.parametrize(("size", "marks"), [(1, 1), (9, 2), (27, 6), (3, 100), (6, 150)])
@pytest.mark.parametrize("rank", [None, 9])
def test_derivatives_of_columns(
    level: int, completion: Any, pixels: int, size: int, marks: int, rank: int | None
) -> None:
    z = random(2, size, marks, seed=1)
    x = random(2, size, pixels) * 0.7
    x[:, :, : min(pixels, marks)] = z[:, :, : min(pixels, marks)]  # columns that rounding may make longer than 1
    along = random(2, marks, rank or pixels, seed=2)
    if rank is not None:  # a gradient that is not formed
        along = OuterProduct(along, random(2, rank, pixels, seed=3))
    slopes = along, random(2, pixels, seed=4)

    def gradients(dtype: torch.dtype) -> list[Tensor]:
        inputs = [part.to(dtype).requires_grad_() for part in (x, z, inverse_cholesky(z))]
        *found, whitening = torch.autograd.grad(
            nystrom_factor(*inputs, completion), inputs, [slope.to(dtype) for slope in slopes]
        )
        return [*found, whitening.tril()]

    found, plain = gradients(torch.float32), by_torch(gradients, torch.float32)
    exact, size_of_terms = gradients(torch.float64), (inverse_cholesky(z).mT.abs() @ (0 + along).abs()).max()
    for native_part, torch_part, part in zip(found, plain, exact, strict=True):
        error, usual = (native_part - part).abs().max(), (torch_part - part).abs().max()
        assert error <= 4 * usual + 1e-6 * size_of_terms, (error, usual)


def test_derivatives_by_any_whitening_and_of_long_columns(level: int) -> None:
    inputs = [random(1, 4, 500), random(1, 4, 11, seed=1), random(1, 11, 11, seed=2)]
    slopes = random(1, 11, 500, seed=3), random(1, 500, seed=4)
    shortened = nystrom_factor(*inputs, "diagonal")[1] == 0
    assert 100 < shortened.sum() < 400
    for completion in ("diagonal", "none"):
        found, exact = (
            torch.autograd.grad(nystrom_factor(*twins, completion), twins, [slope.to(twins[0]) for slope in slopes])
            for twins in ([t.to(dtype).requires_grad_() for t in inputs] for dtype in (torch.float32, torch.float64))
        )
        for one, other in zip(found, exact, strict=True):
            torch.testing.assert_close(one.double(), other, atol=1e-4, rtol=1e-5)


def test_far_features_meet_the_floor_and_nan_is_not_hidden(level: int) -> None:
    z = random(1, 3, 8)
    x = random(1, 3, 200, seed=1)
    x[:, :, 50] = 1e30  # its squared norm overflows
    x[:, 1, 60] = torch.nan
    factor, diagonal = nystrom_factor(x, z, inverse_cholesky(z), "diagonal")
    assert factor[..., 50].abs().max() < 1e-12
    assert diagonal[0, 50] == 1
    assert factor[..., 60].isnan().all()
    assert diagonal[0, 60].isnan()
    rest = torch.arange(200) != 60
    assert factor[..., rest].isfinite().all()


def swept(factor: Tensor, diagonal: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
    return _sweep(KernelMatrix(factor, diagonal), total)


@pytest.mark.parametrize(("pixels", "marks"), sizes([1, 7, 255, 8256, 40_000], [1, 3, 50, 900]))
def test_sweep(level: int, pixels: int, marks: int) -> None:
    factor = random(2, marks, pixels).abs()
    factor = factor / factor.square().sum(1, keepdim=True).sqrt() * torch.linspace(0, 1, pixels)
    diagonal = 1 - factor.square().sum(1).clamp(max=1)
    total = random(2, marks, 1, seed=1).abs().double() * pixels**0.5
    exact = swept(factor.double(), diagonal.double(), total)
    found = swept(factor, diagonal, total)
    plain = by_torch(swept, factor, diagonal, total)
    torch.testing.assert_close(found[0], exact[0].float(), rtol=1e-5, atol=0)
    error, usual = (found[1] - exact[1]).abs().max(), (plain[1] - exact[1]).abs().max()
    assert error <= 2 * usual + 1e-5 * exact[1].abs().max(), (error, usual)


@pytest.mark.parametrize("pixels", [1, 9, 63, 4128, 4129, 30_001])
@pytest.mark.parametrize("rows", [1, 2, 3, 8])
@pytest.mark.parametrize("marks", [1, 2, 3, 5, 100])
def test_products_with_few_rows(level: int, pixels: int, rows: int, marks: int) -> None:
    batch = 1 if pixels in (1, 4129, 30_001) else 2
    factor, vectors, images = random(batch, marks, pixels), random(batch, rows, marks), random(batch, rows, pixels)
    image = (vectors.double() @ factor.double()).float()
    torch.testing.assert_close(spread(vectors, factor), image, atol=1e-5, rtol=1e-6)
    scaling = random(batch, pixels, seed=1)
    torch.testing.assert_close(spread(vectors, factor, scaling), image * scaling.unsqueeze(1), atol=1e-4, rtol=1e-6)
    found = moment(factor, images)
    assert found.dtype == torch.float64
    size = (factor.double().abs() @ images.double().mT.abs()) * 1e-6
    assert ((found - factor.double() @ images.double().mT).abs() <= size).all()


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("size", [1, 25])
@pytest.mark.parametrize(("points", "marks"), [(1, 1), (5, 3), (64, 7), (65, 20), (1000, 50)])
def test_landmarks(level: int, batch: int, size: int, points: int, marks: int) -> None:
    cloud = random(batch, size, points)
    pivots = landmarks._pivots(cloud, marks, torch.Generator().manual_seed(1))
    expected = by_torch(landmarks._pivots, cloud, marks, torch.Generator().manual_seed(1))
    assert torch.equal(pivots[:, :6], expected[:, :6])  # on a line, the others are chosen by rounding
    assert torch.equal(pivots, expected) or size == 1
    start = cloud.gather(2, pivots.unsqueeze(1).expand(-1, size, -1))
    start[:, :, marks // 2 :] += 100.0 * (marks > 3)  # far from all points, so that they do not move
    margin = landmarks.TIE * torch.finfo(torch.float32).eps
    assignment = lloyd(cloud, start, 5, margin)
    assert (assignment == by_torch(lloyd, cloud, start, 5, margin)).float().mean() > 0.95
    assert assignment.max() < max(marks // 2, 1) or marks <= 3


@pytest.mark.parametrize(
    "image",
    [
        torch.full((5, 8), 0.5),
        torch.full((48, 64), 0.5),
        ((torch.arange(16)[:, None] + torch.arange(24)) % 2).float(),
        (torch.arange(24) % 4 / 4).expand(16, 24),
        torch.rand(4, 6, generator=torch.Generator().manual_seed(0)).repeat(4, 4),
    ],
    ids=["constant", "large constant", "checkerboard", "stripes", "repeated patch"],
)
@pytest.mark.parametrize("spatial_bandwidth", [2.0, 5.0])
@pytest.mark.parametrize("marks", [3, 10, 25])
def test_ties_are_broken_by_one_rule(level: int, image: torch.Tensor, spatial_bandwidth: float, marks: int) -> None:
    filtered = random(1, 1, *image.shape)

    def build() -> tuple[torch.Tensor, torch.Tensor]:
        operator = nonlocal_operator(
            image[None, None],
            photometric_bandwidth=0.1,
            spatial_bandwidth=spatial_bandwidth,
            num_landmarks=marks,
            tolerance=1e-6,
        )
        return operator.kernel.landmarks, operator @ filtered

    (landmarks, result), (expected, by_definition) = build(), by_torch(build)
    torch.testing.assert_close(landmarks, expected, atol=1e-5, rtol=1e-5)
    # Balancing enlarges rounding where all landmarks are far away.
    torch.testing.assert_close(result, by_definition, atol=1e-4, rtol=0)


@pytest.mark.parametrize(("pixels", "marks"), sizes([1, 300, 8256, 40_000], [1, 3, 50, 900]))
def test_weighted_moments(level: int, pixels: int, marks: int) -> None:
    arguments = random(2, marks, pixels), random(2, pixels, seed=1).exp(), ALONE, random(2, marks, 1).double()
    factor, weights, total = (t.double() for t in arguments if isinstance(t, Tensor))
    exact = factor @ (weights.unsqueeze(2) * (factor.mT @ total.float().double()))
    found = weighted_moment(*arguments)
    plain = by_torch(weighted_moment, *arguments)
    error, usual = (found - exact).abs().max(), (plain - exact).abs().max()
    assert error <= 2 * usual + 1e-6 * exact.abs().max(), (error, usual)


@pytest.mark.parametrize(("pixels", "marks"), sizes([1, 17, 1024, 1025, 9000], [1, 3, 6, 7, 50, 400], 3_000_000))
@pytest.mark.parametrize("count", [1, 2, 4])
def test_grams(level: int, pixels: int, marks: int, count: int) -> None:
    factor, scaling, remainder = random(2, marks, pixels), random(2, pixels, seed=1).exp(), random(2, pixels).sigmoid()
    found = sum_grams(factor, scaling, remainder, count)
    plain = by_torch(sum_grams, factor, scaling, remainder, count)
    scaled = (factor * scaling.unsqueeze(1)).double()
    for j in range(count):
        exact = (scaled * remainder.double().unsqueeze(1) ** j) @ scaled.mT
        size = exact.diagonal(dim1=1, dim2=2).amax() * 3e-7
        assert (found[:, j] - exact).abs().max() <= size
        assert (plain[:, j] - exact).abs().max() <= 10 * size
    assert torch.equal(found, found.mT)


def test_denormal_numbers_are_zero_in_kernels_only(level: int, threads: Any) -> None:
    threads(2)
    tiny, scaling = torch.full((1, 2, 100_000), 1e-39), torch.full((1, 100_000), 1e30)
    assert (sum_grams(tiny, scaling, None, 1) == 0).all()
    assert (sum_grams(100 * tiny, scaling, None, 1) > 0).all()
    assert (0.5 * tiny > 0).all()  # on both threads


def test_tensors_of_any_layout(level: int) -> None:
    factor, vectors, images = random(1, 300, 6).mT, random(1, 6, 3).mT, random(1, 300, 3).mT
    torch.testing.assert_close(spread(vectors, factor), vectors @ factor)
    torch.testing.assert_close(moment(factor, images), factor.double() @ images.double().mT, atol=1e-4, rtol=0)
    torch.testing.assert_close(spread(vectors, factor[..., 5:205:2]), vectors @ factor[..., 5:205:2])
    z, x, diagonal = random(1, 7, 4).mT, random(1, 300, 4).mT, random(1, 600)[:, ::2].sigmoid()
    arguments = (x, z, inverse_cholesky(z), "diagonal")
    torch.testing.assert_close(nystrom_factor(*arguments), by_torch(nystrom_factor, *arguments))
    arguments = (factor.sigmoid(), diagonal, random(1, 6, 2).double()[..., :1] ** 2)
    found, expected = swept(*arguments), by_torch(swept, *arguments)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0)


@pytest.fixture(params=[False, True], ids=["threads of torch", "threads of its own"])
def own_threads(request: pytest.FixtureRequest):
    openmp = library._openmp()
    assert openmp is not None, "torch's OpenMP library was not found"
    library.share_threads(library._library, None if request.param else openmp)
    yield
    library.share_threads(library._library, openmp)


@pytest.mark.usefixtures("own_threads")
@pytest.mark.parametrize("count", [2, 3, 7])
def test_any_number_of_threads(level: int, count: int, threads: Any) -> None:
    guide = random(1, 1, 150, 131).sigmoid()
    features = random(1, 4, 60_000)
    marks = features[:, :, ::1000]

    def results() -> list[Tensor]:
        factor, diagonal = nystrom_factor(features, marks, inverse_cholesky(marks), "diagonal")
        scaling, found = swept(factor, diagonal, factor.double().sum(2, keepdim=True))
        return [factor, scaling, found, sum_grams(factor, scaling, diagonal, 2)]

    threads(1)
    alone, operator = results(), nonlocal_operator(guide, num_landmarks=30)
    threads(count)
    for one, many, again in zip(alone, results(), results(), strict=True):
        torch.testing.assert_close(one, many, rtol=1e-5, atol=1e-6)  # sums are divided differently
        assert torch.equal(many, again)
    torch.testing.assert_close(nonlocal_operator(guide, num_landmarks=30).scaling, operator.scaling)


def test_an_operator_is_that_of_the_dense_reference(level: int) -> None:
    image = random(1, 1, 24, 31).sigmoid()
    operator = nonlocal_operator(image, photometric_bandwidth=0.4, num_landmarks=24 * 31, completion="diagonal")
    exact = torch.from_numpy(reference.filter_matrix(image[0, 0].double().numpy(), 5, 0.4))
    torch.testing.assert_close(operator.to_dense()[0].double(), exact, atol=2e-5, rtol=0)


class Exhausted:
    """A library whose kernels cannot allocate memory."""

    def __getattr__(self, name: str) -> Any:
        return lambda *_: -1


def test_without_memory_for_its_buffers_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "_library", Exhausted())
    x = random(1, 2, 9)
    with pytest.raises(MemoryError, match="use a smaller image"):
        nystrom_factor(x, x[:, :, :3], inverse_cholesky(x[:, :, :3]), "diagonal")


@pytest.mark.filterwarnings("ignore:.torch.jit.script")  # torch's own forward derivatives
def test_which_tensors_the_dispatcher_sends_to_the_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "_library", Exhausted())
    rows, factor = random(1, 2, 3), random(1, 3, 8)

    def in_c(rows: Tensor, factor: Tensor) -> bool:
        try:
            found = spread(rows, factor)
        except MemoryError:
            return True
        torch.testing.assert_close(found, rows @ factor)
        return False

    leaf = rows.clone().requires_grad_()
    assert in_c(rows, factor)
    assert in_c(rows.mT.contiguous().mT, torch.nn.Parameter(factor).detach())
    assert in_c(torch.imag(torch.complex(rows, rows).conj()), factor)
    assert not in_c(rows.double(), factor.double())
    assert not in_c(random(2, 2, 3), random(2, 3, 0))
    assert not in_c(leaf, factor)
    with torch.no_grad():
        assert in_c(leaf, factor)
    with torch.inference_mode():
        assert in_c(rows, factor)
    with definitions_only():
        assert not in_c(rows, factor)
    assert in_c(rows, factor)
    assert spread(rows.to("meta"), factor.to("meta")).is_meta
    mapped = torch.vmap(lambda part: spread(part, factor))(rows.expand(4, 1, 2, 3))
    torch.testing.assert_close(mapped, (rows @ factor).expand(4, 1, 2, 8))
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(rows, rows)
        tangent = torch.autograd.forward_ad.unpack_dual(spread(dual, factor)).tangent
        torch.testing.assert_close(tangent, rows @ factor)


def test_negated_views_are_resolved() -> None:
    rows, factor = random(1, 2, 3), random(1, 3, 8)
    negated = torch.imag(torch.complex(rows, rows).conj())
    assert negated.is_neg()
    torch.testing.assert_close(spread(negated, factor), -rows @ factor)
