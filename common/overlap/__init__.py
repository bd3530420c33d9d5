"""Which earlier sections a frame sees."""
