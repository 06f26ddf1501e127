"""The functions of this package as ``torch.nn`` layers, which hold parameters but no mathematics."""
