"""A layer that builds an operator from a guide."""

from collections.abc import Collection
from types import MappingProxyType
from typing import Any, Literal

import torch
from torch import Tensor, nn

from nlfilter_torch.core.checks import check_choice, check_image, check_pixel_weights
from nlfilter_torch.core.communicator import check_group
from nlfilter_torch.core.precision import working_dtype
from nlfilter_torch.nn.parameters import Learnable, UnitWindow, check_learn, positive_option
from nlfilter_torch.operator.build import checked_operator
from nlfilter_torch.operator.features import GuideFeatures, estimate_bandwidth, unit_window
from nlfilter_torch.operator.landmarks import assign_landmarks
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.options import (
    AUTO,
    SAMPLING,
    Assignment,
    Completion,
    FilterOptions,
    GuideChannels,
    HasLandmarks,
    Landmarks,
    Sampling,
    check_options,
)

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


AffinityOption = Literal["photometric_bandwidth", "spatial_bandwidth", "patch_weights"]


class NonlocalAffinity(Learnable):
    """Layer that builds an operator from a guide by :func:`nonlocal_operator`, with the same options.

    Args:
        patch_size: as for :func:`nonlocal_operator`.
        photometric_bandwidth: a positive number in units of the guide, or ``"auto"``.
        spatial_bandwidth: a positive number of pixels, or None.
        num_landmarks: as for :func:`nonlocal_operator`.
        landmarks: as for :func:`nonlocal_operator`. An operator or an assignment is held as with
            ``hold="assignment"``, unless ``hold="features"``; features are held as with ``hold="features"``, and must
            be divided by the bandwidths with which the layer starts.
        completion: as for :func:`nonlocal_operator`.
        guide_channels: as for :func:`nonlocal_operator`. None lets each call say what counts, and is luminance in those
            that do not.
        patch_weights: as for :func:`nonlocal_operator`.
        tolerance: as for :func:`nonlocal_operator`.
        generator: as for :func:`nonlocal_operator`. Every call then draws different landmarks; do not combine it with
            gradient checkpointing, which expects two runs of the layer to agree.
        group: as for :func:`nonlocal_operator`. A layer with a group cannot be pickled or copied.
        hold: None chooses landmarks anew in every call, which makes the layer discontinuous in guide and bandwidths.
            ``"assignment"`` is for calls with the same images, as when sliders and bandwidths are fitted to a
            picture: the first call assigns pixels to landmarks, and later calls keep the assignment, while the
            landmarks move smoothly with guide and bandwidths. Images of another size, or another number of them, are
            assigned anew. ``"features"`` is for images that change: landmarks are those of the guides that
            :meth:`renew` was called with last, for all images, and part of ``state_dict``.
        learn: the options to learn: any of ``"photometric_bandwidth"`` and ``"spatial_bandwidth"`` (which need initial
            values) and ``"patch_weights"``. All stay positive.

    Raises:
        TypeError, ValueError: if ``learn`` has any other name, or an option is not valid for :func:`nonlocal_operator`.
    """

    learnable = MappingProxyType(
        {
            "photometric_bandwidth": "log_photometric_bandwidth",
            "spatial_bandwidth": "log_spatial_bandwidth",
            "patch_weights": "patch_weights.logits",
        }
    )
    photometric_bandwidth: float | Literal["auto"] | Tensor = positive_option(
        "photometric_bandwidth", 'Number or ``"auto"``; a tensor of shape () if it is learned.'
    )
    spatial_bandwidth: float | Tensor | None = positive_option(
        "spatial_bandwidth", "Number of pixels or None; a tensor of shape () if it is learned."
    )

    def __init__(
        self,
        *,
        patch_size: int = FilterOptions.patch_size,
        photometric_bandwidth: float | Literal["auto"] = AUTO,
        spatial_bandwidth: float | None = None,
        num_landmarks: int = FilterOptions.num_landmarks,
        landmarks: Landmarks = FilterOptions.landmarks,
        completion: Completion = FilterOptions.completion,
        guide_channels: GuideChannels | None = None,
        patch_weights: Tensor | None = FilterOptions.patch_weights,
        tolerance: float | None = FilterOptions.tolerance,
        generator: torch.Generator | None = FilterOptions.generator,
        group: Any = FilterOptions.group,
        hold: Hold | None = None,
        learn: AffinityOption | Collection[AffinityOption] = (),
    ) -> None:
        super().__init__()
        names = check_learn(learn, tuple(self.learnable))
        options = FilterOptions.of({**locals(), "guide_channels": _channels(guide_channels)})
        check_options(options)
        check_group(group)
        window = unit_window(patch_size, patch_weights).detach()  # learned only with learn=("patch_weights",)
        self.patch_size = patch_size
        self.num_landmarks = options.landmark_count
        self.landmarks: Sampling = landmarks if isinstance(landmarks, str) else SAMPLING
        self.completion: Completion = completion
        self.guide_channels: GuideChannels | None = guide_channels
        self.tolerance = tolerance
        self.generator = generator
        self.group = group

        if isinstance(photometric_bandwidth, str):
            check_choice(photometric_bandwidth, "photometric_bandwidth", ("auto",), "pass it or a number")
            if "photometric_bandwidth" in names:
                raise ValueError(
                    "photometric_bandwidth must be a number if it is learned, got 'auto'; "
                    "pass the mean of estimate_bandwidth over a few guides"
                )
        if spatial_bandwidth is None and "spatial_bandwidth" in names:
            raise ValueError(
                "spatial_bandwidth must be a number of pixels if it is learned, got None; "
                "start with a third of the image's height"
            )
        self.start_positive("photometric_bandwidth", photometric_bandwidth, names, other=str)
        self.start_positive("spatial_bandwidth", spatial_bandwidth, names, other=type(None))
        # Non-persistent: a fixed window is a constructor option like the others.
        self.patch_weights: Tensor | UnitWindow | None
        if "patch_weights" in names:
            self.patch_weights = UnitWindow(window)
        else:
            self.register_buffer("patch_weights", None if patch_weights is None else window, persistent=False)
        self.held = self._held(hold, landmarks)

    def forward(
        self, guide: Tensor, weights: Tensor | None = None, guide_channels: GuideChannels | None = None
    ) -> NonlocalOperator:
        """Build the operator of a guide.

        Args:
            guide: (B, C, H, W).
            weights: (B, 1, H, W) of its pixels: 0 for padding.
            guide_channels: the channels that count in this call, if the layer was made with None.
        """
        channels = _channels(self.guide_channels, guide_channels)
        if isinstance(self.held, HeldFeatures):
            _check_no_volume(guide)
            bandwidth = self.photometric_bandwidth
            if isinstance(bandwidth, str):
                bandwidth = estimate_bandwidth(guide, guide_channels=channels, weights=weights, group=self.group)
            landmarks = self.held.of(self._recipe(bandwidth, guide, channels))
            return self._build(guide, landmarks, bandwidth, weights, channels)
        if isinstance(self.held, HeldAssignment):
            check_image(guide, "guide", empty=True, dimensions=(4, 5))
            kept = self.held.of(guide) or self.landmarks
            operator = self._build(guide, kept, self.photometric_bandwidth, weights, channels)
            self.held.keep(operator.assignment, guide)
            return operator
        return self._build(guide, self.landmarks, self.photometric_bandwidth, weights, channels)

    @torch.no_grad()
    def renew(
        self,
        guide: Tensor | None = None,
        weights: Tensor | None = None,
        guide_channels: GuideChannels | None = None,
    ) -> None:
        """Choose the landmarks that are held anew, by the sampling, number and generator of the layer.

        Args:
            guide: (B, C, H, W) to choose them from, whole images, also for a layer with a group. With
                ``hold="features"``, landmarks are chosen from all of the guides at once, and the mean of their
                bandwidths counts if it is ``"auto"``; in distributed training, call this before the layer is wrapped,
                with the same guides on all ranks. With ``hold="assignment"``, None forgets the assignment, and the next
                call makes a new one.
            weights: (B, 1, H, W), how much each pixel of the guides counts, 0 for padding, from which no landmarks are
                made.
            guide_channels: as for :meth:`forward`.

        Raises:
            TypeError, ValueError: if the layer holds no landmarks, or the guide is missing or invalid.
        """
        if self.held is None:
            raise ValueError(
                "hold must be 'assignment' or 'features' to renew landmarks, got None; every call chooses new ones"
            )
        if isinstance(self.held, HeldAssignment):
            self.held.forget()
            if guide is not None:
                self(guide, weights, guide_channels)
            return
        if guide is None:
            raise ValueError("guide must be images to choose landmarks from if hold is 'features', got None; pass some")
        _check_no_volume(guide)
        check_image(guide, "guide")
        bandwidth, channels = self.photometric_bandwidth, _channels(self.guide_channels, guide_channels)
        if isinstance(bandwidth, str):
            bandwidth = estimate_bandwidth(guide, guide_channels=channels, weights=weights).mean()
        recipe = self._recipe(bandwidth, guide, channels)
        counts = None if weights is None else check_pixel_weights(weights, guide)
        features = recipe(guide, counts=None if counts is None else counts > 0)
        features = features.transpose(0, 1).flatten(1).unsqueeze(0)  # (1, D, B N), of all images
        size = (guide.shape[0] * guide.shape[2], guide.shape[3])
        if counts is not None:
            counts = counts.flatten()
            kept = counts.nonzero().squeeze(1)
            features, counts, size = features[:, :, kept], counts[kept].unsqueeze(0), (1, len(kept))
        options = FilterOptions(
            num_landmarks=min(self.num_landmarks, features.shape[2]), landmarks=self.landmarks, generator=self.generator
        )
        layout = recipe.layout if len(guide) == 1 and counts is None else None  # then as those of its operator
        chosen, _ = assign_landmarks(features, size, options, weights=counts, layout=layout)
        self.held.keep(chosen, recipe)

    def _held(self, hold: Hold | None, landmarks: Landmarks) -> HeldAssignment | HeldFeatures | None:
        """What the layer keeps from call to call, from the arguments of the constructor."""
        if hold is None and not isinstance(landmarks, str):
            hold = "features" if isinstance(landmarks, Tensor) else "assignment"
        if hold is None:
            return None
        check_choice(hold, "hold", ("assignment", "features"), "choose one of these, or None")
        if hold == "features":
            return HeldFeatures() if isinstance(landmarks, str) else self._held_features(landmarks)
        # The assignment of an operator, if there is one; otherwise that of the first call.
        assignment = landmarks if isinstance(landmarks, str | Tensor | Assignment) else landmarks.assignment
        if assignment is None or isinstance(assignment, Tensor):
            raise ValueError(
                "hold must be 'features' if landmarks are features, got 'assignment'; pass an operator whose landmarks "
                "were chosen from its guide, or hold='features'"
            )
        return HeldAssignment(None if isinstance(assignment, str) else assignment)

    def _held_features(self, landmarks: Tensor | Assignment | HasLandmarks) -> HeldFeatures:
        """Hold landmarks in units of the guide, given those divided by the initial bandwidths."""
        if isinstance(landmarks, Assignment):
            raise ValueError(
                "hold must be 'assignment' if landmarks are an assignment, got 'features'; pass the operator itself"
            )
        features = landmarks if isinstance(landmarks, Tensor) else landmarks.landmarks
        recipe = landmarks.kernel.features if isinstance(landmarks, NonlocalOperator) else None
        if recipe is None:
            bandwidth = self.photometric_bandwidth
            if isinstance(bandwidth, str):
                raise ValueError(
                    "photometric_bandwidth must be a number if landmarks are features, which are divided by it, got "
                    "'auto'; pass a number, or an operator of a guide"
                )
            recipe = self._recipe(bandwidth, features, _channels(self.guide_channels))
        held = HeldFeatures()
        held.keep(features, recipe)
        return held

    def _recipe(self, bandwidth: float | Tensor, like: Tensor, channels: GuideChannels) -> GuideFeatures:
        """The function that computes features of a guide, in the precision of ``like``."""
        window = unit_window(self.patch_size, self._weights()).to(like.device, working_dtype(like))
        return GuideFeatures(window, bandwidth, self.spatial_bandwidth, channels)

    def _weights(self) -> Tensor | None:
        """Learned or fixed patch weights (p, p); None for the Gaussian window."""
        weights = self.patch_weights
        return weights() if isinstance(weights, UnitWindow) else weights

    def _build(
        self,
        guide: Tensor,
        landmarks: Landmarks,
        bandwidth: float | Tensor | Literal["auto"],
        weights: Tensor | None,
        channels: GuideChannels,
    ) -> NonlocalOperator:
        """Build the operator with the options of the layer, and these landmarks."""
        options = FilterOptions(
            patch_size=self.patch_size,
            photometric_bandwidth=bandwidth,
            spatial_bandwidth=self.spatial_bandwidth,
            num_landmarks=self.num_landmarks,
            landmarks=landmarks,
            completion=self.completion,
            guide_channels=channels,
            patch_weights=self._weights(),
            tolerance=self.tolerance,
            generator=self.generator,
            group=self.group,
        )
        return checked_operator(guide, options, weights)

    def extra_repr(self) -> str:
        """The options of the operator."""
        holding = "" if self.held is None else f", hold={self.held.kind!r}"
        return (
            f"patch_size={self.patch_size}, photometric_bandwidth={self.shown('photometric_bandwidth')}, "
            f"spatial_bandwidth={self.shown('spatial_bandwidth')}, num_landmarks={self.num_landmarks}, "
            f"landmarks={self.landmarks!r}{holding}, completion={self.completion!r}, "
            f"guide_channels={self.guide_channels!r}"
        )


def _channels(own: GuideChannels | None, of_call: GuideChannels | None = None) -> GuideChannels:
    """What counts: what the layer says, or else the call, or else luminance."""
    return own or of_call or FilterOptions.guide_channels


def _check_no_volume(guide: Tensor) -> None:
    """Raise if the guide is a volume, for a layer that keeps landmarks as features of images."""
    if isinstance(guide, Tensor) and guide.ndim == 5:
        raise ValueError(
            "guide must be images (B, C, H, W) for a layer that keeps landmarks as features, got a volume of shape "
            f"{tuple(guide.shape)}; pass hold='assignment'"
        )
