"""What a look does to pixels, and the module whose parameters are a look."""
