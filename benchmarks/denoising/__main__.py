"""Comparison of denoisers: ``python -m benchmarks.denoising [--pictures FOLDER] [--methods NAMES] [--out FILE]``.

On photographs that were not used in training, with white noise of 5, 15, 25 and 50 grey levels, in grey and in colour:
PSNR, SSIM and CPU seconds of

ours             ``denoise``, given the noise level; the mean over four rotations; with estimated noise;
rule             ``denoise(method="rule")``: sliders by rule, nothing learned;
BM3D, CBM3D      package ``bm3d``, which may be used for non-commercial purposes only; left out where not installed;
scikit-image     ``denoise_nl_means``, cycle-spun wavelets, and ``denoise_tv_chambolle`` with the best of five weights
                 for each photograph;
OpenCV           ``fastNlMeansDenoising`` on 8 bits, with the best of four strengths for each photograph;
plain            the network without the filter, with ``--plain FILE`` of ``benchmarks.denoiser_training --plain``.

``--methods``, ``--noise`` and ``--kinds`` select a part of it; results are added to the file ``--out``, from which
``python -m benchmarks.denoising_tables`` makes tables. ``--weights FILE`` evaluates other weights than those of the
package, and may be given several times. Without ``--pictures``, the photographs are camera, coffee, chelsea and the
left halves of retina and page. ``--wrong`` adds noise levels misstated by a fifth, noise that depends on brightness,
and clean photographs. ``--megapixel`` measures only the CPU time and memory of ours and of BM3D at a megapixel.

``--set FOLDER --published`` is for the public sets of the literature (BSD68, Set12, CBSD68, Kodak24, McMaster,
Urban100): it prints a table with the published figures of other denoisers beside those measured here, by the protocol
that :mod:`benchmarks.denoising.sets` states. The set is recognised by the folder's name or by the number of pictures,
unless ``--name`` tells it.

``--patterns`` compares on repeated patterns that were kept aside from training (:mod:`benchmarks.denoising.patterns`):
what the filter adds, beside non-local means, BM3D and, with ``--plain FILE``, the network without the filter.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.denoising import patterns, sets
from benchmarks.denoising.cases import NOISE, Case, scenes, with_noise
from benchmarks.denoising.claims import megapixel, misstated
from benchmarks.denoising.measuring import table
from benchmarks.denoising.methods import METHODS, Method, available, network
from benchmarks.denoising.published import LEVELS
from nlfilter_torch import NonlocalDenoiser
from nlfilter_torch.photo.files.writing import open_beside


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.denoising", description="Comparison of denoisers.")
    parser.add_argument("--pictures", type=Path, help="folder of photographs; default: those of scikit-image")
    parser.add_argument("--set", type=Path, help="folder of a public set, compared by the literature's protocol")
    parser.add_argument("--name", choices=sets.NAMES, help="of the set, where it is not recognised")
    parser.add_argument("--patterns", action="store_true", help="repeated patterns, drawn and of photographs")
    parser.add_argument("--published", action="store_true", help="figures of the literature in the table of a set")
    parser.add_argument(
        "--noise", type=float, nargs="+", help=f"noise levels in grey levels; default: {NOISE}; for a set {LEVELS}"
    )
    parser.add_argument("--kinds", nargs="+", choices=("grey", "colour"), help="default: both, where there are both")
    parser.add_argument(
        "--weights", type=Path, action="append", default=[], help="weights of further networks to compare"
    )
    parser.add_argument(
        "--plain", type=Path, action="append", default=[], help="weights of networks without the filter"
    )
    parser.add_argument("--methods", nargs="+", choices=METHODS, help="default: all")
    parser.add_argument(
        "--wrong", action="store_true", help="also test misstated and estimated noise, and clean photographs"
    )
    parser.add_argument(
        "--megapixel", action="store_true", help="only CPU time and memory at a megapixel, for the first noise level"
    )
    parser.add_argument("--quick", action="store_true", help="small parts of two photographs, to check that it runs")
    parser.add_argument("--out", type=Path, help="JSON file to which all measurements are added")
    return parser.parse_args(arguments)


def chosen(options: argparse.Namespace, default: Sequence[str]) -> dict[str, Method]:
    """The methods to compare, those with other weights included."""
    methods = available(options.methods or default)
    methods |= {path.parent.name: network(path) for path in options.weights}
    return methods | {
        "plain" if path.parent.name == "plain" else f"plain, {path.parent.name}": network(path, plain=True)
        for path in options.plain
    }


def save(path: Path | None, content: object) -> None:
    """Write a JSON file, if there is to be one."""
    if path is not None:
        with open_beside(path) as stream:
            stream.write(json.dumps(content, indent=1).encode())


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
            save(options.out, figures)
        if options.wrong:
            misstated(network(None), clean)


def compare_on_set(options: argparse.Namespace) -> None:
    """Print a table for each kind of picture of a public set."""
    pictures = sets.recognise(options.set, options.name, options.kinds)
    content: dict[str, Any] = {"set": pictures.name, "results": {}}
    if options.out is not None and options.out.exists():
        content = json.loads(options.out.read_text())
        if content.get("set") != pictures.name:
            raise SystemExit(f"--out must have results of {pictures.name}, but {options.out} has others; name another")
    content["weights"] = sum(value.numel() for value in NonlocalDenoiser.trained().parameters())
    methods = chosen(options, sets.COMPARED)
    for _ in sets.measure(pictures, methods, options.noise or LEVELS, content["results"]):
        save(options.out, content)
    for kind in pictures.kinds:
        print(f"\n{sets.set_table(content, kind, quoted=options.published)}")


def compare_on_patterns(options: argparse.Namespace) -> None:
    """Print a table of repeated patterns for each kind and level."""
    kinds, levels = options.kinds or ("grey", "colour"), options.noise or (patterns.LEVEL,)
    methods = chosen(options, patterns.COMPARED)
    results = patterns.compare(methods, kinds, levels, options.pictures, quick=options.quick)
    content = {"patterns": patterns.SEED, "results": results}
    save(options.out, content)
    for key in results:
        print(f"\n{patterns.pattern_table(content, key)}")


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
