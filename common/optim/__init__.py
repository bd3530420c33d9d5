"""Optimisers and losses of poses and Gaussian attributes."""
