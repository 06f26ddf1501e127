"""How well denoisers work and what they take, ours beside others: ``python -m benchmarks.denoising``.

On photographs that were not used in training, with white noise of 5, 15, 25 and 50 grey levels, in grey and in colour:
PSNR, SSIM and CPU seconds of

ours             ``denoise``, given the noise level; the mean over four rotations; with estimated noise;
rule             ``denoise(method="rule")``: sliders by rule, nothing learned;
BM3D, CBM3D      package ``bm3d``, which may be used for non-commercial purposes only; left out where not installed;
scikit-image     ``denoise_nl_means``, cycle-spun wavelets, and ``denoise_tv_chambolle`` with the best of five weights
                 for each photograph;
OpenCV           ``fastNlMeansDenoising`` on 8 bits, with the best of four strengths for each photograph;
plain            the network without the filter, with ``--plain FILE`` of ``benchmarks.training --plain``.

``--methods``, ``--noise`` and ``--kinds`` select a part of it; results are added to the file ``--out``, from which
``python -m docs.denoising_tables`` makes tables. ``--weights FILE`` evaluates other weights than those of the
package, and may be given several times. Without ``--pictures``, the photographs are camera, coffee, chelsea and the
left halves of retina and page. ``--wrong`` adds noise levels misstated by a fifth, noise that depends on brightness,
and clean photographs. ``--megapixel`` measures only the CPU time and memory of ours and of BM3D at a megapixel.

``--set FOLDER`` measures on the public sets of the literature (BSD68, Set12, CBSD68, Kodak24, McMaster, Urban100), by
the protocol that :mod:`benchmarks.denoising.sets` states; the tables of its ``--out`` are beside published figures. The
set is recognised by the folder's name or by the number of pictures, unless ``--name`` tells it. ``--patterns`` compares
on repeated patterns that were kept aside from training: what the filter adds, beside non-local means, BM3D and, with
``--plain FILE``, the network without the filter.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.denoising import sets
from benchmarks.denoising.cases import NOISE, Case, Method, scenes, table, with_noise
from benchmarks.denoising.claims import megapixel, misstated
from benchmarks.denoising.methods import METHODS, available, network
from benchmarks.harness import options, save_json
from nlfilter_torch import NonlocalDenoiser


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = options("denoising", "Comparison of denoisers.", "small parts of two photographs")
    add = parser.add_argument
    add("--pictures", type=Path, help="folder of photographs; default: those of scikit-image")
    add("--set", type=Path, help="folder of a public set, compared by the literature's protocol")
    add("--name", choices=sets.NAMES, help="of the set, where it is not recognised")
    add("--patterns", action="store_true", help="repeated patterns, drawn and of photographs")
    add("--noise", type=float, nargs="+", help=f"in grey levels; default: {NOISE}; for a set {sets.LEVELS}")
    add("--kinds", nargs="+", choices=("grey", "colour"), help="default: both, where there are both")
    add("--weights", type=Path, action="append", default=[], help="weights of further networks to compare")
    add("--plain", type=Path, action="append", default=[], help="weights of networks without the filter")
    add("--methods", nargs="+", choices=METHODS, help="default: all")
    add("--wrong", action="store_true", help="also test misstated and estimated noise, and clean photographs")
    add("--megapixel", action="store_true", help="only CPU time and memory at a megapixel, for the first noise level")
    add("--out", type=Path, help="JSON file to which all measurements are added")
    return parser.parse_args(arguments)


def chosen(options: argparse.Namespace, default: Sequence[str]) -> dict[str, Method]:
    """The methods to compare, those with other weights included."""
    methods = available(options.methods or default)
    methods |= {path.parent.name: network(path) for path in options.weights}
    return methods | {
        "plain" if path.parent.name == "plain" else f"plain, {path.parent.name}": network(path, plain=True)
        for path in options.plain
    }


def compare_on_photographs(options: argparse.Namespace) -> None:
    """Print tables on photographs that are reduced to a moderate size."""
    methods = chosen(options, tuple(METHODS))
    figures: dict[str, dict[str, Any]] = {}
    if options.out is not None and options.out.exists():
        figures = json.loads(options.out.read_text())
    for kind in options.kinds or ("grey", "colour"):
        clean = scenes(options.pictures, kind, quick=options.quick)
        for level in options.noise or NOISE:
            noise = level / 255
            cases = [
                Case(name, image, with_noise(image, noise, i), noise) for i, (name, image) in enumerate(clean.items())
            ]
            print(f"\n{kind}, noise {level:g}")
            rows = table(methods, cases)
            figures.setdefault(f"{kind}, {level:g}", {}).update(
                {name: {scene: asdict(result) for scene, result in row.items()} for name, row in rows.items()}
            )
            save_json(options.out, figures)
        if options.wrong:
            misstated(network(None), clean)


def compare_on_set(options: argparse.Namespace) -> None:
    """Measure on a public set, or add to what was measured on it."""
    pictures = sets.recognise(options.set, options.name, options.kinds)
    content: dict[str, Any] = {"set": pictures.name, "results": {}}
    if options.out is not None and options.out.exists():
        content = json.loads(options.out.read_text())
        if content.get("set") != pictures.name:
            raise SystemExit(f"--out must have results of {pictures.name}, but {options.out} has others; name another")
    content["weights"] = sum(value.numel() for value in NonlocalDenoiser.trained().parameters())
    methods, levels = chosen(options, sets.COMPARED), options.noise or sets.LEVELS
    for _ in sets.measure(pictures.pictures, pictures.kinds, levels, methods, content["results"]):
        save_json(options.out, content)


def compare_on_patterns(options: argparse.Namespace) -> None:
    """Measure on repeated patterns for each kind and level."""
    content: dict[str, Any] = {"patterns": sets.SEED, "results": {}}
    pictures = partial(sets.patterns, folder=options.pictures, quick=options.quick)
    kinds, levels = options.kinds or ("grey", "colour"), options.noise or (sets.PATTERN_LEVEL,)
    for _ in sets.measure(pictures, kinds, levels, chosen(options, sets.PATTERNS_COMPARED), content["results"]):
        save_json(options.out, content)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    options = parse(arguments)
    if options.megapixel:
        megapixel((options.noise or NOISE)[0], quick=options.quick)
    elif options.patterns:
        compare_on_patterns(options)
    elif options.set is not None:
        compare_on_set(options)
    else:
        compare_on_photographs(options)


if __name__ == "__main__":
    main()
