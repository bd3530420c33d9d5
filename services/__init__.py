"""One folder per process: a pure core and a thin loop."""
