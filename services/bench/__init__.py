"""Benchmarks of the rasteriser, the tracker, the mapper and the whole system (``vtslam bench``)."""
