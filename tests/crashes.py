"""Simulated crashes: runs that end in the middle, as if the machine had been switched off."""

import itertools


class CrashError(Exception):
    """The simulated crash of a run."""


def crash_at(function, done, *places):
    """Wrap a function: its calls number `places` raise CrashError and append "crash" to `done`."""
    calls = itertools.count(1)

    def call(*arguments, **options):
        if next(calls) in places:
            done.append("crash")
            raise CrashError
        return function(*arguments, **options)

    return call
