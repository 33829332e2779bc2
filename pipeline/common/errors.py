"""Errors that a person caused and can mend, each with the exit code a scheduler sees.

Invariant: whoever raises one of these has written the whole message for the user - what was found, in which
file, what to do - because the jobs print it as one line, without a traceback (`jobs.run_job`).
"""

from __future__ import annotations


class UserError(Exception):
    """Base of the errors shown as one line; `exit_code` becomes the status of the process."""

    exit_code = 2


class UsageError(UserError):
    """The command line or the configuration asks for something that cannot be (exit code 2)."""


class DataError(UserError):
    """Data is missing, broken or not what its manifest says (exit code 3)."""

    exit_code = 3


class Diverged(UserError):
    """The loss is not finite, agreed over all ranks (exit code 4)."""

    exit_code = 4


class Preempted(UserError):
    """A signal asked to stop; everything is saved and the job should be requeued (exit code 75)."""

    exit_code = 75
