"""The package inside other projects, and with torch's own handling of models and tensors."""
