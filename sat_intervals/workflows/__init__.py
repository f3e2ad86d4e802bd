"""Chains of steps, each one call: a raw pair to an epipolar one, two images to a surface model, many pairs."""
