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

from benchmarks.training.pictures import read_pictures
from benchmarks.training.training import BATCH, RATE, SIDE, Plan, Training
from nlfilter_torch.nn.denoiser.network import TRAINED


def read_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read and check the arguments."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.training", description="Train the denoiser.")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="of pictures, beside those of scikit-image")
    parser.add_argument("--out", type=Path, default=Path("out/denoiser"), help="folder; default %(default)s")
    parser.add_argument("--steps", type=int, default=100_000, help="default %(default)s")
    parser.add_argument("--batch", type=int, default=BATCH, help="crops in a step; default %(default)s")
    parser.add_argument(
        "--parts", type=int, default=1, help="crops from each simulated photograph; it divides --batch; default 1"
    )
    parser.add_argument("--workers", type=int, default=0, help="processes that make examples; default: none")
    parser.add_argument("--device", default="cpu", help="on which to train, such as cuda; default %(default)s")
    parser.add_argument("--rate", type=float, default=RATE, help="learning rate; default %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of crops and noise; default %(default)s")
    parser.add_argument("--half", action="store_true", help="convolutions in bfloat16")
    parser.add_argument("--plain", action="store_true", help="a convolution in place of the filter")
    start = parser.add_mutually_exclusive_group()
    start.add_argument("--start", type=Path, metavar="FILE", help="initial weights; default: those of the package")
    start.add_argument("--scratch", action="store_true", help="draw the initial weights at random")
    options = parser.parse_args(arguments)
    if options.steps < 1:
        parser.error(f"--steps must be at least 1, got {options.steps}; 2000 give a first impression")
    if options.seed < 0:
        parser.error(f"--seed must not be negative, got {options.seed}; 0 will do")
    if options.workers < 0:
        parser.error(f"--workers must not be negative, got {options.workers}; 0 makes examples in this process")
    if options.parts < 1 or options.batch < 1 or options.batch % options.parts:
        parser.error(f"--batch must be a multiple of --parts, both at least 1, got {options.batch} and {options.parts}")
    if options.device != "cpu" and not torch.cuda.is_available():
        parser.error(f"--device must be cpu where there is no CUDA device, got {options.device}; leave it out")
    if not 0 < options.rate < 1:
        parser.error(f"--rate must be between 0 and 1, got {options.rate}; {RATE} does well")
    if options.start is not None and not options.start.is_file():
        parser.error(f"--start must be a file of weights, got {options.start}, which is not there; train one first")
    if options.pictures is not None and not options.pictures.is_dir():
        parser.error(f"--pictures must be a folder, got {options.pictures}; leave it out for those of scikit-image")
    if options.out.exists() and not options.out.is_dir():
        parser.error(f"--out must be a folder, got the file {options.out}; name another")
    return options


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, and save the results."""
    options = read_options(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    start = None if options.scratch or (options.plain and options.start is None) else options.start or TRAINED
    plan = Plan(
        options.steps,
        options.rate,
        options.seed,
        plain=options.plain,
        half=options.half,
        side=SIDE,
        start=start,
        batch=options.batch,
        parts=options.parts,
        device=options.device,
        workers=options.workers,
    )
    pictures, aside = read_pictures(options.pictures)
    training = Training(plan, pictures, aside)
    state = options.out / "state.pt"
    if state.exists():
        training.load(torch.load(state, weights_only=True))
        print(f"resumed at step {training.number}")
    weights = sum(parameter.numel() for parameter in training.model.parameters())
    print(f"{weights} weights, {len(pictures.pictures)} pictures, {torch.get_num_threads()} threads", flush=True)
    training.run(options.out)


if __name__ == "__main__":
    main()
