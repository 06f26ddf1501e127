"""Presets: sliders and the options of their filter, as a small JSON file that applies to any photograph.

Names and units are those of the command line, so that the file can be edited by hand. :data:`PRESETS` are the named
presets.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nlfilter_torch.edits.parameters import DETAIL
from nlfilter_torch.edits.recipe import Recipe, in_file
from nlfilter_torch.edits.steps import Step

if TYPE_CHECKING:
    import torch
    from torch import Tensor


@dataclass(frozen=True)
class Preset:
    """An edit of the details of a photograph.

    Attributes:
        alpha: sliders, fine to coarse, at least two. Paper: eq. (12).
        bandwidth: photometric bandwidth in grey levels from 0 to 255, or ``"auto"``.
        spatial_bandwidth: in pixels, ``"none"`` for none, or None for a twelfth of the short side.
        patch_size: odd.
        landmarks: number of landmarks.
        sampling: ``"kmeans"``, ``"uniform"`` or ``"random"``.
        residual: gain of the residual of the landmarks, or None for that of the finest layer.
        channels: ``"luminance"`` or ``"all"``.
        threshold: in grey levels, contrast of detail below which it is amplified less.
        limits: ``"soft"`` or ``"none"``.
        viewing_size: in megapixels.
    """

    alpha: tuple[float, ...]
    bandwidth: float | str = DETAIL["bandwidth"].default
    spatial_bandwidth: float | str | None = DETAIL["spatial_bandwidth"].default
    patch_size: int = DETAIL["patch_size"].default
    landmarks: int = DETAIL["landmarks"].default
    sampling: str = DETAIL["sampling"].default
    residual: float | None = DETAIL["residual"].default
    channels: str = DETAIL["channels"].default
    threshold: float = DETAIL["threshold"].default
    limits: str = DETAIL["limits"].default
    viewing_size: float = DETAIL["viewing_size"].default

    def apply(self, image: "Tensor", *, generator: "torch.Generator | None" = None) -> "Tensor":
        """Edit a photograph as ``nlfilter-torch detail --preset`` does.

        Args:
            image: (B, C, H, W) in [0, 1]; with C = 3 it is RGB, and its colours are kept.
            generator: source of randomness for the landmarks; None draws the same for every call.

        Returns:
            (B, C, H, W) in the image's dtype; values may leave [0, 1]. Differentiable in the image.

        Raises:
            TypeError, ValueError: if ``image`` is not a finite floating-point tensor, or an entry leaves its range.

        Example:
            >>> import torch
            >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
            >>> PRESETS["crisp"].apply(image).shape
            torch.Size([1, 3, 24, 24])
        """
        from nlfilter_torch.edits.applying import apply_step

        return apply_step(self.step, image, generator=generator)

    @property
    def step(self) -> Step:
        """The edit as a step of a :class:`~nlfilter_torch.edits.recipe.Recipe`."""
        return Step("detail", **asdict(self))

    def to_json(self) -> str:
        """Format the preset as JSON: a recipe of one step.

        >>> print(Preset((3.0, 1.0), 20.0).to_json())
        {
          "version": 1,
          "steps": [
            {
              "edit": "detail",
              "alpha": [3.0, 1.0],
              "residual": null,
              "channels": "luminance",
              "reach": 0.6,
              "tolerance": 8.0,
              "threshold": 5.0,
              "limits": "soft",
              "viewing_size": 1.5,
              "bandwidth": 20.0,
              "spatial_bandwidth": null,
              "patch_size": 5,
              "landmarks": 300,
              "sampling": "kmeans"
            }
          ]
        }
        <BLANKLINE>
        """
        return in_file([self.step.to_json("    ", complete=True)])

    @staticmethod
    def from_json(text: str | bytes, name: str) -> "Preset":
        """Parse the output of :meth:`to_json`; omitted entries have their defaults.

        Args:
            text: the file's content.
            name: the file's name in errors.

        Raises:
            ValueError: if ``text`` is no JSON object, or holds more than a single detail step without strokes.
        """
        return _preset(Recipe.from_json(text, name, REMEDY), name)


REMEDY = "create one with nlfilter-torch fit"


def _preset(recipe: Recipe, name: str) -> Preset:
    """Convert a recipe of a single detail step without strokes."""
    if [step.edit for step in recipe.steps] != ["detail"] or recipe.steps[0].strokes:
        raise ValueError(
            f"{name} is not a preset: it must hold a single detail step without strokes; use nlfilter-torch apply"
        )
    return Preset(**{field: recipe.steps[0][field] for field in Preset.__dataclass_fields__})


#: The named presets. Chosen by eye on astronaut, chelsea and rocket of scikit-image and seven photographs of
#: landscapes, buildings and plants. The presets that remove grain work better without a spatial term.
PRESETS: dict[str, Preset] = {
    "crisp": Preset((2.2, 2.2, 2.2, 1.0)),
    "clear": Preset((1.5, 1.5, 1.5, 1.0)),
    "texture": Preset((2.5, 1.3, 1.0, 1.0)),
    "dramatic": Preset((2.0, 2.5, 3.5, 1.0), 40.0),
    "glow": Preset((0.5, 1.0, 2.5, 1.0), 40.0),
    "soft skin": Preset((0.1, 0.4, 1.0, 1.0), 8.0, "none", landmarks=100),
    "calm": Preset((0.8, 0.6, 0.4, 1.0), 40.0),
    "smooth": Preset((0.0, 0.0, 0.0, 1.0), 12.0, "none", landmarks=100),
}

#: Short description of each of :data:`PRESETS`.
PURPOSES: dict[str, str] = {
    "crisp": "stronger detail of all sizes",
    "clear": "slightly stronger detail of all sizes",
    "texture": "stronger finest detail only: fur, hair, cloth, stone, but also grain",
    "dramatic": "strong light and shade; small halos at hard edges",
    "glow": "softer fine detail, stronger large shapes",
    "soft skin": "removes pores and grain, keeps eyes and outlines",
    "calm": "less contrast within objects, as in haze",
    "smooth": "removes texture, keeps edges; a start for a drawing",
}


def find_preset(name: str) -> Preset:
    """Return the preset of that name (``soft-skin`` is ``soft skin``), or read it from the file at that path.

    Raises:
        ValueError: if there is neither, or the file holds no preset.

    Example:
        >>> find_preset("soft-skin").alpha
        (0.1, 0.4, 1.0, 1.0)
    """
    return _preset(find_recipe(name), name)


def find_recipe(name: str) -> Recipe:
    """Return the preset of that name (``soft-skin`` is ``soft skin``), or read the recipe in the file at that path.

    Raises:
        ValueError: if there is neither, or the file holds no recipe.
    """
    spoken = name.lower().replace("-", " ").replace("_", " ")
    if spoken in PRESETS:
        return Recipe((PRESETS[spoken].step,))
    path = Path(name)
    if not path.is_file():
        raise ValueError(
            f"{name} is neither a file nor one of the presets {', '.join(PRESETS)}; "
            "create a file with nlfilter-torch fit"
        )
    return Recipe.from_json(path.read_bytes(), name)
