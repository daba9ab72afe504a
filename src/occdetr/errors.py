"""The exception for errors that the user can fix."""


class InputError(ValueError):
    """Invalid input: a file, a folder or a setting.

    Its message is one line that names the file or setting and says what to do. Entry points print
    it without a traceback and exit with code 2.
    """


class NonFiniteError(InputError):
    """A result is not finite. All ranks of a run raise it together, and the first reports it."""
