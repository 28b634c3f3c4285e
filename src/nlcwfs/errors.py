"""Errors a user can cause; each message names the key or argument, the rule and the value received."""


class NlcwfsError(Exception):
    """Base of every error that the user can mend; the command line prints it as one line and exits with 2."""


class SettingsError(NlcwfsError):
    """A setting breaks its rule.

    Examples:
        >>> str(SettingsError("beam.pixels", "must be even for binning", 91))
        'beam.pixels: must be even for binning, got 91'
    """

    def __init__(self, where: str, rule: str, value: object) -> None:
        super().__init__(f"{where}: {rule}, got {value}")


class SamplingError(SettingsError):
    """A grid cannot carry the light it is asked to carry."""


class FileFormatError(NlcwfsError):
    """A file does not hold what its contract asks for; the message names the file first."""
