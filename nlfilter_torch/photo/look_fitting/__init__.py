"""Finding the look of pairs of photographs, before and after an edit."""
