"""``nlfilter-torch detail``: raise or lower the details of a photograph, scale by scale."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer

from nlfilter_torch.cli import options
from nlfilter_torch.core.memory import working_bytes
from nlfilter_torch.edits.presets import PRESETS, find_preset


def use_preset(context: typer.Context, name: str | None) -> str | None:
    """Let the preset's entries take the place of the options' defaults."""
    if name is not None:
        entries = asdict(find_preset(name))
        alpha = ",".join(map(str, entries.pop("alpha")))
        context.default_map = {"alpha": alpha, **{k: v for k, v in entries.items() if v is not None}}
    return name


Spread = Annotated[
    float,
    typer.Option(
        min=0.05,
        max=20.0,
        metavar="TIME",
        help="How far the edit of a region spreads to what is less like it: 0.5 little, 5 far.",
    ),
]
PresetName = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|FILE",
        callback=use_preset,
        is_eager=True,
        help=f"One of {', '.join(PRESETS)} (`nlfilter-torch presets` describes them), or a file that "
        "`nlfilter-torch fit` made, in place of the defaults here; options that are given count for more.",
    ),
]


def detail(
    source: options.Source,
    target: options.Target,
    alpha: options.Alpha = "3,3,4,1.05",
    bandwidth: options.Bandwidth = "auto",
    residual: options.Residual = None,
    channels: options.Edited = options.Channels.luminance,
    depth: options.OutputDepth = None,
    spatial_bandwidth: options.SpatialBandwidth = None,
    patch_size: options.PatchSize = 5,
    landmarks: options.Landmarks = 100,
    sampling: options.LandmarkSampling = options.Sampling.kmeans,
    seed: options.Seed = 0,
    preset: PresetName = None,
    region: options.SliderRegions = None,
    mask: options.MaskFile = None,
    spread: Spread = 1.0,
    memory: options.Memory = None,
    full: options.Full = False,
) -> None:
    """Make the details of a photograph stronger or weaker, each size of them by a slider of its own.

    Colours stay as they are where nothing clips, and so do the file's depth, transparency, colour profile and notes of
    the camera (EXIF). Photographs that fit no memory are worked out in tiles; best as TIFF files or arrays of zarr,
    read in parts.

    Sharpen strongly: `nlfilter-torch detail in.jpg out.jpg --alpha 3,3,4,1.05`

    A look with a name: `nlfilter-torch detail in.jpg out.jpg --preset crisp`

    Smooth skin or noise away: `nlfilter-torch detail in.jpg out.jpg --alpha 0.2,0.5,1,1 --bandwidth 10`

    Sharpen all that looks like a spot: `nlfilter-torch detail in.jpg out.jpg --region 60,300,20,20`

    By the name of a look: `nlfilter-torch detail in.jpg out.jpg --preset "soft skin"` (see `nlfilter-torch presets`)

    Edit like another photograph: `nlfilter-torch detail in.jpg out.jpg --preset look.json` (see `nlfilter-torch fit`)
    """
    numbers = options.parse_alpha(alpha)
    grey_levels = options.parse_bandwidth(bandwidth)

    import torch
    from torch import Tensor

    from nlfilter_torch.cli import editing
    from nlfilter_torch.cli import scribble_rows as painted_rows
    from nlfilter_torch.cli import scribbles as painting
    from nlfilter_torch.cli.progress import steps
    from nlfilter_torch.cli.tiled import Job, allowed_memory, edit_by_rows, read_if_it_fits
    from nlfilter_torch.edits.colour import edit_luminance
    from nlfilter_torch.edits.detail import colour_masks
    from nlfilter_torch.filtering.filters import filter_regions, polynomial_filter
    from nlfilter_torch.io.photographs import check_output, write_photograph
    from nlfilter_torch.operator.features import reduce_channels
    from nlfilter_torch.tiled.detail import detail_rows
    from nlfilter_torch.tiled.sources import Rows

    sliders = torch.tensor(numbers)
    # A mask is worked out before the filter, from coordinates as large as a factor beside its own factor.
    needed = working_bytes(landmarks, patch_size, factors=2 if region or mask else 1)
    allowed = allowed_memory(memory)
    with steps(4) as begin:
        begin("Reading")
        photograph = read_if_it_fits(source, target, needed, allowed)
        if photograph is not None:
            edited = photograph if depth is None else replace(photograph, depth=options.DEPTHS[depth])
            check_output(target, edited)

            begin("Comparing patches")
            image = photograph.pixels
            selected = painting.slider_regions(photograph, mask, region, sliders)
            if selected is not None:
                regions, own = selected
                masks = colour_masks(
                    image,
                    regions,
                    time=spread,
                    num_landmarks=landmarks,
                    spatial_bandwidth=spatial_bandwidth,
                    generator=torch.Generator().manual_seed(seed),
                )
            operator = editing.build_operator(
                reduce_channels(image, "luminance"),
                bandwidth=grey_levels,
                spatial_bandwidth=spatial_bandwidth,
                patch_size=patch_size,
                landmarks=landmarks,
                sampling=sampling,
                seed=seed,
            )

            begin("Filtering")

            def edit(planes: Tensor) -> Tensor:
                if selected is None:
                    return polynomial_filter(operator, planes, sliders, residual=residual)
                return filter_regions(operator, planes, masks, own, residual=residual)

            pixels = edit_luminance(image, edit) if channels is options.Channels.luminance else edit(image)

            begin("Writing")
            write_photograph(edited.with_pixels(pixels), target)
            return

    def by_rows(job: Job) -> Rows:
        regions, own = painted_rows.region_rows(job, mask, region, sliders)
        return detail_rows(
            job.passes(full),
            job.picture.rows,
            own,
            regions,
            name=source,
            residual=residual,
            time=spread,
            channels=channels.value,
            photometric_bandwidth=grey_levels,
            spatial_bandwidth=spatial_bandwidth,
            patch_size=patch_size,
            num_landmarks=landmarks,
            landmarks=sampling.value,
            generator=torch.Generator().manual_seed(seed),
        )

    edit_by_rows(Path(source), Path(target), None if depth is None else options.DEPTHS[depth], allowed, by_rows)
