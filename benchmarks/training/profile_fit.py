"""Fit of the network that estimates noise, to the parts of :mod:`benchmarks.training.noise_profiles`."""

from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor

from nlfilter_torch.nn.denoiser.estimate import FAINTEST, HIDDEN, INPUTS, SHAPES, inputs_of, network

STEPS, BATCH, RATE, DECAY = 8000, 256, 3e-3, 0.1
BLUR, DROPOUT = 0.05, 0.1  # noise of the inputs; share of hidden numbers that are 0, in training
NOISY, CLEAN = 0.7, 0.4  # grey levels above and below which a picture counts as noisy or clean
WEIGHTS = (1.0, 1.0, 1.0, 0.7, 0.5)  # of the scales: true levels of coarse ones are uncertain
ROBUST, LEVELS_SHARE = 0.2, 5.0  # logarithm from which errors count linearly; weight of levels beside that of texture


@dataclass(frozen=True)
class Table:
    """Pictures as the network sees them.

    Attributes:
        inputs: (N, K, INPUTS).
        shares: (N, K), of the pixels near each brightness.
        levels: true levels (N, K, S, 2) in grey levels.
        level: true deviation (N,) in grey levels.
        kind: (N,).
    """

    inputs: Tensor
    shares: Tensor
    levels: Tensor
    level: Tensor
    kind: Tensor

    @classmethod
    def read(cls, folder: Path, name: str) -> "Table":
        """Read the parts of a name."""
        parts = [torch.load(path) for path in sorted(folder.glob(f"{name}*.pt"))]
        rows = {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
        inputs, shares = inputs_of(rows["statistics"].float(), rows["shares"]), rows["shares"].mean(2)
        levels = 255 * rows["levels"].permute(0, 3, 1, 2)
        squares = overall(levels, shares)[:, 0].square()
        table = cls(inputs, shares, levels, (squares[:, 0] + 2 / 3 * squares[:, 1]).sqrt(), rows["kind"])
        finite = inputs.flatten(1).isfinite().all(1) & levels.flatten(1).isfinite().all(1)
        return table.at((finite & (shares.sum(1) > 0.5)).nonzero()[:, 0])

    def at(self, rows: Tensor) -> "Table":
        """Some of the pictures."""
        return Table(self.inputs[rows], self.shares[rows], self.levels[rows], self.level[rows], self.kind[rows])


def overall(levels: Tensor, shares: Tensor) -> Tensor:
    """Root mean square (N, S, 2) over brightnesses of levels (N, K, S, 2)."""
    weights = shares[..., None, None] / shares.sum(1).clamp(min=1e-9)[:, None, None, None]
    return (levels.square() * weights).sum(1).sqrt()


def losses(weights: dict[str, Tensor], table: Table, inputs: Tensor) -> tuple[Tensor, Tensor]:
    """Errors of the levels of noisy pictures, and of telling them from clean ones."""
    logarithms, numbers = network(weights, inputs)
    noisy = (table.level > (NOISY + CLEAN) / 2).float()
    errors = logarithms - (table.levels + FAINTEST).log()
    counted = table.shares.sqrt() * (table.shares > 0.02) * noisy[:, None]
    scales = counted[..., None, None] * torch.tensor(WEIGHTS)[:, None]
    level = (F.huber_loss(errors, torch.zeros_like(errors), reduction="none", delta=ROBUST) * scales).sum()
    sure = ((table.level > NOISY) | (table.level < CLEAN)).float()
    certainty = (numbers * table.shares).sum(1)
    told = (F.binary_cross_entropy_with_logits(certainty, noisy, reduction="none") * sure).mean()
    return level / (2 * scales.sum()).clamp(min=1e-9), told


def initial(table: Table) -> dict[str, Tensor]:
    """Random weights, for inputs of mean 0 and variance 1."""
    torch.manual_seed(0)
    layers = {
        name: torch.nn.Linear(*size)
        for name, size in (("first", (INPUTS, HIDDEN)), ("second", (HIDDEN, HIDDEN)), ("last", (HIDDEN, 11)))
    }
    weights = {"mean": table.inputs.mean((0, 1)), "scale": table.inputs.std((0, 1)).clamp(min=0.05)}
    for name, layer in layers.items():
        weights |= {f"{name}.weight": layer.weight.detach(), f"{name}.bias": layer.bias.detach()}
    return weights


def fit(folder: Path, out: Path) -> None:
    """Train on the parts in a folder, print errors on those held out, and write the weights."""
    table, apart = Table.read(folder, "train"), Table.read(folder, "held")
    weights = initial(table)
    trained = [value.requires_grad_() for name, value in weights.items() if "." in name]
    optimizer = torch.optim.AdamW(trained, RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=STEPS)
    for step in range(1, STEPS + 1):
        batch = table.at(torch.randint(len(table.kind), (BATCH,)))
        dropped = dict(weights)
        kept = (torch.rand(HIDDEN) >= DROPOUT).float() / (1 - DROPOUT)
        dropped["last.weight"] = weights["last.weight"] * kept
        level, told = losses(dropped, batch, batch.inputs + BLUR * torch.randn_like(batch.inputs))
        optimizer.zero_grad()
        (LEVELS_SHARE * level + told).backward()
        optimizer.step()
        schedule.step()
        if step % 1000 == 0:
            with torch.no_grad():
                values = [float(value) for pair in (losses(weights, apart, apart.inputs),) for value in pair]
            print(f"{step}: loss {float(level.detach()):.4f} {float(told.detach()):.3f}, held out {values}", flush=True)
    with torch.no_grad():
        report(weights, apart)
    save_file({name: weights[name].detach().contiguous() for name in SHAPES}, out)


def report(weights: dict[str, Tensor], table: Table) -> None:
    """Print errors by kind of noise."""
    logarithms, numbers = network(weights, table.inputs)
    estimates = overall((logarithms.exp() - FAINTEST).clamp(min=0), table.shares)
    certain = (numbers * table.shares).sum(1) > 0
    truth = overall(table.levels, table.shares)
    for kind in table.kind.unique().tolist():
        rows = table.kind == kind
        print(f"kind {kind}: {int(rows.sum())} pictures, {float(certain[rows].float().mean()):.2f} called noisy")
        rows &= table.level > NOISY
        for plane, name in enumerate(("luminance", "colour")) if bool(rows.any()) else ():
            ratio = estimates[rows, :, plane] / truth[rows, :, plane].clamp(min=1e-9)
            ratio = ratio[truth[rows, 0, plane] > CLEAN]
            errors = [round(float(value), 3) for value in (ratio - 1).abs().median(0).values]
            print(f"  {name}: median {[round(float(v), 2) for v in ratio.median(0).values]}, error {errors}")
