"""What a user can put right about the viewer."""


class ViewerError(Exception):
    """The viewer cannot show or write what it should."""
