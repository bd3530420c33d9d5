"""The sensor: sources of RGB-D frames."""
