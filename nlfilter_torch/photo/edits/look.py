"""A look, as found by :func:`fit_look`: sliders of detail, tone curves, colours, levels and local contrast."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import EVERYWHERE, Inner
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.options import Completion, GuideChannels, Sampling
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.shared_parameters import LOOK
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.looks.histogram import LocalCurves, Stretch, ramps, tones
from nlfilter_torch.photo.looks.look_filter import (
    BAND_MARGIN,
    COLOUR_PARTS,
    DETAIL_PARTS,
    acts,
    band_change,
    check_part,
    colours_of_nodes,
    lattice_from_numbers,
    pointwise,
    texture_change,
)
from nlfilter_torch.photo.picture.changes import DetailChange
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit, Rows
from nlfilter_torch.photo.picture.in_memory import edit_image, edited
from nlfilter_torch.photo.picture.measuring import ends, mean, reduced
from nlfilter_torch.photo.picture.pixels import M, corner, whole_image
from nlfilter_torch.photo.picture.source import Fitted, Guide, Pixels, Planes, Source, kept, luminance
from nlfilter_torch.photo.picture.viewing import fit_change

Numbers = Tensor | Sequence[float]
TINT = 1 / 255  # difference of channels of a grey pixel that a look colours

#: The parameters of a look that are a function of the colour alone, for programs that take colour tables.
COLOURS = ("red", "green", "blue", "matrix", "saturation", "lattice", "amount")


def apply_look(
    image: Tensor,
    *,
    alpha: Numbers = LOOK.defaults["alpha"],
    bands: Numbers = LOOK.defaults["bands"],
    texture: Numbers = LOOK.defaults["texture"],
    red: Numbers = LOOK.defaults["red"],
    green: Numbers = LOOK.defaults["green"],
    blue: Numbers = LOOK.defaults["blue"],
    matrix: Numbers = LOOK.defaults["matrix"],
    saturation: Numbers = LOOK.defaults["saturation"],
    stretch: Numbers = LOOK.defaults["stretch"],
    local: Numbers = LOOK.defaults["local"],
    lattice: Numbers | None = LOOK.defaults["lattice"],
    amount: float | Tensor = LOOK.defaults["amount"],
    viewing_size: float = LOOK.defaults["viewing_size"],
    photometric_bandwidth: float | Tensor | str = LOOK.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | str | None = LOOK.defaults["spatial_bandwidth"],
    patch_size: int = LOOK.defaults["patch_size"],
    num_landmarks: int = LOOK.defaults["num_landmarks"],
    landmarks: Sampling = LOOK.defaults["landmarks"],
    completion: Completion = "diagonal",
    guide_channels: GuideChannels = "luminance",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Apply a look to a photograph: the changes by its parts are added to the image.

    Args:
        image: (B, C, H, W) in [0, 1]; with C = 3 it is RGB, and a grey one stays grey.
        alpha: sliders of the detail layers of luminance, (k+1,) or (B, k+1).
        bands: gains of six bands of luminance that blurs separate, each twice as wide as the one before, and of the
            rest around its mean, (7,) or (B, 7).
        texture: gains of these six bands on surfaces, where luminance varies little, but not at edges, (6,) or (B, 6).
        red: tone curve of red: its output at equal steps of the input from 0 to 1, (K,) or (B, K), linear in between.
        green: likewise, as many.
        blue: likewise.
        matrix: 9 numbers or (B, 9), the rows of the matrix that colours are multiplied by.
        saturation: factors of the saturation in HSV, (K,) or (B, K), for colours whose saturation is at equal steps
            from 0 to 1; the largest channel of a pixel stays as it is.
        stretch: strengths (3,) or (B, 3) of automatic levels, which map the range from the darkest to the lightest
            pixel of the picture to [0, 1]: of the change of luminance, the same for all channels; of the change of the
            largest channel, by which the pixel is scaled; and of the change of every channel by itself; 0 is none.
        local: strengths (8,) or (B, 8) of adaptive histogram equalisation with contrast limited to 1.5, 2, 3 and 5
            times: four of the change of luminance, then four of the change of the largest channel, by which the pixel
            is scaled; 0 is none. Histograms are those of 8 x 8 tiles of the picture.
        lattice: changes of colours at the nodes of a grid, (3, n, n, n) or (B, 3, n, n, n), or the 3 n^3 numbers in
            this order: of red, green and blue, at n equal steps of red, of green and of blue from 0 to 1; interpolated
            in tetrahedra. Colours outside [0, 1] change as the nearest inside. None is none.
        amount: a number or a tensor of shape () or (B,); 1 is the look, 0 the image.
        viewing_size: in megapixels; the details of a larger image are those of its reduction to this size; 0 is the
            size of the image.
        photometric_bandwidth: h_y, or ``"auto"``.
        spatial_bandwidth: h_x in pixels; None is a twelfth of the short side, ``"none"`` compares pixels regardless
            of their distance.
        patch_size: width of the compared patches of the filter.
        num_landmarks: M.
        landmarks: how the landmarks are chosen, see :func:`nonlocal_operator`.
        completion: of the kernel's diagonal, see :func:`nonlocal_operator`.
        guide_channels: what the filter compares, ``"luminance"`` or ``"all"`` channels.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        (B, C, H, W) in the image's dtype; values may leave [0, 1]. Differentiable in image and look.

    Raises:
        TypeError, ValueError: if a part has another shape, or an option leaves its range.

    Example:
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> sepia = (0.393, 0.769, 0.189, 0.349, 0.686, 0.168, 0.272, 0.534, 0.131)
        >>> apply_look(image, matrix=sepia).shape
        torch.Size([1, 3, 24, 24])
    """
    return edited(LookEdit, locals())


@dataclass(frozen=True, kw_only=True, eq=False)
class LookEdit(PhotoEdit):
    """The edit of :func:`apply_look`."""

    declared: ClassVar[Edit] = LOOK
    alpha: Numbers
    bands: Numbers
    texture: Numbers
    red: Numbers
    green: Numbers
    blue: Numbers
    matrix: Numbers
    saturation: Numbers
    stretch: Numbers
    local: Numbers
    lattice: Numbers | None
    amount: float | Tensor
    viewing_size: float

    def notes(self, rows: Rows) -> Iterator[str]:
        """Note that a grey photograph stays grey, if the look gives colours to greys."""
        if rows.channels == 1:
            ramp = torch.linspace(0, 1, 64).view(1, 1, 8, 8).expand(-1, 3, -1, -1)
            shown = edit_image(self, ramp)
            if bool((shown.amax(1) - shown.amin(1)).amax() > TINT):
                yield f"{rows.name} is grey and stays grey, without the colours of the look; convert it to RGB first"

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the parts of the look to a picture."""
        if source.channels not in (1, 3):
            raise ValueError(f"image must have 1 or 3 channels, got {source.channels}; pass grey or RGB")
        LOOK.check(source.batch, amount=self.amount, viewing_size=self.viewing_size)
        parts = self._parts(source.dtype)
        for name, value in parts.items():
            check_part(value, name, source.batch)
        detailed = any(acts(parts[name]) for name in DETAIL_PARTS)
        viewing_size = self.viewing_size if detailed else 0.0  # colours need no smaller picture
        fitted = fit_change(source, partial(self._change, parts), whole_image, viewing_size, "none")
        strength = torch.as_tensor(self.amount).to(source.dtype).reshape(-1, 1, 1, 1)
        light = _change_of_light(source, parts["stretch"], parts["local"])
        colours = {name: parts[name] for name in COLOUR_PARTS}
        lattice = parts["lattice"] if "lattice" in parts and acts(parts["lattice"], 0.0) else None
        result = UnderLook(fitted, light, **colours, lattice=lattice, strength=strength)
        if fitted.finish is None:
            return Fitted(result.pixels)
        return Fitted(result.planes, result.finish, fitted.margin)

    def _parts(self, dtype: torch.dtype) -> dict[str, Tensor]:
        """The parts of the look as tensors, by their names.

        Raises:
            TypeError, ValueError: if a part has the wrong number of values.
        """
        names = ("alpha", "bands", "texture", "saturation", "stretch", "local")
        parts = {name: _numbers(getattr(self, name), name, dtype) for name in names}
        channels = [_numbers(getattr(self, name), name, dtype) for name in ("red", "green", "blue")]
        if len({channel.shape[-1] for channel in channels}) > 1:
            lengths = ", ".join(str(channel.shape[-1]) for channel in channels)
            raise ValueError(f"red, green and blue must be equally many numbers, got {lengths}; add or drop some")
        batch = max(channel.shape[0] if channel.ndim == 2 else 1 for channel in channels)
        parts["curves"] = torch.stack([channel.expand(batch, -1) for channel in channels], dim=1)
        colours = _numbers(self.matrix, "matrix", dtype)
        if colours.shape[-1] != 9:
            raise ValueError(f"matrix must be 9 numbers, row by row, got {colours.shape[-1]}; add or drop some")
        order = ("alpha", "bands", "texture", "curves", "matrix", "saturation", "stretch", "local")
        parts["matrix"] = colours.unflatten(-1, (3, 3))
        parts = {name: parts[name] for name in order}
        return parts if self.lattice is None else parts | {"lattice": _lattice(self.lattice, dtype)}

    def _change(self, parts: dict[str, Tensor], viewed: Source[M]) -> Fitted:
        """The change of detail of a picture at the viewing size."""
        sliders, gains, textured = parts["alpha"], parts["bands"], parts["texture"]
        pixels: Planes = no_change
        if acts(sliders):
            operator = viewed.operator(Guide(self.filter_options(viewed.size)))
            pixels = partial(_for_all_channels, DetailChange.of(operator, luminance, sliders - 1, None).whole)
        if not acts(gains) and not acts(textured):
            return Fitted(pixels)
        average = mean(viewed, luminance) if acts(gains) else None
        return Fitted(pixels, Bands(gains, average, textured if acts(textured) else None), BAND_MARGIN)


def no_change(pixels: Pixels) -> Tensor:
    """Zeros in the shape of the pixels."""
    return torch.zeros_like(pixels.image)


def _for_all_channels(planes: Planes, pixels: Pixels) -> Tensor:
    return planes(pixels).expand_as(pixels.image)


@dataclass(frozen=True, eq=False)
class Bands:
    """Changes of the bands of luminance that blurs separate, added to another change.

    Attributes:
        gains: of the bands.
        mean: of luminance; None if ``gains`` change nothing.
        textured: gains where luminance varies little, or None.
    """

    gains: Tensor
    mean: Tensor | None
    textured: Tensor | None

    def __call__(self, image: Tensor, change: Tensor, _: Inner) -> Tensor:
        """Add the changes of an image (B, C, H, W)."""
        if self.mean is not None:
            change = change + band_change(image, self.gains, self.mean)
        return change if self.textured is None else change + texture_change(image, self.textured)


@dataclass(frozen=True, eq=False)
class UnderLook:
    """A picture to which a look is applied.

    Attributes:
        fitted: the picture with the change of its detail.
        light: change of its brightness by levels and local curves; None if there is none.
        curves: tone curves.
        matrix: of colours.
        saturation: factors of the saturation.
        lattice: changes on a grid of colours; None if there are none.
        strength: amount of the look, (B or 1, 1, 1, 1).
    """

    fitted: Fitted
    light: Planes | None
    curves: Tensor
    matrix: Tensor
    saturation: Tensor
    lattice: Tensor | None
    strength: Tensor

    def pixels(self, pixels: Pixels) -> Tensor:
        """The result at pixels, if it depends on no others."""
        return self.finish(pixels.image, self.planes(pixels), EVERYWHERE)

    def planes(self, pixels: Pixels) -> Tensor:
        """The change of pixels, and that of their brightness as further planes."""
        moved = self.fitted.pixels(pixels)
        return moved if self.light is None else torch.cat([moved, self.light(pixels)], dim=1)

    def finish(self, image: Tensor, planes: Tensor, inner: Inner) -> Tensor:
        """The result, from :meth:`planes`."""
        moved, light = (planes, None) if self.light is None else planes.tensor_split([-image.shape[1]], dim=1)
        moved = moved if self.fitted.finish is None else self.fitted.finish(image, moved, inner)
        coloured = image.expand(-1, 3, -1, -1)
        colours = pointwise(coloured, self.curves, self.matrix, self.saturation, self.lattice) - coloured
        colours = reduce_channels(colours, "luminance") if image.shape[1] == 1 else colours
        shown = image + self.strength * (moved - image + colours)
        return shown if light is None else shown + self.strength * light


def _change_of_light(source: Source[M], levels: Tensor, strengths: Tensor) -> Planes | None:
    """The change (B, C, h, w) by automatic levels and local tone curves, or None if there is none."""
    if not acts(levels, 0.0) and not acts(strengths, 0.0):
        return None
    stretch = kept(source, "range of brightness", [], _range_of, source)
    curves = None
    if acts(strengths, 0.0):
        curves = kept(source, "local curves", [], _curves_of, source, stretch).weighed(strengths)
    return ChangeOfLight(stretch, curves, levels if curves is None or acts(levels, 0.0) else None)


def _tones(pixels: Pixels) -> Tensor:
    return tones(pixels.image)


def _range_of(source: Source[M]) -> Stretch:
    return Stretch.of(ends(source, _tones))


def _ramps(stretch: Stretch, pixels: Pixels) -> Tensor:
    return ramps(pixels.image, stretch)


def _curves_of(source: Source[M], stretch: Stretch) -> LocalCurves:
    return LocalCurves.of(source.size, stretch, partial(reduced, source, partial(_ramps, stretch)))


@dataclass(frozen=True, eq=False)
class ChangeOfLight:
    """Changes of brightness by the histogram of a picture: by local curves, by levels, or by both."""

    stretch: Stretch
    curves: LocalCurves | None
    levels: Tensor | None

    def __call__(self, pixels: Pixels) -> Tensor:
        """The change of pixels."""
        change: Tensor | None = None
        if self.curves is not None:
            change = self.curves.rectangle(pixels.image, corner(pixels)).sum(1)
        if self.levels is not None:
            levels = self.stretch.change(pixels.image, self.levels)
            change = levels if change is None else change + levels
        return no_change(pixels) if change is None else change


def _lattice(value: Numbers, dtype: torch.dtype) -> Tensor:
    """A lattice as a tensor (3, n, n, n), or with a dimension of the images before; 3 n^3 numbers take this shape."""
    numbers = _numbers(value, "lattice", dtype)
    return numbers if numbers.ndim > 2 else lattice_from_numbers(numbers)


def _numbers(value: Numbers, name: str, dtype: torch.dtype) -> Tensor:
    """A part of a look as a tensor of at least one dimension."""
    try:
        numbers = value if isinstance(value, Tensor) else torch.tensor(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name} must be a list of numbers or a tensor, got {value!r}; pass numbers") from error
    if numbers.ndim == 0:
        raise ValueError(f"{name} must be several numbers, got a single one; pass a list or a tensor of them")
    if numbers.is_complex():
        raise TypeError(f"{name} must be real numbers, got {numbers.dtype}; pass their real part")
    return numbers.to(dtype)


def colour_part(step: Step) -> Step:
    """A look without all that depends on the picture or the surroundings of a pixel; steps of detail have none."""
    if step.edit != LOOK.name:
        return Step(LOOK.name)
    return Step(LOOK.name, **{name: step[name] for name in COLOURS})


def colour_table(step: Step, nodes: int) -> Tensor:
    """Colours (3, n, n, n), in float64, under the :func:`colour_part` of a look, by their red, green and blue before.

    They may leave [0, 1].
    """
    colours = colours_of_nodes(nodes).view(1, 3, nodes, nodes * nodes)
    return _coloured(colour_part(step), colours).view(3, nodes, nodes, nodes)


def table_error(step: Step, nodes: int, colours: Tensor) -> float:
    """Root mean squared error in levels of 255 of a table with that many nodes, at colours (B, 3, H, W)."""
    table = colour_table(step, nodes) - colours_of_nodes(nodes)
    shown, exact = (_coloured(part, colours) for part in (Step(LOOK.name, lattice=_flat(table)), colour_part(step)))
    return 255 * float((shown.clamp(0, 1) - exact.clamp(0, 1)).square().mean().sqrt())


def _flat(table: Tensor) -> tuple[float, ...]:
    return tuple(table.flatten().tolist())


def _coloured(look: Step, colours: Tensor) -> Tensor:
    """Colours (B, 3, H, W) under a look that depends on nothing else."""
    return edit_image(LookEdit.of(look.arguments((colours.shape[-2], colours.shape[-1]))), colours)
