"""One image over several processes: results and gradients equal those of a single process for the same rows.

Three processes are started once; groups of one, two and three of them take turns.
"""

import os
import time
from collections.abc import Callable
from dataclasses import asdict
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from torch import Tensor

from benchmarks.distributed import watched
from nlfilter_torch import (
    NonlocalFilter,
    captured_energy,
    detail_layers,
    diffusion_map,
    diffusion_mask,
    fit_alpha,
    fit_filter,
    nonlocal_operator,
    polynomial_filter,
    propagate_strokes,
    segment_mask,
    spectral_filter,
)
from nlfilter_torch.core import communicator as communicator_module
from nlfilter_torch.core.communicator import ALONE, RowCommunicator, all_gather_shapes
from tests.problems import noise, picture, seeded
from tests.ranks import run_ranks

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not dist.is_available() or not dist.is_gloo_available(), reason="this torch has no gloo"),
]

PROCESSES = 3
HEIGHT, WIDTH = 24, 17
# Processes of a group, with the first row of each and the end of the last. Some have fewer rows than half a patch.
GROUPS = {
    "one": ((1,), (0, 24)),
    "two": ((1, 2), (0, 9, 24)),
    "three": ((0, 1, 2), (0, 1, 11, 24)),
    "thin": ((0, 1, 2), (0, 22, 23, 24)),
}
Results = dict[str, Tensor]
Problem = Callable[[slice, Any, torch.dtype], Results]


def filtering(rows: slice, group: Any, dtype: torch.dtype) -> Results:
    """Filter, mask and all gradients, with every parameter learned."""
    whole = picture("astronaut", HEIGHT, WIDTH, dtype).expand(1, 2, -1, -1)
    guide = whole[:, :, rows].clone().requires_grad_()
    image = whole[:, :, rows].flip(1).clone().requires_grad_()
    leaves = {
        "alpha": torch.tensor([3.0, 3.0, 4.0, 1.05], dtype=dtype),
        "residual": torch.tensor(0.5, dtype=dtype),
        "photometric": torch.tensor(0.2, dtype=dtype),
        "spatial": torch.tensor(9.0, dtype=dtype),
        "patch": torch.linspace(1, 2, 25, dtype=dtype).view(5, 5),
        "time": torch.tensor(1.5, dtype=dtype),
        "width": torch.tensor(3.0, dtype=dtype),
    }
    for leaf in leaves.values():
        leaf.requires_grad_()
    operator = nonlocal_operator(
        guide,
        photometric_bandwidth=leaves["photometric"],
        spatial_bandwidth=leaves["spatial"],
        patch_weights=leaves["patch"],
        num_landmarks=15,
        tolerance=1e-7 if dtype == torch.float32 else None,
        group=group,
    )
    filtered = polynomial_filter(operator, image, leaves["alpha"], residual=leaves["residual"])
    spectrum = operator.spectrum()
    region = torch.zeros(1, 1, HEIGHT, WIDTH, dtype=dtype)
    region[..., 8:14, 3:9] = 1  # no rank contains all of it, and some contain none
    mask = diffusion_mask(
        spectrum, region[:, :, rows], time=leaves["time"], width=leaves["width"], negative=region.flip(3)[:, :, rows]
    )
    energy = captured_energy(spectrum, image)
    # Weights of both signs, so that errors of half a unit in the last place do not add up over all pixels.
    weights = noise(1, 2, HEIGHT, WIDTH, dtype=dtype)[:, :, rows] - 0.5
    share = (weights * filtered).sum() + (weights[:, :1] * mask).sum()
    share = share + energy.sum() / (1 if group is None else dist.get_world_size(group))
    share.backward()
    result = {"rows filtered": filtered, "rows mask": mask, "rows guide": guide.grad, "rows image": image.grad}
    result |= {name: leaf.grad for name, leaf in leaves.items()}
    result |= {"energy": energy, "eigenvalues": spectrum.eigenvalues}
    result["rows row sums"] = operator.row_sums()
    result["rows map"] = diffusion_map(spectrum, time=1.0).square().sum(1, keepdim=True)
    return {name: value.detach() for name, value in result.items() if value is not None}


def options(rows: slice, group: Any, dtype: torch.dtype) -> Results:
    """Other options of the operator: automatic bandwidth, samplings, no completion, a batch, one landmark per pixel."""
    guide = torch.cat([picture(name, HEIGHT, WIDTH, dtype) for name in ("camera", "coffee")])
    exact = 1e-7 if dtype == torch.float32 else None
    result = {}
    for name, kwargs in {
        "auto": {},
        "uniform": {"landmarks": "uniform", "patch_size": 1},
        "random": {"landmarks": "random", "photometric_bandwidth": 0.4},
        "plain": {"completion": "none", "photometric_bandwidth": 1.0},
        "dense": {"num_landmarks": HEIGHT * WIDTH, "photometric_bandwidth": 0.3},
    }.items():
        rank = 0 if group is None else dist.get_rank(group)
        own = guide[:, :, rows].clone().requires_grad_()
        arguments: dict[str, Any] = {"num_landmarks": 12, "tolerance": exact, "group": group} | kwargs
        operator = nonlocal_operator(own, generator=seeded(rank), **arguments)  # the choices of the first rank are used
        layers = detail_layers(operator, own, order=2)
        (layers * noise(2, 3, 1, HEIGHT, WIDTH, dtype=dtype)[..., rows, :]).sum().backward()
        result[f"rows {name}"] = layers.flatten(1, 2)
        assert own.grad is not None
        result[f"rows gradient {name}"] = own.grad
        result[f"bandwidth {name}"] = torch.as_tensor(operator.kernel.recipe.photometric_bandwidth)
        if name == "auto":
            own = own.detach().requires_grad_()
            held = nonlocal_operator(own, photometric_bandwidth=0.2, landmarks=operator, group=group)
            (held @ own).square().sum().backward()
            result["landmarks"], result["rows gradient held"] = held.landmarks, own.grad
            points = operator.landmarks.detach()[:1].requires_grad_()
            passed = nonlocal_operator(own.detach(), photometric_bandwidth=0.2, landmarks=points, group=group)
            (passed @ own.detach()).square().sum().backward()
            assert points.grad is not None
            result["gradient landmarks"] = points.grad
    return {name: value.detach() for name, value in result.items()}


def fitted(rows: slice, group: Any, dtype: torch.dtype) -> Results:
    """A filter fitted to all rows, for any other image; second derivatives in the image and in alpha."""
    image = picture("chelsea", HEIGHT, WIDTH, dtype)[:, :, rows].clone()
    operator = nonlocal_operator(image, num_landmarks=12, photometric_bandwidth=0.3, group=group)
    layers = fit_filter(operator, image).layers(picture("coffee", 9, 8, dtype))
    image.requires_grad_()
    alpha = torch.tensor([2.0, 3.0, 1.0], dtype=dtype, requires_grad=True)
    share = polynomial_filter(operator, image, alpha).pow(3).sum()
    first = torch.autograd.grad(share, (image, alpha), create_graph=True)
    # A loss counts once: terms that are equal on all ranks are divided by the number of ranks.
    ranks = 1 if group is None else dist.get_world_size(group)
    second = torch.autograd.grad(first[0].square().sum() + first[1].square().sum() / ranks, (image, alpha))
    return {"layers": layers, "rows second": second[0], "second alpha": second[1]}


def layer(rows: slice, group: Any, dtype: torch.dtype) -> Results:
    """The layer with sliders for each of two regions and all its parameters learned."""
    image = torch.cat([picture(name, HEIGHT, WIDTH, dtype) for name in ("astronaut", "coffee")])[:, :, rows]
    learned = NonlocalFilter(
        alpha=((2.0, 1.5, 1.0), (0.5, 3.0, 1.1)),
        residual=1.0,
        photometric_bandwidth=0.15,
        spatial_bandwidth=9.0,
        num_landmarks=12,
        learn=("alpha", "residual", "photometric_bandwidth", "spatial_bandwidth", "patch_weights"),
        group=group,
    ).to(dtype)
    masks = noise(1, 2, HEIGHT, WIDTH, dtype=dtype)[:, :, rows]
    filtered = learned(image, mask=masks)
    filtered.pow(3).sum().backward()
    gradients = {name: value.grad for name, value in learned.named_parameters()}
    assert len(gradients) == 5
    return {name: value.detach() for name, value in gradients.items() if value is not None} | {
        "rows filtered": filtered.detach()
    }


def painting(rows: slice, group: Any, dtype: torch.dtype) -> Results:
    """Strokes, regions and the diagnostics of an operator; some ranks have no painted pixels."""
    guide = picture("coffee", HEIGHT, WIDTH, dtype)[:, :, rows].clone().requires_grad_()
    operator = nonlocal_operator(guide, photometric_bandwidth=0.2, spatial_bandwidth=8.0, num_landmarks=15, group=group)
    spectrum = operator.spectrum()
    painted = torch.zeros(1, 1, HEIGHT, WIDTH, dtype=dtype)
    painted[..., 3:5, 2:9], painted[..., 14, 12] = 1, 0.5
    values = noise(1, 2, HEIGHT, WIDTH, dtype=dtype)[:, :, rows].requires_grad_()
    leaves = {name: torch.tensor(0.8, dtype=dtype, requires_grad=True) for name in ("strength", "reach", "smoothness")}
    spread = propagate_strokes(spectrum, values, painted[:, :, rows], **leaves)
    spread.pow(2).sum().backward()
    regions = torch.cat([painted, painted.flip(2, 3)], dim=1)
    figures = asdict(operator.diagnostics())
    assert figures.pop("pixels") == HEIGHT * WIDTH
    figures.pop("balancing_steps")  # samples of the ranks differ from those of the whole image
    figures.pop("num_landmarks")
    figures.pop("badly_covered")  # not measured over ranks
    result = {"rows spread": spread, "rows guide": guide.grad, "rows values": values.grad}
    result |= {name: leaf.grad for name, leaf in leaves.items()}
    result |= {
        "rows segments": segment_mask(spectrum, regions[:, :, rows]),
        "figures": torch.tensor(list(figures.values()), dtype=dtype),
    }
    return {name: value.detach() for name, value in result.items() if value is not None}


def sliders(rows: slice, group: Any, dtype: torch.dtype) -> Results:
    """Sliders fitted to a pair of pictures: with the rounding of files, without rounding, and with a mask."""
    image = picture("chelsea", HEIGHT, WIDTH, dtype)[:, :, rows]
    operator = nonlocal_operator(image, num_landmarks=12, photometric_bandwidth=0.3, group=group)
    edited = polynomial_filter(operator, image, torch.tensor([2.0, 3.0, 1.0, 1.1], dtype=dtype)).clamp(0, 1)
    rounded = (edited * 255).round() / 255
    mask = noise(1, 1, HEIGHT, WIDTH, dtype=dtype)[:, :, rows].requires_grad_()
    target = (edited + 0.01 * noise(1, 1, HEIGHT, WIDTH, seed=1, dtype=dtype)[:, :, rows]).requires_grad_()
    masked = fit_alpha(operator, image, target, mask=mask, ridge=1e-4)
    ranks = 1 if group is None else dist.get_world_size(group)
    gradients = torch.autograd.grad(masked.square().sum() / ranks, (mask, target))
    # Many sliders explain a rounded edit; which ones are found may depend on the order of summation.
    again = polynomial_filter(operator, image, fit_alpha(operator, image, rounded, shared=True)).clamp(0, 1)
    return {
        "rows explained": ((again - rounded).abs() < 0.5 / 255 + 1e-6).to(dtype),
        "masked": masked.detach(),
        "rows mask": gradients[0],
        "rows target": gradients[1],
    }


def functions(rows: slice, group: Any, dtype: torch.dtype) -> Results:
    """f(W) by a polynomial, by poles and by the method of Lanczos, and f on the eigenvectors, with all gradients."""
    result = {}
    for name in ("smooth", "root", "kink", "spectrum"):
        guide = picture("coffee", HEIGHT, WIDTH, dtype)[:, :, rows].clone().requires_grad_()
        image = picture("chelsea", HEIGHT, WIDTH, dtype)[:, :, rows].clone().requires_grad_()
        number = torch.tensor(0.4, dtype=dtype, requires_grad=True)
        operator = nonlocal_operator(guide, photometric_bandwidth=0.2, num_landmarks=12, group=group)
        response = partial(RESPONSES[name], number)
        filtered = spectral_filter(operator.spectrum() if name == "spectrum" else operator, image, response)
        (filtered * noise(1, 1, HEIGHT, WIDTH, seed=1, dtype=dtype)[:, :, rows]).sum().backward()
        result |= {f"rows {name}": filtered, f"rows guide {name}": guide.grad, f"rows image {name}": image.grad}
        if name != "spectrum":  # on the eigenvectors the gradient of a parameter is that of the rank's own rows
            result[f"number {name}"] = number.grad
    return {name: value.detach() for name, value in result.items() if value is not None}


RESPONSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "smooth": lambda number, values: torch.exp(number * values),
    "root": lambda number, values: values**number,
    "kink": lambda number, values: (values - number).relu() + number * values,
    "spectrum": lambda number, values: values**number,
}


# Some gradients have errors above 1e-4 in float32 even in one process: the inverse Cholesky factor amplifies rounding.
PROBLEMS: dict[str, tuple[Problem, torch.dtype, float]] = {
    "filtering": (filtering, torch.float64, 1e-9),
    "filtering in float32": (filtering, torch.float32, 1e-5),
    "options": (options, torch.float64, 1e-9),
    "layer": (layer, torch.float64, 1e-9),
    "functions": (functions, torch.float64, 1e-9),
    "painting": (painting, torch.float64, 1e-9),
    "sliders": (sliders, torch.float64, 1e-9),
    "fitted": (fitted, torch.float64, 1e-9),
    "fitted in float32": (fitted, torch.float32, 1e-5),
}


def refusals(group: Any, rank: int) -> dict[str, str]:
    """Calls that are refused, with their errors."""
    rows = noise(1, 1, 5, 6)
    operator = nonlocal_operator(rows, num_landmarks=5, group=group)
    calls: dict[str, Callable[[], object]] = {
        "to_dense": operator.to_dense,
        "a loss": lambda: fit_alpha(operator, rows, rows, loss=lambda estimate, other: (estimate - other).abs().sum()),
        "width": lambda: nonlocal_operator(rows[..., : 6 - rank], num_landmarks=5, group=group),
        "dtype": lambda: nonlocal_operator(rows if rank else rows.float(), num_landmarks=5, group=group),
    }
    result = {}
    for name, call in calls.items():
        try:
            call()
        except ValueError as error:
            result[name] = str(error)
    return result


def halos(communicator: RowCommunicator) -> list[tuple[Tensor, tuple[int, int], Tensor]]:
    """Rows with halos of several sizes, and the gradient of a function of them."""
    result = []
    for margin in (0, 1, 3, 30):
        rows = noise(2, 2, HEIGHT, WIDTH)[:, :, communicator.first_row :][
            :, :, : communicator.rows[communicator.rank]
        ].requires_grad_()
        extended, halo = communicator.with_halo(rows, margin)
        extended.pow(3).sum().backward()
        assert rows.grad is not None
        result.append((extended.detach(), halo, rows.grad))
    return result


def traffic(group: Any, rank: int) -> list[dict[str, int]]:
    """Bytes that a rank sends for images of three heights, balanced in one sweep."""
    result = []
    for height in (12, 24, 96):
        rows = noise(1, 1, height, WIDTH, dtype=torch.float32).tensor_split(PROCESSES, 2)[rank]
        with watched() as sent:
            operator = nonlocal_operator(rows, num_landmarks=3, photometric_bandwidth=2.0, tolerance=1.0, group=group)
            polynomial_filter(operator, rows, torch.ones(4))
        result.append(dict(sent.sent) | {"calls": sent.calls, "sweeps": operator.balancing_steps})
    return result


def loss_of(call: Callable[[], object]) -> tuple[str, float]:
    """The error that reports a lost rank, and the seconds until it is raised."""
    start = time.monotonic()
    try:
        call()
    except ConnectionError as error:
        return str(error), time.monotonic() - start
    return "nothing was raised", 0.0


def work(rank: int, folder: str) -> None:
    """One of the processes."""
    torch.set_num_threads(1)
    communicator_module.ANSWERING = timedelta(seconds=3)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=PROCESSES)
    for name, (members, cuts) in GROUPS.items():
        group = dist.new_group(list(members))
        if rank not in members:
            continue
        place = members.index(rank)
        rows = slice(cuts[place], cuts[place + 1])
        result: dict[str, Any] = {problem: solve(rows, group, dtype) for problem, (solve, dtype, _) in PROBLEMS.items()}
        communicator = all_gather_shapes(noise(2, 2, rows.stop - rows.start, WIDTH), group)
        assert isinstance(communicator, RowCommunicator)
        result["halos"] = halos(communicator)
        torch.save(result, f"{folder}/{name}{place}.pt")
    world = dist.group.WORLD
    result = {"refusals": refusals(world, rank), "traffic": traffic(world, rank)}
    impatient = dist.new_group(timeout=timedelta(seconds=3))
    if rank != 2:  # it is alive but does not take part
        result["absent"] = loss_of(lambda: nonlocal_operator(noise(1, 1, 5, 6), num_landmarks=5, group=impatient))
        Path(f"{folder}/{rank}.waited").touch()
    while not all(Path(f"{folder}/{other}.waited").exists() for other in range(2)):
        time.sleep(0.05)
    rows = noise(1, 1, 5, 6).requires_grad_()
    filtered = nonlocal_operator(rows, num_landmarks=5, group=world).matmul(rows)
    if rank == 2:
        torch.save(result, f"{folder}/end2.pt")
        os._exit(0)  # like a process killed between forward and backward
    result["dead"] = loss_of(filtered.square().sum().backward)
    torch.save(result, f"{folder}/end{rank}.pt")
    os._exit(0)  # a group with a dead member cannot be shut down normally


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the results of the processes."""
    path = tmp_path_factory.mktemp("ranks")
    run_ranks(work, (str(path),), PROCESSES)
    return path


def load(folder: Path, name: str) -> list[dict[str, Any]]:
    count = len(GROUPS[name][0]) if name in GROUPS else PROCESSES
    return [torch.load(folder / f"{name}{place}.pt", weights_only=False) for place in range(count)]


@pytest.mark.parametrize("problem", PROBLEMS)
def test_ranks_get_what_one_process_gets(folder: Path, problem: str) -> None:
    solve, dtype, tolerance = PROBLEMS[problem]
    alone = solve(slice(0, HEIGHT), None, dtype)
    for name in GROUPS:
        parts = [result[problem] for result in load(folder, name)]
        for key, expected in alone.items():
            values = [part[key] for part in parts]
            for value in [torch.cat(values, dim=2)] if key.startswith("rows") else values:
                error = (value - expected).abs().max() / expected.abs().max().clamp(min=1.0)
                assert error < tolerance, f"{key} of {problem} over {name}"


def test_halos_are_the_rows_of_the_neighbours(folder: Path) -> None:
    whole = noise(2, 2, HEIGHT, WIDTH)
    for name, (members, cuts) in GROUPS.items():
        for place, result in enumerate(load(folder, name)):
            start, stop = cuts[place], cuts[place + 1]
            for margin, (extended, halo, gradient) in zip((0, 1, 3, 30), result["halos"], strict=True):
                first, last = max(0, start - margin), min(HEIGHT, stop + margin)
                torch.testing.assert_close(extended, whole[:, :, first:last], atol=0, rtol=0)
                assert halo == (start - first, last - stop)
                # A row counts once for every rank whose halo contains it.
                seen = torch.zeros(HEIGHT, dtype=whole.dtype)
                for other in range(len(members)):
                    seen[max(0, cuts[other] - margin) : cuts[other + 1] + margin] += 1
                expected = 3 * whole.square() * seen[:, None]
                torch.testing.assert_close(gradient, expected[:, :, start:stop])


def test_what_is_sent_does_not_grow_with_the_image(folder: Path) -> None:
    for result in load(folder, "end"):
        first, *others = result["traffic"]
        assert first["sweeps"] == 1
        assert others == [first, first]
        assert 0 < first["halo"] <= 2 * 2 * WIDTH * 4  # two rows of floats to each neighbour
        assert first["sums"] < 64 * 3 * 25 * 4 + 40 * 3 * 3 * 8  # candidates for landmarks, and small matrices


def test_refusals_for_rows_over_ranks(folder: Path) -> None:
    for result in load(folder, "end"):
        said = result["refusals"]
        for name in ("to_dense", "a loss"):
            assert said[name].startswith(f"{name} needs the whole image on one rank, got one that is spread over 3")
        for name, got in (("width", "[1, 1, 5, 64] on rank 1"), ("dtype", "[1, 1, 6, 64] on rank 1")):
            assert said[name].startswith("guide must have the batch, channels, width and dtype of the other ranks'")
            assert f"got {got}" in said[name]


def test_a_rank_that_is_gone_is_named_in_time(folder: Path) -> None:
    for place, result in enumerate(load(folder, "end")):
        for name in ("absent", "dead") if place < 2 else ():
            said, seconds = result[name]
            assert said == "rank 2 of 3 died or did not answer; start all ranks again"
            assert seconds < 60


def test_without_a_group() -> None:
    """Without a group the same functions work in one process and exchange nothing."""
    image = noise(1, 1, 6, 7)
    assert nonlocal_operator(image, num_landmarks=5, group=None).communicator is ALONE
    assert ALONE.with_halo(image, 2) == (image, (0, 0))
    assert all_gather_shapes(image, None) is ALONE
    with pytest.raises(TypeError, match=r"group must be a process group of torch.distributed"):
        nonlocal_operator(image, group="world")
