"""The package inside other projects, and under what torch itself does with models and tensors."""
