"""What each edit is called, takes and offers: parameters, steps, presets and strokes. Does not import torch."""
