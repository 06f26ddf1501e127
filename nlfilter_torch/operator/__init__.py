"""Guide to W: features, landmarks, Nystrom factor, balancing, products, spectrum, operator."""
