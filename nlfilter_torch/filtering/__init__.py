"""From an operator and an image to the output: filters, masks, scribbles, least-squares fits, fitted filters."""
