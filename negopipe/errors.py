"""The one kind of error that is the user's to mend."""


class UserError(Exception):
    """A wrong config value, file or name. The message is one line: the key, the value and what is allowed.

    `python -m negopipe` prints it without a traceback and exits with code 1.
    """
