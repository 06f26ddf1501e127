"""Curves of landmarks that are held: ``python -m docs.landmarks_training docs/landmarks_training.png``."""

import sys
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.layers.landmarks import BANDWIDTH, CHOICES, SIDE, Choice, crop, recover
from benchmarks.photographs import photograph


def draw(path: Path, side: int = SIDE) -> None:
    """Draw the loss over the bandwidth and the course of L-BFGS."""
    image = crop(photograph("coffee"), side)
    plot = Figure(figsize=(9, 3.4), dpi=100, layout="constrained")
    near, course = plot.subplots(1, 2)
    for choice in CHOICES:
        line = loss_near(choice, image, [1 + 5e-4 * place / 20 for place in range(-20, 21)])
        near.plot(
            [5e-4 * place / 20 for place in range(-20, 21)], [value / line[20] for value in line], label=choice.name
        )
        course.semilogy(recover(choice, image).errors, label=choice.name)
    near.set(xlabel="relative change of the bandwidth", ylabel="loss, relative")
    near.ticklabel_format(axis="x", style="sci", scilimits=(0, 0))
    course.set(xlabel="evaluations of L-BFGS", ylabel="error of sliders and bandwidth")
    course.legend(fontsize=8)
    for axis in (near, course):
        axis.grid(alpha=0.3)
    plot.savefig(path)


def loss_near(choice: Choice, image: Tensor, factors: list[float]) -> list[float]:
    """The loss for multiples of the bandwidth."""
    layer, losses = choice.layer(image, bandwidth=BANDWIDTH), []
    with torch.no_grad():
        for factor in factors:
            layer.affinity.photometric_bandwidth = factor * BANDWIDTH
            losses.append(float((layer(image) - image).square().mean()))
    return losses


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
