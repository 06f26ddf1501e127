"""How much memory an edit takes."""


def working_bytes(landmarks: int, patch_size: int, *, factors: int = 1) -> int:
    """Memory in bytes that one pixel needs, a little more than was measured on two megapixels.

    Args:
        landmarks: m; the factor has as many floats for each pixel.
        patch_size: p; the patches of a pixel are there twice while they are weighted.
        factors: arrays of the factor's size that are held at once: 1 to filter, 5 for the diagnostics.
    """
    return 4 * (factors * landmarks + 2 * patch_size**2 + 40)
