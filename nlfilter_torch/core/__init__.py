"""What has no images in it: checks, precision, autograd helpers, blocks of pixels, processes, kernels."""
