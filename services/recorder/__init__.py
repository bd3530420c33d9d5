"""The recorder: what a fleet sees and finds, in an MCAP file."""
