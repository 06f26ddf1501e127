"""The import of torchvision, which deepinv needs, beside another build of torch than the one it was made for."""

import torch

SIGNATURE = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"


def make_importable() -> torch.library.Library | None:
    """Declare two operators of torchvision if its compiled part does not load; keep the result while they are needed.

    deepinv does not call them.
    """
    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        operators = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            operators.define(name + SIGNATURE)
        return operators
    return None
