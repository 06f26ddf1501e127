"""The open photograph as it is developed, and what the editor shows of it."""

from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path

from torch import Tensor

from nlfilter_torch.photo.app.preview import Preview
from nlfilter_torch.photo.declared.development import AS_IT_IS, Development, Frame
from nlfilter_torch.photo.declared.presets import DEVELOPING_BYTES
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Mark
from nlfilter_torch.photo.edits.applying import left_by_crop
from nlfilter_torch.photo.edits.parts import Parts, Rectangle
from nlfilter_torch.photo.files.formats import check_memory
from nlfilter_torch.photo.picture.developing import limits_of, part_of_planes, reframed
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.light import Light, develop_image, fit_light, in_light, lit_photograph
from nlfilter_torch.photo.picture.painting import TensorPainter
from nlfilter_torch.photo.picture.photographs import Photograph, cut_photograph
from nlfilter_torch.photo.picture.pixels import Strip
from nlfilter_torch.photo.picture.source import Cache

DEVELOPING = -1  # the place before all steps, of a slider that moves
DRAFT_PIXELS = 400_000  # of a draft, at most: a quarter of what a preview may have, and of its time


@dataclass(frozen=True, eq=False)
class Developed:
    """A photograph as it is developed; its light changes in the preview alone until all of its pixels are needed.

    Attributes:
        development: how.
        frame: where it lies in the original.
        source: the photograph as it is.
        name: that of its file.
        cut: it in the light of the original, with which the edit is compared.
        before: the pixels of that, reduced to the size of the preview.
        preview: its preview.
    """

    development: Development
    frame: Frame
    source: Photograph
    name: str
    cut: Photograph
    before: Tensor
    preview: Preview
    _areas: Cache = field(default_factory=dict)  # of ``before``
    _counted: dict[tuple[Mark, ...], bool] = field(default_factory=dict)  # whether strokes reach pixels that count

    @staticmethod
    def of(photograph: Photograph, name: str, pixels: int) -> "Developed":
        """A photograph as it is, whose file is called ``name``; its preview has at most so many pixels."""
        preview = Preview(photograph.pixels, pixels)
        frame = AS_IT_IS.frame(photograph.size)
        return Developed(AS_IT_IS, frame, photograph, name, photograph, preview.pixels, preview)

    @cached_property
    def photograph(self) -> Photograph:
        """The photograph at full size; computed when it is needed."""
        return lit_photograph(self.cut, self.development, self.source)

    @cached_property
    def parts(self) -> Parts:
        """Parts of it at full size."""
        return Parts(self.photograph.pixels[0].permute(1, 2, 0).numpy(), self.name)

    @cached_property
    def draft(self) -> Preview | None:
        """A smaller preview, which follows a person's hand; None if the preview is small enough itself."""
        pixels = self.preview.pixels
        if pixels.shape[-2] * pixels.shape[-1] < 2 * DRAFT_PIXELS:
            return None
        return Preview(pixels.clamp(0, 1), DRAFT_PIXELS, reduction=self.preview.stride)

    @cached_property
    def _light(self) -> Light:
        """The change of light, with the areas of the preview."""
        return fit_light(InMemory(self.cut.pixels, self._areas), self.development, self._limits)

    def lit(self, place: Rectangle) -> Tensor:
        """A part in its light, without steps, (1, C, h, w) in [0, 1]; other parts are not computed."""
        part, width = part_of_planes(self.cut.pixels, place.rows, place.columns), self.frame.width
        if self.development.changes_light:
            part = self._light(Strip(part, place.rows.start * width + place.columns.start, width))
        return part.clamp(0, 1)

    def close(self) -> None:
        """Remove the temporary files of the parts, if there are any."""
        if "parts" in vars(self):
            self.parts.close()

    def changed(self, pixels: int, development: Development) -> "Developed":
        """The original photograph, developed in another way; its preview has at most so many pixels.

        Raises:
            ValueError: if the middle of the crop is outside.
            MemoryError: if there is no room for it.
        """
        original = self.source
        frame = development.frame(original.size)
        check_memory(Path(self.name), original.size[1], original.size[0], DEVELOPING_BYTES)
        is_cut = development.geometry == self.development.geometry
        cut = self.cut if is_cut else cut_photograph(original, development)
        before = self.before if is_cut else Preview(cut.pixels, pixels).pixels
        areas = self._areas if is_cut else {}
        light = partial(in_light, development=development, limits=self._limits)
        preview = Preview(cut.pixels, pixels, light(before, cache=areas), light)
        return Developed(development, frame, original, self.name, cut, before, preview, areas)

    @cached_property
    def _limits(self) -> tuple[Tensor, Tensor]:
        """Of the original."""
        return limits_of(self.source.pixels)

    def counted(self, step: Step) -> Step:
        """A step of this photograph, without its strokes if those of its objects cover only pixels that do not count.

        See :func:`left_by_crop`, which paints at full size; its results are kept.
        """
        objects = step.objects
        if not objects or self.frame.is_whole:
            return step
        if objects not in self._counted:
            weights = self.cut.weights
            source = InMemory(self.cut.pixels, weights=weights)
            left = step if weights is None else left_by_crop(step, source, TensorPainter())
            self._counted[objects] = bool(left.strokes)
        return step if self._counted[objects] else step.changed(strokes=())

    def original(self, place: Rectangle) -> Tensor:
        """A part before the edit, (1, C, h, w) in [0, 1]."""
        return part_of_planes(self.cut.pixels, place.rows, place.columns).clamp(0, 1)

    def approximate(self, development: Development, original: Preview) -> Tensor:
        """The preview, quickly, as it would be developed in another way, from the preview of the photograph itself."""
        if development.geometry == self.development.geometry:
            return in_light(self.before, development, self._limits, self._areas)
        return develop_image(original.pixels, development)

    def change_in(self, development: Development, original: Preview) -> Tensor:
        """The change that the steps made to the preview, as another development shows it; only its geometry counts."""
        preview = self.preview
        if preview.edited is None:
            return original.pixels.new_zeros(())
        frame = development.frame(original.size)
        return reframed(preview.edited - preview.pixels.clamp(0, 1), self.frame, frame, frame.size)
