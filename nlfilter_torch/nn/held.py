"""Landmarks that a layer keeps from call to call."""

from typing import Any, Literal

import torch
from torch import Tensor, nn

from nlfilter_torch.operator.assignment import Assignment
from nlfilter_torch.operator.features import GuideFeatures

Hold = Literal["assignment", "features"]


class HeldAssignment(nn.Module):
    """The assignment of the pixels of some images to landmarks, kept until the images have another shape.

    Not part of ``state_dict``, since it belongs to the images rather than to the layer.
    """

    kind: Hold = "assignment"

    def __init__(self, assignment: Assignment | None) -> None:
        super().__init__()
        self.assignment = assignment
        self.shape: tuple[int, ...] | None = None  # (B, H, W) of the guides; None if an assignment was passed

    def of(self, guide: Tensor) -> Assignment | None:
        """The assignment for guides (B, C, H, W); None if it is not known."""
        return self.assignment if self.shape in (None, _shape(guide)) else None

    def keep(self, assignment: Assignment | None, guide: Tensor) -> None:
        """Keep the assignment of guides (B, C, H, W)."""
        self.assignment, self.shape = assignment, _shape(guide)

    def forget(self) -> None:
        """Forget the assignment."""
        self.assignment, self.shape = None, None


class HeldFeatures(nn.Module):
    """Landmarks (1, D, M), in units of the guide and in pixels, so that bandwidths can be learned.

    Attributes:
        features: buffer, or None before landmarks were chosen. ``state_dict`` holds it, and DistributedDataParallel
            sends it to all ranks.
    """

    kind: Hold = "features"
    features: Tensor | None

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("features", None)

    def keep(self, landmarks: Tensor, recipe: GuideFeatures) -> None:
        """Keep landmarks (1, D, M) that were computed with the bandwidths and the window of ``recipe``."""
        features = (landmarks / recipe.scales(landmarks)).detach()
        if self.features is not None and self.features.shape == features.shape:
            self.features.copy_(features)  # in place: other modules may know the buffer
        else:
            self.features = features

    def of(self, recipe: GuideFeatures) -> Tensor:
        """The landmarks (1 or B, D, M), divided by the bandwidths of ``recipe``; differentiable in these.

        Raises:
            ValueError: if no landmarks have been chosen.
        """
        if self.features is None:
            raise ValueError(
                "landmarks must be chosen before the first call of a layer with hold='features', got none; call "
                "renew(guides) with some typical guides, or load a state_dict"
            )
        return self.features * recipe.scales(self.features)

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *arguments: Any) -> None:
        """Take landmarks of any shape."""
        saved = state_dict.get(f"{prefix}features")
        if saved is not None and (self.features is None or self.features.shape != saved.shape):
            self.features = torch.empty_like(saved, device=None if self.features is None else self.features.device)
        super()._load_from_state_dict(state_dict, prefix, *arguments)


def _shape(guide: Tensor) -> tuple[int, ...]:
    """Numbers of images, rows and columns."""
    return (guide.shape[0], *guide.shape[2:])
