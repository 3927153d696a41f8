"""The one exception that the program shows to people, as a single line."""


class DelayRLError(Exception):
    """Bad input or a broken file: what was given, what is allowed, what to do, in one line."""


class StoppedError(DelayRLError):
    """A run was asked to stop, and has: its newest step is stored, and the same call goes on from there."""
