"""``nlfilter-torch frames``: one edit for all frames of a film, without flicker."""

from pathlib import Path
from typing import Annotated, Any

import typer

from nlfilter_torch.cli import options
from nlfilter_torch.cli.edits import PresetName, step_of, with_options
from nlfilter_torch.core.memory import working_bytes
from nlfilter_torch.edits.parameters import EDITS

Frames = Annotated[
    Path, typer.Argument(metavar="FRAMES", help="A folder of photographs, taken in the order of their names.")
]
Edited = Annotated[
    Path, typer.Argument(metavar="OUTDIR", help="The folder for the edited ones; it is made if it is not there.")
]
References = Annotated[
    int,
    typer.Option(
        min=1,
        metavar="N",
        help="Number of frames, spread over the film, that the filter learns from. More for scenes that change.",
    ),
]


@with_options(*(p.name for p in EDITS["detail"] if p.is_option and p.name not in ("reach", "tolerance")))
def frames(
    folder: Frames,
    target: Edited,
    references: References = 3,
    seed: options.Seed = 0,
    preset: PresetName = None,
    **given: Any,
) -> None:
    """Edit the details of all frames of a film alike, so that nothing flickers.

    The sliders are those of `nlfilter-torch detail`; the filter is made once, and each frame is edited with it. Every
    file keeps its name, type, depth, transparency, colour profile and notes of the camera.

    By sliders: `nlfilter-torch frames shots edited --alpha 2,2,2,1`

    By the name of a look, or a file: `nlfilter-torch frames shots edited --preset crisp`
    """
    step = step_of(EDITS["detail"], given)

    import torch

    from nlfilter_torch.cli.folders import pictures
    from nlfilter_torch.cli.progress import steps
    from nlfilter_torch.edits.applying import seeded
    from nlfilter_torch.edits.detail import options_of
    from nlfilter_torch.edits.frames import filter_frames
    from nlfilter_torch.io.photographs import Photograph, check_folder, check_output, read_photograph, write_photograph

    paths = pictures(folder, "frames")
    if target.exists() and target.resolve() == folder.resolve():
        raise ValueError(f"{target} must be another folder than that of the frames; name a new one")
    check_folder(target)
    needed = (1 + min(references, len(paths))) * working_bytes(step["landmarks"], step["patch_size"])
    with steps(len(paths) + 1) as begin:
        begin("Learning from some frames")
        spread = torch.linspace(0, len(paths) - 1, min(references, len(paths))).round().long().tolist()
        samples = [read_photograph(paths[i], bytes_per_pixel=needed).pixels for i in spread]
        films: list[Photograph] = []  # the one that is being edited

        def read(path: Path) -> torch.Tensor:
            begin(path.name)
            films[:] = [read_photograph(path, bytes_per_pixel=needed)]
            check_output(target.parent / path.name, films[0])
            return films[0].pixels

        edited = filter_frames(
            map(read, paths),
            torch.tensor(step["alpha"]),
            references=samples,
            residual=step["residual"],
            channels=step["channels"],
            threshold=step["threshold"] / 255,
            limits=step["limits"],
            viewing_size=step["viewing_size"],
            **options_of(step.changed(spatial_bandwidth=step["spatial_bandwidth"] or "none"), (0, 0)),
            generator=seeded(seed),
        )
        target.mkdir(exist_ok=True)
        for path, pixels in zip(paths, edited, strict=True):
            write_photograph(films[0].with_pixels(pixels), target / path.name)
    typer.echo(f"{len(paths)} frames in {target}")
