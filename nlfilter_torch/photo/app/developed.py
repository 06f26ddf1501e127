"""The open photograph as it is developed, and what the editor shows of it."""

from dataclasses import dataclass, field
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
from nlfilter_torch.photo.picture.light import develop_image, in_light, lit_photograph
from nlfilter_torch.photo.picture.painting import TensorPainter
from nlfilter_torch.photo.picture.photographs import Photograph, cut_photograph
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.picture.source import Cache

DEVELOPING = -1  # the place before all steps, of a slider that moves


@dataclass(frozen=True, eq=False)
class Developed:
    """A photograph as it is developed.

    Attributes:
        development: how.
        frame: where it lies in the original.
        photograph: its pixels.
        cut: it in the light of the original, with which the edit is compared.
        before: the pixels of that, reduced to the size of the preview.
        preview: its preview.
        parts: parts of it at full size.
    """

    development: Development
    frame: Frame
    photograph: Photograph
    cut: Photograph
    before: Tensor
    preview: Preview
    parts: Parts
    _areas: Cache = field(default_factory=dict)  # of ``before``
    _counted: dict[tuple[Mark, ...], bool] = field(default_factory=dict)  # whether strokes reach pixels that count

    @staticmethod
    def of(photograph: Photograph, name: str, pixels: int) -> "Developed":
        """A photograph as it is, whose file is called ``name``; its preview has at most so many pixels."""
        preview = Preview(photograph.pixels, pixels)
        frame, parts = AS_IT_IS.frame(photograph.size), parts_of(photograph, name)
        return Developed(AS_IT_IS, frame, photograph, photograph, preview.pixels, preview, parts)

    def changed(self, original: Photograph, name: str, pixels: int, development: Development) -> "Developed":
        """The original photograph, developed in another way.

        Raises:
            ValueError: if the middle of the crop is outside.
            MemoryError: if there is no room for it.
        """
        frame = development.frame(original.size)
        check_memory(Path(name), original.size[1], original.size[0], DEVELOPING_BYTES)
        is_cut = development.geometry == self.development.geometry
        cut = self.cut if is_cut else cut_photograph(original, development)
        edited = lit_photograph(cut, development, original)
        preview = Preview(edited.pixels, pixels)
        if is_cut:
            before = self.before
        elif cut is edited:
            before = preview.pixels
        else:
            before = resize(cut.pixels.float(), preview.size)
        return Developed(development, frame, edited, cut, before, preview, parts_of(edited, name))

    def counted(self, step: Step) -> Step:
        """A step of this photograph, without its strokes if those of its objects cover only pixels that do not count.

        See :func:`left_by_crop`, which paints at full size; its results are kept.
        """
        objects = step.objects
        if not objects or self.frame.is_whole:
            return step
        if objects not in self._counted:
            weights = self.photograph.weights
            source = InMemory(self.photograph.pixels, weights=weights)
            left = step if weights is None else left_by_crop(step, source, TensorPainter())
            self._counted[objects] = bool(left.strokes)
        return step if self._counted[objects] else step.changed(strokes=())

    def original(self, place: Rectangle) -> Tensor:
        """A part before the edit, (1, C, h, w) in [0, 1]."""
        return part_of_planes(self.cut.pixels, place.rows, place.columns).clamp(0, 1)

    def approximate(self, development: Development, original: Preview) -> Tensor:
        """The preview, quickly, as it would be developed in another way, from the preview of the photograph itself."""
        if development.geometry == self.development.geometry:
            return in_light(self.before, development, limits_of(original.pixels), self._areas)
        return develop_image(original.pixels, development)

    def change_in(self, development: Development, original: Preview) -> Tensor:
        """The change that the steps made to the preview, as another development shows it; only its geometry counts."""
        preview = self.preview
        if preview.edited is None:
            return original.pixels.new_zeros(())
        frame = development.frame(original.size)
        return reframed(preview.edited - preview.pixels.clamp(0, 1), self.frame, frame, frame.size)


def parts_of(photograph: Photograph, name: str) -> Parts:
    """The parts of a photograph, whose file is called ``name``."""
    return Parts(photograph.pixels[0].permute(1, 2, 0).numpy(), name)
