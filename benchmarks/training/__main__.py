"""Train the denoiser: ``python -m benchmarks.training [--pictures FOLDER] [--out FOLDER] [--steps N]``.

Starts from the weights of the package, and trains on pictures of scikit-image and on all pictures of a folder. Half of
the examples have white noise of 0 to 60 grey levels, the others noise as cameras make it, or almost none. Every 16th
picture of the folder is set aside, and judges the weights. ``--out`` contains

state.pt               the state: the same command resumes a stopped training, also with more steps;
latest.safetensors     the running mean of the weights;
denoiser.safetensors   the same where it was best;
curve.csv, curve.png   the loss, and the PSNR of examples set aside.

A checkpoint is written every 250 steps. ``--half`` computes convolutions in bfloat16, but for the last steps, which
takes 0.55 of the time on processors with AVX512-BF16. On a GPU (``--device cuda``), a step takes the same time with
many times as many crops (``--batch``); ``--workers`` is the number of processes that make them, ``--parts`` how many
crops they take from each simulated photograph. ``--plain`` trains the same network with a further convolution in place
of the filter, for comparison; its weights, like those of ``--scratch``, are drawn at random. Equal arguments give equal
weights on the same processor with the same number of threads; ``--workers`` does not matter.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from benchmarks.harness import options
from benchmarks.training.pictures import read_pictures
from benchmarks.training.training import BATCH, RATE, SIDE, Plan, Training
from nlfilter_torch.nn.denoiser.network import TRAINED


def read_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read and check the arguments."""
    parser = options("training", __doc__)
    add = parser.add_argument
    add("--pictures", type=Path, metavar="FOLDER", help="of pictures, beside those of scikit-image")
    add("--out", type=Path, default=Path("out/denoiser"), help="folder; default %(default)s")
    add("--steps", type=int, default=100_000, help="default %(default)s")
    add("--batch", type=int, default=BATCH, help="crops in a step; default %(default)s")
    add("--parts", type=int, default=1, help="crops from each simulated photograph; it divides --batch; default 1")
    add("--workers", type=int, default=0, help="processes that make examples; default: none")
    add("--device", default="cpu", help="on which to train, such as cuda; default %(default)s")
    add("--rate", type=float, default=RATE, help="learning rate; default %(default)s")
    add("--seed", type=int, default=0, help="of crops and noise; default %(default)s")
    add("--half", action="store_true", help="convolutions in bfloat16")
    add("--plain", action="store_true", help="a convolution in place of the filter")
    start = parser.add_mutually_exclusive_group()
    start.add_argument("--start", type=Path, metavar="FILE", help="initial weights; default: those of the package")
    start.add_argument("--scratch", action="store_true", help="draw the initial weights at random")
    chosen = parser.parse_args(arguments)
    if chosen.steps < 1:
        parser.error(f"--steps must be at least 1, got {chosen.steps}; 2000 give a first impression")
    if chosen.seed < 0:
        parser.error(f"--seed must not be negative, got {chosen.seed}; 0 will do")
    if chosen.workers < 0:
        parser.error(f"--workers must not be negative, got {chosen.workers}; 0 makes examples in this process")
    if chosen.parts < 1 or chosen.batch < 1 or chosen.batch % chosen.parts:
        parser.error(f"--batch must be a multiple of --parts, both at least 1, got {chosen.batch} and {chosen.parts}")
    if chosen.device != "cpu" and not torch.cuda.is_available():
        parser.error(f"--device must be cpu where there is no CUDA device, got {chosen.device}; leave it out")
    if not 0 < chosen.rate < 1:
        parser.error(f"--rate must be between 0 and 1, got {chosen.rate}; {RATE} does well")
    if chosen.start is not None and not chosen.start.is_file():
        parser.error(f"--start must be a file of weights, got {chosen.start}, which is not there; train one first")
    if chosen.pictures is not None and not chosen.pictures.is_dir():
        parser.error(f"--pictures must be a folder, got {chosen.pictures}; leave it out for those of scikit-image")
    if chosen.out.exists() and not chosen.out.is_dir():
        parser.error(f"--out must be a folder, got the file {chosen.out}; name another")
    return chosen


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, and save the results."""
    chosen = read_options(arguments)
    chosen.out.mkdir(parents=True, exist_ok=True)
    start = None if chosen.scratch or (chosen.plain and chosen.start is None) else chosen.start or TRAINED
    plan = Plan(
        chosen.steps,
        chosen.rate,
        chosen.seed,
        plain=chosen.plain,
        half=chosen.half,
        side=SIDE,
        start=start,
        batch=chosen.batch,
        parts=chosen.parts,
        device=chosen.device,
        workers=chosen.workers,
    )
    pictures, aside = read_pictures(chosen.pictures)
    training = Training(plan, pictures, aside)
    state = chosen.out / "state.pt"
    if state.exists():
        training.load(torch.load(state, weights_only=True))
        print(f"resumed at step {training.number}")
    weights = sum(parameter.numel() for parameter in training.model.parameters())
    print(f"{weights} weights, {len(pictures.pictures)} pictures, {torch.get_num_threads()} threads", flush=True)
    training.run(chosen.out)


if __name__ == "__main__":
    main()
