"""The errors that realsim raises on purpose.

Every message says what was wrong, the value that was found, what would be accepted, and what to
do next: the command line prints it as one paragraph and ends with exit code 2.
"""


class RealsimError(Exception):
    """Base of every error that realsim raises on purpose."""


class InputError(RealsimError):
    """Something given from outside (a file, a folder, an argument) cannot be used."""


class UnreadableError(InputError):
    """A file that this user may not read; whether it is sound nobody has seen."""


class UnitError(InputError):
    """A length, a depth or an angle does not have the unit that is claimed for it."""


class NotRigidError(InputError):
    """A matrix that should be a rigid transform is not one."""


class DegenerateError(RealsimError):
    """The observations do not determine what was asked for."""


class MissingLibraryError(RealsimError):
    """A library (of the system or of an extra) that this step needs is not installed."""
