"""The one exception that means "a person can mend this"."""


class InputError(ValueError):
    """Bad input from a person: a file, a folder or a setting.

    Its message is one line that names the file or the setting and the mend. Entry points print it
    without a traceback and exit with code 2.
    """
