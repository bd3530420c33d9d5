"""Estimates each frame's camera pose by rendering the map and aligning it to the frame."""
