"""The viewer: what a fleet or a finished run holds, to look at; nobody waits for it."""
