"""The edits by their names."""

from nlfilter_torch.photo.edits.abstract import Abstract
from nlfilter_torch.photo.edits.colorize import Colorize
from nlfilter_torch.photo.edits.defocus import Defocus
from nlfilter_torch.photo.edits.denoise import Denoise
from nlfilter_torch.photo.edits.detail import Detail
from nlfilter_torch.photo.edits.look import LookEdit
from nlfilter_torch.photo.edits.recolor import Recolor
from nlfilter_torch.photo.edits.sharpen import Sharpen
from nlfilter_torch.photo.edits.tone import Tone
from nlfilter_torch.photo.picture.edit import PhotoEdit

EDITS: tuple[type[PhotoEdit], ...] = (Denoise, Detail, Tone, Sharpen, Colorize, Recolor, Defocus, Abstract, LookEdit)
EDIT_OF: dict[str, type[PhotoEdit]] = {edit.declared.name: edit for edit in EDITS}
