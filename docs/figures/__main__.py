"""``python -m docs.figures [--only 12,13] [--out out/figures] [--quick]``: PNG files, captions and JSON."""

import argparse
import inspect
import json
import time
from pathlib import Path

import torch

from docs.figures import FIGURES, SIZE
from nlfilter_torch.photo.files.writing import open_beside
from nlfilter_torch.photo.plotting import save_figure

QUICK = 72  # longer side of a photograph, in pixels


def main(arguments: list[str] | None = None) -> None:
    """Draw the figures, and print and save their captions and numbers."""
    parser = argparse.ArgumentParser(description="Counterparts of the paper's figures.")
    parser.add_argument("--only", metavar="NAMES", help=f"some of {', '.join(FIGURES)}, separated by commas")
    parser.add_argument("--out", type=Path, default=Path("out/figures"), help="folder for the figures")
    parser.add_argument("--quick", action="store_true", help=f"photographs of {QUICK} pixels, to check that it runs")
    options = parser.parse_args(arguments)
    chosen = options.only.split(",") if options.only else list(FIGURES)
    unknown = [name for name in chosen if name not in FIGURES]
    if unknown:
        parser.error(f"--only must name figures among {', '.join(FIGURES)}, got {', '.join(unknown)}")
    options.out.mkdir(parents=True, exist_ok=True)
    kept = {}
    for name in chosen:
        start = time.process_time()
        with torch.no_grad():
            figure, numbers = FIGURES[name](size=QUICK if options.quick else SIZE)
        path = options.out / f"figure-{name}.png" if name.isdecimal() else options.out / f"{name}.png"
        save_figure(figure, path)
        caption = " ".join(inspect.getdoc(FIGURES[name]).split())
        kept[name] = {"caption": caption, "numbers": numbers, "picture": path.name}
        heading = f"Figure {name}" if name.isdecimal() else name.replace("-", " ").capitalize()
        print(f"\n{heading}. {caption}  [{path}, {time.process_time() - start:.1f} s]")
        show(numbers)
    with open_beside(options.out / "figures.json") as stream:
        stream.write((json.dumps(kept, indent=1, ensure_ascii=False) + "\n").encode())


def show(numbers: dict[str, object], indent: str = "  ") -> None:
    """Print nested numbers, one line per value or per innermost dictionary."""
    for name, value in numbers.items():
        if isinstance(value, dict) and any(isinstance(inner, dict) for inner in value.values()):
            print(f"{indent}{name}")
            show(value, indent + "  ")
        elif isinstance(value, dict):
            print(f"{indent}{name}: " + ", ".join(f"{key} {inner}" for key, inner in value.items()))
        else:
            print(f"{indent}{name}: {value}")


if __name__ == "__main__":
    main()
