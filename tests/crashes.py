"""Simulated crashes: runs that end in the middle, as if the machine had been switched off."""

import itertools


class CrashError(Exception):
    """The simulated crash of a run."""


def crash_at(function, events, *call_numbers):
    """Wrap a function: calls of these numbers raise CrashError and append "crash" to `events`."""
    calls = itertools.count(1)

    def call(*arguments, **options):
        if next(calls) in call_numbers:
            events.append("crash")
            raise CrashError
        return function(*arguments, **options)

    return call
