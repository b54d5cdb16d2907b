"""Import the command and its libraries, then fork for each requested run; see `launch.py`."""

import atexit
import gc
import json
import os
import pkgutil
import runpy
import select
import signal
import socket
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import nanogs.cli
import nanogs.io
import nanogs.kernels
from nanogs.kernels.cached import _Cache
from nanogs.parallel import ParallelKernel

# Their modules, and libraries that these import, are imported in advance; a run imports the rest.
PACKAGES = (nanogs.cli, nanogs.io)
OTHERS = (
    "nanogs.scoring.run",
    "nanogs.scoring.held_out",
    "nanogs.scoring.viewing",
    "typer._adapters",
)


def serve(line):
    """Answer each request with the exit code of its run, until the client is gone.

    Returns:
        True in a forked process, which has to do a run; False in the server, at its end.
    """
    kernels, folder_times = compiled_functions(), {}
    while True:
        message, fds, _, _ = socket.recv_fds(line, 1 << 20, 3)
        if not message:
            return False
        folder_times = load(kernels, folder_times)
        child = os.fork()
        if child == 0:
            line.close()
            become(json.loads(message), fds)
            return True
        for fd in fds:
            os.close(fd)
        code = end_of(child, line)
        if code is None:
            return False
        line.send(str(code).encode())


def every_module(package):
    """Import and return the modules of a package."""
    names = [name for _, name, _ in pkgutil.iter_modules(package.__path__)]
    return [import_module(f"{package.__name__}.{name}") for name in names]


def compiled_functions():
    """Return all kernels, none if Numba's compilation is switched off."""
    found = {}
    for module in every_module(nanogs.kernels):
        for value in vars(module).values():
            kernel = value._compiled if isinstance(value, ParallelKernel) else value
            if isinstance(getattr(kernel, "_cache", None), _Cache):
                found[id(kernel)] = kernel
    return list(found.values())


def load(kernels, folder_times):
    """Load the kernels on the disk if their folders have changed; return the folders' times."""
    folders = {Path(kernel._cache.cache_path) for kernel in kernels}
    now = {folder: folder.stat().st_mtime_ns for folder in folders if folder.exists()}
    if now != folder_times:
        for kernel in kernels:
            for signature, *_ in kernel._cache._cache_file._load_index():
                kernel.compile(signature)
    return now


def end_of(child, line):
    """Wait for a run and return its exit code, or kill it and return None if the client is gone."""
    ended = os.pidfd_open(child)
    ready, _, _ = select.select([ended, line], [], [])
    os.close(ended)
    if ended not in ready:
        os.kill(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return code if ended in ready else None


def become(request, fds):
    """Take the streams, the working folder, the environment and the arguments of a run."""
    for number, fd in enumerate(fds):
        os.dup2(fd, number)
        os.close(fd)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    sys.argv = ["nanogs", *request["words"]]
    sys.path[0] = request["cwd"]  # as with `python -m`


def run():
    """Run the command and end with its exit code, without freeing all that was imported."""
    try:
        runpy.run_module("nanogs", run_name="__main__", alter_sys=True)
    except SystemExit as end:
        code = end.code
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = 1
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code or 0)


if __name__ == "__main__":
    for package in PACKAGES:
        every_module(package)
    for name in OTHERS:
        with suppress(ImportError):  # with other versions of the libraries
            import_module(name)
    gc.freeze()  # so that forks share the memory of all objects
    if serve(socket.socket(fileno=int(sys.argv[1]))):
        run()
