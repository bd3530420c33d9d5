"""The archiver: writes the run folder of a fleet, and decides which finished sections are in memory."""
