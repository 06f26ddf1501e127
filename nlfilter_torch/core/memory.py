"""Memory that an edit needs."""


def working_bytes(landmarks: int, patch_size: int, *, factors: int = 1) -> int:
    """Memory in bytes that one pixel needs, a little more than was measured on two megapixels.

    Args:
        landmarks: m; the factor has as many floats for each pixel.
        patch_size: p; patches exist twice while they are weighted.
        factors: number of arrays of the factor's size at once: 1 to filter, 5 for the diagnostics.
    """
    return 4 * (factors * landmarks + 2 * patch_size**2 + 40)
