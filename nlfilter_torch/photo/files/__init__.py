"""Image files and films: arrays of rows with their metadata, read and written whole or a few rows at a time."""
