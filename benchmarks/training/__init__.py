"""Training of the denoiser: pictures, noise as cameras make it, the steps, and what they are judged by."""
