"""Run the command in a process of its own, forked from one with its libraries already imported.

Importing the libraries and loading the kernels takes most of the time of a small run, and the
tests have hundreds of runs. On Linux, therefore, one process does this once (`launch_server.py`)
and forks for each run. On other systems, and for runs with other early variables of the
environment (`read_early`), each run is started as usual. Tests of how the command starts and ends,
of signals and of memory start it themselves.
"""

import atexit
import json
import os
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path

import pytest

SERVER = Path(__file__).with_name("launch_server.py")


def run(*arguments, text=True, data=b"", cwd=None, env=None, timeout=120):
    """Run the command to its end, and return a CompletedProcess, as `subprocess.run` does.

    Args:
        arguments: Arguments of the command; `str` is called on each.
        text: Whether stdout and stderr are returned as text instead of bytes.
        data: Bytes for its stdin, which is empty by default.
        cwd: Its working folder; None for the current one.
        env: Its environment; None for the current one.
        timeout: Seconds after which the process is killed, and the test fails.
    """
    words, env = list(map(str, arguments)), dict(os.environ if env is None else env)
    start = _forked if sys.platform == "linux" and read_early(env) == read_early() else _started
    code, *outputs = start(words, cwd or Path.cwd(), env, data, timeout)
    if text:
        outputs = [part.decode().replace("\r\n", "\n") for part in outputs]
    return subprocess.CompletedProcess(words, code, *outputs)


def run_here(*arguments):
    """Run the command in this process, where functions can be patched; return its exit code."""
    import nanogs.cli

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["nanogs", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            nanogs.cli.main()
    return ended.value.code


def measured(code, *arguments, cwd=None):
    """Run Python code that prints bytes of memory, and return the numbers of its last line.

    glibc returns what is freed at once: what it keeps by default varies by a tenth.
    """
    command = [sys.executable, "-c", code, *map(str, arguments)]
    returned = {"MALLOC_MMAP_THRESHOLD_": str(1 << 16), "MALLOC_TRIM_THRESHOLD_": "0"}
    run = subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, check=True, env=os.environ | returned
    )
    return [int(word) for word in run.stdout.splitlines()[-1].split() if word.isdecimal()]


def contents(path):
    """Return the bytes of a file, or of all files of a folder by name."""
    if path.is_file():
        return path.read_bytes()
    files = (each for each in path.rglob("*") if each.is_file())
    return {each.relative_to(path).as_posix(): each.read_bytes() for each in files}


def read_early(env=os.environ):
    """Return the variables of the environment that libraries read when they are imported."""
    names = ("NUMBA_", "PYTHON", "OMP_", "OPENBLAS_", "COLUMNS", "TERM", "NO_COLOR", "FORCE_COLOR")
    return {name: value for name, value in env.items() if name.startswith(names)}


def _started(words, cwd, env, data, timeout):
    """Start an ordinary process; return its exit code, stdout and stderr."""
    command = [sys.executable, "-m", "nanogs", *words]
    result = subprocess.run(
        command, input=data, capture_output=True, cwd=cwd, env=env, timeout=timeout
    )
    return result.returncode, result.stdout, result.stderr


def _forked(words, cwd, env, data, timeout):
    """Let the server fork a process; return its exit code, stdout and stderr."""
    server = _server(os.getpid(), tuple(sorted(read_early().items())))
    (stdin, feed), (out, stdout), (err, stderr) = (os.pipe() for _ in range(3))
    request = json.dumps({"words": words, "cwd": str(cwd), "env": env})
    socket.send_fds(server, [request.encode()], [stdin, stdout, stderr])
    for fd in (stdin, stdout, stderr):
        os.close(fd)
    with ThreadPoolExecutor(3) as pool:
        pool.submit(_feed, feed, data)
        outputs = [pool.submit(_drain, end) for end in (out, err)]
        code = _code(server, words, timeout)
        return code, *(part.result() for part in outputs)


def _feed(fd, data):
    with suppress(BrokenPipeError), os.fdopen(fd, "wb") as pipe:
        pipe.write(data)


def _drain(fd):
    with os.fdopen(fd, "rb") as pipe:
        return pipe.read()


def _code(server, words, timeout):
    server.settimeout(timeout)
    try:
        return int(server.recv(64) or pytest.fail("the server of runs has ended"))
    except TimeoutError:
        _server.cache_clear()
        server.close()  # the server then kills the run
        raise subprocess.TimeoutExpired(words, timeout) from None


@cache
def _server(_process, _early):
    """Start the server and return a socket to it; cached by process and early variables."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        child = subprocess.Popen(
            [sys.executable, SERVER, str(theirs.fileno())], pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            env=dict(os.environ),  # without variables that C libraries of this process have set
        )  # fmt: skip

    def end():
        ours.close()
        child.wait()

    atexit.register(end)
    return ours
