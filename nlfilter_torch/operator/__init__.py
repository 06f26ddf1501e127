"""From a guide to the operator W: features, landmarks, Nystrom factor, balancing, products, spectrum."""
