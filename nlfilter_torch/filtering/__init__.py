"""Applying an operator to images: filters, masks, scribbles, least-squares fits, fitted filters."""
