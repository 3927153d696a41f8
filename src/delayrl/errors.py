"""The one exception that the program shows to people, as a single line."""


class DelayRLError(Exception):
    """Bad input or a broken file: what was given, what is allowed, what to do, in one line."""
