"""The refusal of what figures read."""


class TableError(ValueError):
    """A result table is not what it should be; the message names the file, row and remedy."""
