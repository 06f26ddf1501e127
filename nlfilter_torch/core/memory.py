"""Estimates of the memory that an edit needs."""


def working_bytes(landmarks: int, patch_size: int, *, factors: int = 1) -> int:
    """Bytes of memory per pixel, slightly more than measured on two megapixels.

    Args:
        landmarks: M, the number of floats of the factor per pixel.
        patch_size: p; two copies of the patches exist while they are weighted.
        factors: number of arrays of the factor's size at once: 1 for filtering, 5 for diagnostics.
    """
    return 4 * (factors * landmarks + 2 * patch_size**2 + 40)
