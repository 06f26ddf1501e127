"""Edits of photographs, each a function of tensors. Paper: Sec. V."""
