"""Code independent of images: checks, precision, autograd helpers, blocks of pixels, communicator, kernels."""
