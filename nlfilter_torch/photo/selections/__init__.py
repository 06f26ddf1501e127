"""Masks and colours of objects, from scribbles."""
